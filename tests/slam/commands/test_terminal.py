"""What people see on a terminal: help, versions, and nothing clipped at 80 columns."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from slam.commands.cli import _finish, app


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


def test_a_run_without_a_frame_has_no_table_and_no_picture(tmp_path, capsys):
    _finish({"frames": 0, "tracking": ""}, tmp_path, picture=True, quiet=False)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"slam: the run ended before its first frame; files: {tmp_path}\n"
    assert not list(tmp_path.iterdir())
