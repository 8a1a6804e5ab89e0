"""Accuracy figures: equal to evo's, right where the answer is known, defined where the path says little."""

from itertools import pairwise

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D

from slam.evaluation.metrics import PathErrors, absolute_errors, associate, relative_errors, segment_errors
from slam.geometry.se3 import exp, inverse, is_rotation
from slam.geometry.trajectory import Trajectory, alignment
from tests.slam.numeric import chained, straight


def wander(count: int, seed: int) -> Trajectory:
    """A path like a vehicle's: forward along z, turning."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(0, 0.05, (count - 1, 6)) + np.array([0, 0, 0, 0, 0, 0.5])
    return Trajectory(0.1 * np.arange(count), chained(exp(xi)))


def disturb(truth: Trajectory, seed: int) -> Trajectory:
    """An estimate that drifts, in a world frame of its own."""
    rng = np.random.default_rng(seed)
    motions = inverse(truth.poses[:-1]) @ truth.poses[1:]
    poses = chained(motions @ exp(rng.normal(0, 0.01, (len(motions), 6))))
    T = exp(rng.normal(size=6) * (1, 1, 1, 10, 10, 10))
    return Trajectory(truth.stamps, T @ poses)


def to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps)


def require_equal_to_evo(ours: PathErrors, truth: Trajectory, theirs: PoseTrajectory3D, metric, *arguments) -> None:
    """To 1e-9. evo has rotations by SciPy's logarithm, so ours must agree there, too."""
    for part, rmse, errors in (
        ("translation_part", ours.rmse, ours.translation), ("rotation_angle_deg", ours.rotation_rmse, ours.rotation)
    ):  # fmt: skip
        process = metric(evo_metrics.PoseRelation[part], *arguments)
        process.process_data((to_evo(truth), theirs))
        np.testing.assert_allclose(errors, process.error, rtol=1e-9, atol=1e-9)
        assert rmse == pytest.approx(process.get_all_statistics()["rmse"], abs=1e-9, rel=1e-9)


@pytest.mark.parametrize(("count", "seed"), [(200, 0), (50, 1), (4, 2)])
def test_errors_are_equal_to_evo_s(count, seed):
    truth = wander(count, seed)
    estimate = disturb(truth, seed)
    theirs = to_evo(estimate)
    theirs.align(to_evo(truth))
    require_equal_to_evo(absolute_errors(estimate, truth), truth, theirs, evo_metrics.APE)
    for delta in (1, 3):
        ours, unit = relative_errors(estimate, truth, delta), evo_metrics.Unit.frames
        require_equal_to_evo(ours, truth, to_evo(estimate), evo_metrics.RPE, delta, unit, 0.1, True)


@pytest.mark.parametrize("count", [2, 3, 50])
@pytest.mark.parametrize("seed", range(5))
def test_a_straight_path_is_turned_as_its_orientations_say(count: int, seed: int) -> None:
    """Positions on a line leave the turn about it open; the orientations know it."""
    truth = straight(count)
    T = exp(np.random.default_rng(seed).normal(size=6) * (1, 1, 1, 10, 10, 10))
    estimate = Trajectory(truth.stamps, T @ truth.poses)
    errors = absolute_errors(estimate, truth)
    assert is_rotation(alignment(estimate, truth)[:3, :3], 1e-12)
    assert errors.translation.max() < 1e-9
    assert errors.rotation.max() < 1e-5  # [deg]


@pytest.mark.parametrize(
    ("tolerance", "expected"), [(0.5, [-0.5, 0.995, 2.004, 2.02, 3.5, 8.0, 9.3]), (0.2, [0.995, 2.004, 2.02, 8.0])]
)
def test_association(tolerance, expected):
    stamps = np.array([-0.5, 0.995, 2.004, 2.02, 3.5, 8.0, 9.3])
    estimate = Trajectory(stamps, np.tile(np.eye(4), (7, 1, 1)))
    ours, true = associate(estimate, straight(10, dt=1.0), tolerance)
    assert ours.stamps.tolist() == expected
    assert true.positions[:, 2] == pytest.approx(true.stamps)
    assert true.stamps.tolist() == expected


def test_truth_of_a_high_rate_is_not_taken_far_beyond_its_ends():
    """The noise of two poses a millisecond apart made 28 mm of 1 mm in twenty."""
    truth = Trajectory(np.arange(1.0, 2.0, 1e-3), np.tile(np.eye(4), (1000, 1, 1)))
    ours, _ = associate(Trajectory(np.array([0.985, 0.9995, 1.5, 2.01]), np.tile(np.eye(4), (4, 1, 1))), truth)
    assert ours.stamps.tolist() == [0.9995, 1.5]


def kitti_development_kit(
    truth: np.ndarray, result: np.ndarray, lengths: list[float]
) -> list[tuple[float, float, float]]:
    """KITTI's definition, word by word: loops over first frames and lengths."""
    dist = [0.0]
    for a, c in pairwise(truth):
        dist.append(dist[-1] + float(np.linalg.norm(c[:3, 3] - a[:3, 3])))
    out = []
    for first in range(0, len(truth), 10):
        for length in lengths:
            last = next((i for i in range(first, len(dist)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_result = np.linalg.inv(result[first]) @ result[last]
            error = np.linalg.inv(delta_result) @ delta_truth
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            out.append((length, 100 * np.linalg.norm(error[:3, 3]) / length, np.degrees(angle) / length))
    return out


def test_segments_follow_kitti_s_definition() -> None:
    truth = wander(400, 11)
    estimate = disturb(truth, 11)
    lengths = [0.1 * i * truth.length for i in range(1, 9)]
    ours = segment_errors(estimate, truth)
    theirs = np.array(kitti_development_kit(truth.poses, estimate.poses, lengths))
    assert len(ours) == len(theirs)
    for length in lengths:
        own, rows = np.isclose(ours[:, 0], length), theirs[theirs[:, 0] == length]
        assert np.allclose(ours[own, 1], rows[:, 1], atol=1e-9)
        assert np.allclose(ours[own, 2], rows[:, 2], atol=1e-7)  # arccos loses half the digits near 0
