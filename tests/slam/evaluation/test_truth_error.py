"""Errors of the truth, found from the truth alone: how fast they change, a drift, stretches that cannot be right."""

import numpy as np
import pytest

from slam.evaluation.truth_error import doubtful, interpolated, truth_covariances
from slam.geometry.se3 import adjoint, exp, inverse
from slam.geometry.trajectory import Trajectory, TruthNoise
from tests.slam.numeric import chained, straight

NOISE = TruthNoise(rotation=5e-4, translation=0.02, wheels=True)
LEVER = 1.5  # from the rear axle to the camera [m]


def drive(frames: int = 100) -> Trajectory:
    """A car that winds along a road, as its camera sees it; the camera looks half a degree to the side."""
    rng = np.random.default_rng(0)
    turn = 0.01 * np.sin(np.arange(frames) / 9)
    halves = [exp(np.array([0, 0.5 * angle, 0, 0, 0, 0])) for angle in turn[:-1]]
    steps = [half @ exp(np.array([0, 0, 0, LEVER * a, 0, 1.0])) @ half for half, a in zip(halves, turn)]
    side = exp(np.array([0, 0.01, 0, 0, 0, 0]))
    scatter = np.repeat([1e-4, 0.01], 3)
    seen = chained(steps) @ side @ exp(scatter * rng.normal(size=(frames, 6)))
    return Trajectory(0.1 * np.arange(frames), seen)


def stretches(frames: int = 100) -> tuple[np.ndarray, np.ndarray]:
    first = np.arange(frames - 10)
    return first, first + 10


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
    assert found[10:19].all() and found[20:29].all()  # they end or begin at poses that were not measured
    assert not found[:10].any() and not found[19] and not found[29:].any()
    assert np.flatnonzero(interpolated(true, NOISE)).tolist() == [*range(20, 29)]
    kept = np.setdiff1d(np.arange(100), [5, 22, 24, 25, 60, 61])  # a camera lost the others
    assert kept[interpolated(true.select(kept), NOISE)].tolist() == [20, 21, 23, 26, 27, 28]
    standing = Trajectory(true.stamps, np.concatenate([np.tile(np.eye(4), (50, 1, 1)), drive(50).poses]))
    for even in (standing, straight(400)):  # equal turns by nothing are none that was made up
        assert not interpolated(even, NOISE).any()


def test_a_path_that_was_interpolated_as_a_whole_is_no_truth():
    """As the first frames of such a drive: nothing in them was measured, which would show what is even."""
    steps = np.array([0, 0.004, 0.001, 0, 0, 1.0]) + 5e-6 * np.random.default_rng(0).normal(size=(11, 6))
    true = Trajectory(0.1 * np.arange(12), chained(exp(steps)))
    assert interpolated(true, NOISE).all()
    assert not interpolated(drive(12), NOISE).any()


def relative_errors(of: Trajectory, true: Trajectory, frames: int) -> tuple[np.ndarray, ...]:
    """Rows of stretches, adjoints of their inverse motions, and the errors (M, 6) of the measured ones."""
    first = np.arange(len(true) - frames)
    step = inverse(true.poses[first]) @ true.poses[first + frames]
    error = inverse(step) @ inverse(of.poses[first]) @ of.poses[first + frames]
    small = np.column_stack([error[:, 2, 1], error[:, 0, 2], error[:, 1, 0], error[:, :3, 3]])
    return first, adjoint(inverse(step)), small


def with_slow_errors(correlation: float, seed: int) -> tuple[Trajectory, TruthNoise]:
    """A measured path whose errors have such a correlation from frame to frame."""
    true, rng = straight(400), np.random.default_rng(seed)
    noise = TruthNoise(rotation=1e-3, translation=0.02)
    scale = np.repeat([noise.rotation, noise.translation], 3)
    error = [rng.normal(size=6)]
    for _ in range(len(true) - 1):
        error.append(correlation * error[-1] + np.sqrt(1 - correlation**2) * rng.normal(size=6))
    measured = true.poses @ exp(np.array(error) * np.concatenate([scale[:3], [0, 0, 0]]))
    measured[:, :3, 3] += np.array(error)[:, 3:] * scale[3:]
    return Trajectory(true.stamps, measured), noise


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.99])
@pytest.mark.parametrize("frames", [1, 10])
def test_how_fast_errors_change_is_seen_in_the_path(correlation, frames):
    true = straight(400)
    ratios = []
    for seed in range(6):
        measured, noise = with_slow_errors(correlation, seed)
        first, A, errors = relative_errors(measured, true, frames)
        P = truth_covariances(measured, noise, first, first + frames, A)
        ratios.append((errors**2).mean(axis=0) / np.diagonal(P, axis1=1, axis2=2).mean(axis=0))
    assert (np.abs(np.log(np.mean(ratios, axis=0))) < np.log(1.5)).all()  # each axis by half, the steadiest one by less


def test_a_drift_is_as_large_as_the_vehicle_seems_to_slip():
    true, rng = drive(400), np.random.default_rng(1)
    drift = np.cumsum(rng.normal(size=400)) * 0.1  # 0.3 m in ten frames
    off = Trajectory(true.stamps, true.poses.copy())
    off.poses[:, :3, 3] += off.poses[:, :3, 0] * drift[:, None]
    first = np.arange(390)
    A = adjoint(inverse(inverse(true.poses[first]) @ true.poses[first + 10]))
    right, wrong = (truth_covariances(x, NOISE, first, first + 10, A)[:, 3, 3].mean() for x in (true, off))
    assert wrong - right > 0.5 * 10 * 0.1**2
    assert wrong < 2 * 10 * 0.1**2
