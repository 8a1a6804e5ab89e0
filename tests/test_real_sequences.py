"""All back ends on real sequences with default settings; skipped where they are not on the machine.

Bars are `bars.ROOM` times the medians over perturbations in ``tests/bars.json``, which `experiments/bars.py` writes.
"""

from __future__ import annotations

import numpy as np
import pytest

from experiments.ablation_parts import RECORDED
from experiments.bars import ROOM, bars, errors, perturbed
from frontends import create
from slam.config import SystemConfig
from slam.sequences import open_sequence

pytestmark = pytest.mark.slow

#: Single runs differ by a factor of 1.7 on KITTI 06, of two on raw 0001, and of four in the library, without what
#: recognises a place.
SCATTERED = [case for case in RECORDED if case.name in ("KITTI 06", "raw 0001", "library")]


@pytest.mark.parametrize("case", [case for case in RECORDED if case not in SCATTERED], ids=lambda case: case.name)
def test_errors_are_those_measured(slam_data, case):
    """All frames are tracked with the newest OpenCV.

    With 4.10, which rectifies to other last digits, `ekf` misses three of V1_01 and then finds the place again: in the
    largest turn 7 to 14 matches agree, and 8 are needed.
    """
    sequence = open_sequence(slam_data / case.path)
    frontend = create("surf", sequence.rig, **SystemConfig.for_kind(sequence.kind).frontend)
    features = [frontend.extract(frame) for frame in sequence.frames(0, case.frames)]
    for backend, allowed in bars(case.name).items():
        found, results = errors(case, sequence, frontend, features, backend)
        tracked = sum(result.status.value == "tracked" for result in results)
        assert tracked >= (16 if case.name == "V1_01" else case.frames - 1), backend
        assert {path: error for path, error in found.items() if error >= allowed[path]} == {}, backend


@pytest.mark.parametrize("case", SCATTERED, ids=lambda case: case.name)
def test_the_median_is_that_measured_where_single_runs_scatter(slam_data, case):
    """Of three trials with all back ends: errors over the medians of their own back end.

    Plain stereo odometry on OpenCV's ORB or SIFT has 0.36 and 0.20 m on KITTI 06.
    """
    sequence, ratios = open_sequence(slam_data / case.path), []
    for trial in range(3):
        seen = perturbed(case, sequence, trial)
        for backend, allowed in bars(case.name).items():
            found, _ = errors(case, sequence, *seen, backend)
            ratios.append([ROOM * found[path] / allowed[path] for path in allowed])
    assert (np.median(ratios, axis=0) < ROOM).all()
