"""The files of a run go straight into evo's own commands."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from slam.compare.trial import SimulatedFrontend, WithoutImages
from slam.config import SystemConfig
from slam.evaluation.summary import evaluate
from slam.geometry.trajectory import Trajectory
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.worlds import open_world


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A short run, its world, and the truth beside it."""
    folder = tmp_path_factory.mktemp("run")
    world = open_world("aisle?frames=12")
    options = RunOptions("ekf", "simulated", SystemConfig.for_kind("handheld"), folder)
    run(WithoutImages(world), options, frontend=SimulatedFrontend(world))
    world.ground_truth.write_tum(folder / "truth.txt")
    return folder, world


def evo(command, *arguments, home):
    """What a command of evo prints; its settings go to a folder of the test's."""
    script = Path(sys.executable).with_name(command)
    environment = {**os.environ, "HOME": str(home), "USERPROFILE": str(home), "MPLBACKEND": "Agg"}
    words = [str(script), *map(str, arguments)]
    answer = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=600)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def test_evo_ape_takes_the_path_and_agrees_on_its_error(done, tmp_path):
    folder, world = done
    printed = evo("evo_ape", "tum", folder / "truth.txt", folder / "trajectory.txt", "--align", home=tmp_path)
    ours = evaluate(Trajectory.read_tum(folder / "trajectory.txt"), world)["ATE RMSE [m]"]
    rmse = float(re.search(r"rmse\s+(\S+)", printed).group(1))
    assert rmse == pytest.approx(ours, abs=2e-6)  # six decimals are printed
