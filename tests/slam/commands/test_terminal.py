"""What people see on a terminal: help, versions, completion, and nothing clipped at 80 columns."""

from __future__ import annotations

import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from slam.commands import completion
from slam.commands.cli import _finish, _title, app
from slam.commands.display import Progress, print_listing, print_summary

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


def test_every_command_is_listed():
    assert [command.name for command in app.registered_commands] == COMMANDS


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


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["run", "--backend", "s"], {"smoother"}),
        (["run", "synthetic:de"], {"synthetic:desk"}),
        (["run", "--set", "map.max_l"], {"map.max_landmarks="}),
        (["run", "--kind", ""], {"handheld", "driving"}),
        (["run", "--format", "kitti"], {"kitti", "kitti-raw"}),
        (["compare", "--backends", "ekf,sm"], {"ekf,smoother"}),
        (["plot", "--figure", "e"], {"errors"}),
    ],
)
def test_the_shell_completes_words(words, offered):
    environment = {
        "_SLAM_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(["slam", *words]),
        "COMP_CWORD": str(len(words)),
    }
    done = CliRunner().invoke(app, [], prog_name="slam", env=environment)
    assert set(done.output.split()) == offered


def test_folders_are_completed_with_their_paths(tmp_path, monkeypatch):
    (tmp_path / "data" / "euroc").mkdir(parents=True)
    (tmp_path / "data" / "extra").mkdir()
    (tmp_path / "dates.txt").touch()
    monkeypatch.chdir(tmp_path)
    assert completion.sequences("da") == ["data"]
    assert completion.sequences("data/e") == ["data/euroc", "data/extra"]
    assert completion.sequences(f"{tmp_path}/data/eu") == [f"{tmp_path}/data/euroc"]
    assert completion.sequences("nowhere/x") == []
    assert all(Path(found).is_dir() for found in completion.sequences("") if ":" not in found)


def test_a_progress_bar_fits_on_80_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    sequence = SimpleNamespace(name="2011_09_26_drive_0013_sync")
    result = SimpleNamespace(
        status=SimpleNamespace(value="predicted"), report=SimpleNamespace(used=range(150)), map_size=1000
    )
    with Progress(1500, _title(sequence, "smoother"), False) as progress:
        for _ in range(3):
            progress.frame(result)
            time.sleep(0.03)  # a rate of some tens of frames per second
    line = capsys.readouterr().err.strip()
    assert line.startswith("…e_0013_sync · smoother ")
    assert "3/1500" in line
    assert "predicted 150/1000" in line
    assert "…" not in line[1:]
    assert len(line) <= 80


def test_tables_fit_on_80_columns_and_are_whole(monkeypatch, capsys):
    from rich.console import Console

    monkeypatch.setattr("slam.commands.display._console", Console(width=80))
    summary = {
        "sequence": "aisle?frames=1500&speed=2&box=1&noise=3&width=640&height=480&layout=7&detect=0.8&shutter=0.5",
        "backend": "smoother",
        "frames": 1500,
        "status": {"failed": 1, "lost": 120, "predicted": 25, "started": 1, "tracked": 1353},
        "accuracy": {"online": {"rotation RMSE from start [deg]": 0.1234}},
    }
    print_summary([summary, {**summary, "backend": "ekf"}], Path("results/aisle-smoother-1"))
    print_listing()
    print_listing(options=True)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if "…" in line]


def test_names_are_listed_first_and_options_on_request():
    names, options = invoke("list").output, invoke("list", "--options").output
    assert "synthetic:aisle" in names
    assert "box=0" not in names
    assert "box=0" in options


def test_lengths_below_a_metre_are_in_millimetres_and_bodies_are_in_the_table(capsys):
    summary = {
        "sequence": "aisle", "backend": "ekf", "frames": 9, "status": {"tracked": 9}, "bodies": 1,
        "loops": {"closed": 2, "refused": 1}, "accuracy": {"online": {"ATE RMSE [m]": 0.0123, "ATE max [m]": 2.5}},
        "objects": {"bodies": {"1": {"coverage": 0.5, "ME": {"translation median [m]": 0.002}}}},
    }  # fmt: skip
    print_summary([summary], Path("out"))
    said = " ".join(capsys.readouterr().out.split())
    assert "online ATE RMSE [mm] │ 12.3 " in said
    assert "online ATE max [m] │ 2.5 " in said
    assert "loops closed, refused │ 2, 1 " in said
    assert "its motion a frame [mm] │ 2 " in said


def test_a_run_without_a_frame_has_no_table_and_no_picture(tmp_path, capsys):
    _finish({"frames": 0, "tracking": ""}, tmp_path, picture=True, quiet=False)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"slam: the run ended before its first frame; files: {tmp_path}\n"
    assert not list(tmp_path.iterdir())
