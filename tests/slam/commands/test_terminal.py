"""What people see on a terminal: help, versions, and nothing clipped at 80 columns."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slam.commands.cli import _finish, app
from slam.commands.display import print_summary

COMMANDS = ["run", "replay", "plot", "settings", "compare", "calibrate", "render", "view", "list", "warm-up", "demo"]


def invoke(*words, **environment):
    return CliRunner().invoke(app, list(words), env={"COLUMNS": "80", "TERMINAL_WIDTH": "80", **environment})


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)], ids=str)
def test_help_fits_on_80_columns_and_is_whole(command):
    done = invoke(*command, "-h")
    assert done.exit_code == 0
    assert done.output == invoke(*command, "--help").output
    lines = done.output.splitlines()
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if "…" in line or re.search(r"\w\.\.\.$", line)], done.output


def test_the_version():
    done = invoke("--version")
    assert (done.exit_code, done.output.split()[0]) == (0, "surf-stereo-slam")


def test_a_mistyped_command_is_answered_with_the_right_one():
    done = invoke("settigns")
    assert done.exit_code == 2
    assert "settings" in done.output


@pytest.mark.slow
def test_short_options_are_the_long_ones(tmp_path):
    done = invoke("run", "synthetic:desk?frames=2&width=64&height=48", "-o", str(tmp_path / "out"), "-q")
    assert (done.exit_code, done.output) == (0, "")
    assert (tmp_path / "out" / "summary.png").exists()


def test_figures_are_in_their_units_and_bodies_are_in_the_table(capsys):
    summary = {
        "sequence": "aisle", "backend": "ekf", "frames": 9, "status": {"tracked": 9}, "bodies": 1,
        "loops": {"closed": 2, "refused": 1}, "accuracy": {"online": {"ATE RMSE [m]": 0.0123}},
        "objects": {"bodies": {"1": {"coverage": 0.5, "ME": {"translation median [m]": 0.002}}}},
    }  # fmt: skip
    print_summary([summary], Path("out"))
    said = " ".join(capsys.readouterr().out.split())
    assert "ATE RMSE, online [mm] 12.3 " in said
    assert "loops closed 2 " in said
    assert "body 1: motion error, translation median [mm] 2 " in said


def test_covariances_that_are_too_large_on_an_exact_world_say_why(capsys):
    summary = {"sequence": "aisle", "backend": "ekf", "frames": 9, "status": {"tracked": 9}}
    for exact in (True, False):
        print_summary(
            [{**summary, "consistency": {"mean NEES": 0.5, "dof": 6.0, "exact calibration": exact}}], Path("out")
        )
        said = " ".join(capsys.readouterr().out.split())
        assert "covariances are too large" in said
        assert ("this world's cameras have none" in said) == exact


def test_a_run_without_a_frame_has_no_table_and_no_picture(tmp_path, capsys):
    _finish({"frames": 0, "tracking": ""}, tmp_path, picture=True, quiet=False)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"slam: the run ended before its first frame; files: {tmp_path}\n"
    assert not list(tmp_path.iterdir())
