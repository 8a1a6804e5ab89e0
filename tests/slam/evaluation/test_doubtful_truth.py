"""Truth that contradicts itself: interpolated over gaps, or slipping sideways."""

from __future__ import annotations

import numpy as np

from slam.evaluation.doubtful_truth import doubtful
from slam.geometry.se3 import exp
from slam.geometry.trajectory import Trajectory, TruthNoise

NOISE = TruthNoise(rotation=5e-4, translation=0.02, wheels=True)
LEVER = 1.5  # from the rear axle to the camera [m]


def drive(frames: int = 100) -> Trajectory:
    """A car that winds along a road, as its camera sees it; the camera looks half a degree to the side."""
    rng = np.random.default_rng(0)
    turn = 0.01 * np.sin(np.arange(frames) / 9)
    poses = [np.eye(4)]
    for k in range(frames - 1):
        half = exp(np.array([0, 0.5 * turn[k], 0, 0, 0, 0]))
        poses.append(poses[-1] @ half @ exp(np.array([0, 0, 0, LEVER * turn[k], 0, 1.0])) @ half)
    side = exp(np.array([0, 0.01, 0, 0, 0, 0]))
    scatter = np.repeat([1e-4, 0.01], 3)
    return Trajectory(0.1 * np.arange(frames), np.array([T @ side @ exp(scatter * rng.normal(size=6)) for T in poses]))


def stretches(frames: int = 100) -> tuple[np.ndarray, np.ndarray]:
    first = np.arange(frames - 10)
    return first, first + 10


def test_a_car_that_winds_along_is_believed():
    assert not doubtful(drive(), NOISE, *stretches()).any()


def test_a_drift_to_the_side_is_noticed_where_it_is():
    true, (first, last) = drive(), stretches()
    drift = 0.4 * np.clip((np.arange(100) - 40) / 10, 0, 1)  # 0.4 m, from frame 40 to 50
    true.poses[:, :3, 3] += true.poses[:, :3, 0] * drift[:, None]
    found = doubtful(true, NOISE, first, last)
    assert found[38:43].all()
    assert not found[:30].any()
    assert not found[51:].any()
    no_car = TruthNoise(NOISE.rotation, NOISE.translation)
    assert not doubtful(true, no_car, first, last).any()


def test_interpolated_truth_is_noticed_where_it_is():
    true, (first, last) = drive(), stretches()
    step = exp(np.array([0, 0.004, 0.001, 0, 0, 1.0]))
    for k in range(20, 30):
        true.poses[k] = true.poses[k - 1] @ step
    found = doubtful(true, NOISE, first, last)
    assert found[12:27].all()
    assert not found[:10].any()
    assert not found[31:].any()


def test_interpolated_truth_is_noticed_where_there_is_little_else():
    true, (first, last) = drive(25), stretches(25)
    step = exp(np.array([0, 0.004, 0.001, 0, 0, 1.0]))
    for k in range(1, 20):
        true.poses[k] = true.poses[k - 1] @ step
    assert doubtful(true, NOISE, first, last).all()


def test_truth_without_noise_is_exact():
    still = Trajectory(0.1 * np.arange(20), np.tile(np.eye(4), (20, 1, 1)))
    assert not doubtful(still, TruthNoise(), *stretches(20)).any()
    assert not doubtful(still, NOISE, *stretches(20)).any()
