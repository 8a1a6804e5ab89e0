"""Right images of another moment are known by rows that follow the motion; rows off by the calibration are not."""

from __future__ import annotations

import numpy as np
import pytest

from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.input.moment import MomentWatch

RIG = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)


def doubt(late, step, box, frames, rows=lambda x, y: 0.4, since=0):
    """What is said of frames with steps (6,) and points in a box, whose right images are late from one frame on."""
    rng, watch, T = np.random.default_rng(0), MomentWatch(RIG), np.eye(4)
    last = exp(step(rng))
    for k in range(frames):
        points, now = rng.uniform(*box, (200, 3)), exp(step(rng))  # `now` to the next frame, `last` from the one before
        left, right = RIG.project(points)
        there = points @ last[:3, :3].T + last[:3, 3] if late > 0 else (points - now[:3, 3]) @ now[:3, :3]
        off = abs(late) * (RIG.left.project(there) - left)[:, 1] if k >= since else 0.0
        right[:, 1] += off + rows(*(left - [160.0, 120.0]).T / 300.0) + rng.normal(0, 0.1, len(points))
        ones = np.ones(len(points))
        looks = np.ones((len(points), 4), "f4")
        seen = StereoFeatures(0.0, left, right, ones, 0 * ones, ones, ones.astype(np.int8), looks)
        watch.add(seen, T, measured=True)
        T, last = T @ now, now
    return watch.doubt


def by_hand(rng):
    return rng.normal(0, 1, 6) * [0.006, 0.006, 0.006, 0.01, 0.01, 0.01]


@pytest.mark.parametrize(
    ("late", "frames", "since", "word"),
    [(0.0, 31, 0, ""), (0.3, 31, 0, "late"), (-0.3, 31, 0, "early"), (0.3, 500, 300, "late"), (0.0, 500, 0, "")],
)
def test_rows_that_follow_the_motion(late, frames, since, word):
    """A right camera that is pitched moves rows, too, but in the same way whatever the motion is."""
    said = doubt(late, by_hand, ([-2, -1.5, 3], [2, 1.5, 9]), frames, since=since)
    assert bool(said) == bool(word) and f"right images were {word} by" in (said or "right images were  by")


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_rows_that_differ_by_the_calibration_are_no_lag_where_the_motion_is_always_the_same(late):
    """A car that drives straight on: its motion moves rows in the same way in all frames, as the calibration does."""
    said = doubt(
        late, lambda rng: np.array([0, 0, 0, 0, 0, 0.5]), ([-6, -1, 8], [6, 3, 50]), 31,
        lambda x, y: 1.0 + 3.0 * x - 4.0 * y + 2.0 * x * y,
    )  # fmt: skip
    assert ("late by" in said) if late else said == ""


def test_a_camera_that_hardly_moves_shows_no_lag():
    """Its rows, here off by the lens, and the flow by errors of its poses are alike in all frames."""
    step = np.array([1e-5, 0, 0, 0, 0, 0])
    assert doubt(0.0, lambda rng: step, ([-2, -1.5, 3], [2, 1.5, 9]), 31, lambda x, y: y * y) == ""
