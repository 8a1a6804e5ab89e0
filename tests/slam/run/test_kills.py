"""Runs that are killed: what was done is kept in whole rows, and the folder can be used again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.config import SystemConfig
from slam.run.options import RunOptions
from slam.run.runner import run
from tests.fuzz.runs import Features, Scripted, require_whole

ROOT = Path(__file__).parents[3]
COUNT = 20


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.parametrize("backend", ["ekf", "smoother", "window"])
def test_twenty_kills_leave_whole_rows(tmp_path, backend):
    command = [sys.executable, "-W", "ignore", "-m", "tests.slam.run.kills", backend, str(tmp_path), str(COUNT)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=600)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= COUNT // 2  # on a busy machine some end before
    rows = []
    for k in range(COUNT):
        folder = tmp_path / str(k)
        for left in folder.glob("*.part"):  # of a kill while a last file was written: beside its place, not in it
            left.unlink()
        require_whole(folder, folder)
        path = folder / "trajectory.txt"
        rows.append(path.read_text().splitlines() if path.exists() else [])
    whole = (tmp_path / "whole" / "trajectory.txt").read_text().splitlines()
    assert all(these == whole[: len(these)] for these in rows)  # the same frames, as far as they go
    assert len({len(these) for these in rows}) > 2
    for folder in tmp_path.iterdir():  # no lock is left
        run(Scripted(None, 0), RunOptions(backend, "none", SystemConfig(), folder), frontend=Features())
