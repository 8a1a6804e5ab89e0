"""All back ends on real sequences with default settings; skipped where they are not on the machine.

Bars are `bars.ROOM` times the medians over perturbations in ``tests/bars.json``, which `experiments/bars.py` writes.
"""

from __future__ import annotations

import numpy as np
import pytest

from experiments.ablation_parts import CASES, RECORDED, USUAL, error_of
from experiments.bars import bars, errors
from slam.geometry.trajectory import Trajectory
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.sequences import open_sequence

pytestmark = pytest.mark.slow

PATHS = {"online": "trajectory.txt", "final": "trajectory_final.txt"}


def run_defaults(slam_data, case, backend, out, frames=None):
    """The sequence, and the summary of a run of its first frames."""
    sequence = open_sequence(slam_data / case.path)
    config = USUAL.config(sequence, case, backend)
    return sequence, run(sequence, RunOptions(backend, "surf", config, out, 0, frames or case.frames))


#: Single runs differ by a factor of two on raw 0001, and of four in the library, without what recognises a place.
SCATTERED = [case for case in CASES if case is CASES[-1] or case.name == "raw 0001"]


@pytest.mark.parametrize(
    ("case", "backend"),
    [pytest.param(c, b, id=f"{c.name}-{b}") for c in RECORDED if c not in SCATTERED for b in bars(c.name)],
)
def test_errors_are_those_measured(slam_data, tmp_path, case, backend):
    """Plain stereo odometry on OpenCV's ORB or SIFT has 0.36 and 0.20 m on KITTI 06.

    All frames are tracked with the newest OpenCV. With 4.10, which rectifies to other last digits, `ekf` misses three
    of V1_01 and then finds the place again: in the largest turn 7 to 14 matches agree, and 8 are needed.
    """
    sequence, summary = run_defaults(slam_data, case, backend, tmp_path)
    tracked = summary["status"].get("tracked", 0)
    assert tracked >= (16 if case.name == "V1_01" else case.frames - 1)
    assert summary["frames"] == case.frames
    for path, allowed in bars(case.name)[backend].items():
        assert error_of(Trajectory.read_tum(tmp_path / PATHS[path]), sequence) < allowed, path


@pytest.mark.parametrize("case", SCATTERED, ids=lambda case: case.name)
def test_the_median_is_that_measured_where_single_runs_scatter(slam_data, case):
    sequence, allowed = open_sequence(slam_data / case.path), bars(case.name)
    trials = [errors(case, sequence, tuple(allowed), trial) for trial in range(5)]  # as the bars
    for backend, figures in allowed.items():
        for path, most in figures.items():
            assert np.median([trial[backend][path] for trial in trials]) < most, (backend, path)


def test_the_same_run_twice_is_the_same_to_the_byte(slam_data, tmp_path):
    for name in ("a", "b"):
        run_defaults(slam_data, CASES[0], "smoother", tmp_path / name, 12)
    for file in ("trajectory.txt", "trajectory_final.txt", "landmarks.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
