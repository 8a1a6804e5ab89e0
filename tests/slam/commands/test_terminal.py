"""What people see on a terminal: help, versions, and nothing clipped at 80 columns."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from slam.commands.cli import app
from slam.commands.display import print_summary


def invoke(*words, **environment):
    return CliRunner().invoke(app, list(words), env={"COLUMNS": "80", "TERMINAL_WIDTH": "80", **environment})


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


def test_covariances_that_are_too_large_on_an_exact_world_say_why(capsys):
    summary = {"sequence": "aisle", "backend": "ekf", "frames": 9, "status": {"tracked": 9}}
    for exact in (True, False):
        print_summary(
            [{**summary, "consistency": {"mean NEES": 0.5, "dof": 6.0, "exact calibration": exact}}], Path("out")
        )
        said = " ".join(capsys.readouterr().out.split())
        assert "covariances are too large" in said
        assert ("this world's cameras have none" in said) == exact
