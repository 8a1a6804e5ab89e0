"""What people see on a terminal: help, versions, and nothing clipped at 80 columns."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from slam.commands.cli import app


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
