"""Accuracy figures: equal to evo's, right where the answer is known, defined where the path says little."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from slam.errors import TrajectoryError
from slam.evaluation.metrics import (
    KITTI_LENGTHS,
    SegmentErrors,
    Statistics,
    absolute_errors,
    associate,
    chi_square_band,
    interpolate,
    nees,
    plane_errors,
    pose_residuals,
    relative_errors,
    segment_errors,
    segment_lengths,
)
from slam.geometry.alignment import align, align_positions
from slam.geometry.se3 import exp, inverse, pose
from slam.geometry.trajectory import Trajectory
from slam.sequences import open_sequence


def wander(count: int, seed: int, step: float = 0.5, turn: float = 0.05) -> Trajectory:
    """A path like a vehicle's: forward along z, turning."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        xi = rng.normal(0, [turn, turn, turn, 0.05, 0.05, 0.05]) + np.array([0, 0, 0, 0, 0, step])
        poses.append(poses[-1] @ exp(xi))
    return Trajectory(0.1 * np.arange(count), np.array(poses))


def disturb(truth: Trajectory, seed: int, drift: float = 0.01, gauge: bool = True) -> Trajectory:
    """An estimate that drifts, in a world frame of its own."""
    rng = np.random.default_rng(seed)
    poses = [truth.poses[0]]
    for a, c in pairwise(truth.poses):
        poses.append(poses[-1] @ inverse(a) @ c @ exp(rng.normal(0, drift, 6)))
    T = exp(rng.normal(size=6) * (1, 1, 1, 10, 10, 10)) if gauge else np.eye(4)
    return Trajectory(truth.stamps, T @ np.array(poses))


def to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps)


def assert_equal_to_evo(ours: Statistics, theirs: dict[str, float]) -> None:
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], abs=1e-9, rel=1e-9), name


CASES = [(200, 0), (50, 1), (4, 2)]


@pytest.mark.parametrize(("count", "seed"), CASES)
class TestEvo:
    """Equal to evo's to 1e-9. evo has rotations by SciPy's logarithm, so ours must agree there, too."""

    @pytest.mark.parametrize("mode", ["none", "se3", "sim3"])
    def test_ate(self, count: int, seed: int, mode: str) -> None:
        truth = wander(count, seed)
        estimate = disturb(truth, seed)
        ours = absolute_errors(estimate, truth, aligned=mode != "none", with_scale=mode == "sim3")
        theirs = to_evo(estimate)
        if mode != "none":
            theirs.align(to_evo(truth), correct_scale=mode == "sim3")
        for relation, statistics in (
            (evo_metrics.PoseRelation.translation_part, ours.translation_statistics),
            (evo_metrics.PoseRelation.rotation_angle_deg, ours.rotation_statistics),
        ):
            ape = evo_metrics.APE(relation)
            ape.process_data((to_evo(truth), theirs))
            assert_equal_to_evo(statistics, ape.get_all_statistics())

    @pytest.mark.parametrize("delta", [1, 3])
    @pytest.mark.parametrize("overlapping", [True, False])
    def test_rpe(self, count: int, seed: int, delta: int, overlapping: bool) -> None:
        truth = wander(count, seed)
        estimate = disturb(truth, seed)
        ours = relative_errors(estimate, truth, delta, overlapping)
        for relation, statistics in (
            (evo_metrics.PoseRelation.translation_part, ours.translation_statistics),
            (evo_metrics.PoseRelation.rotation_angle_deg, ours.rotation_statistics),
        ):
            rpe = evo_metrics.RPE(relation, delta, evo_metrics.Unit.frames, all_pairs=overlapping)
            rpe.process_data((to_evo(truth), to_evo(estimate)))
            assert_equal_to_evo(statistics, rpe.get_all_statistics())


def test_ate_of_a_nearly_straight_path_equals_evo_s() -> None:
    truth = wander(60, 5, step=1.2, turn=0.0005)
    estimate = disturb(truth, 5, drift=0.001)
    ours = absolute_errors(estimate, truth)
    theirs = to_evo(estimate)
    theirs.align(to_evo(truth))
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((to_evo(truth), theirs))
    assert_equal_to_evo(ours.translation_statistics, ape.get_all_statistics())


# ------------------------------------------------------------------------------------------- alignment


def assert_proper(R: np.ndarray) -> None:
    assert np.allclose(R @ R.T, np.eye(len(R)), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.integers(3, 30), st.floats(0.01, 100))
def test_alignment_undoes_a_similarity(seed: int, count: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3))
    R = Rotation.random(random_state=seed).as_matrix()
    t = rng.normal(size=3) * 50
    found = align_positions(source, scale * source @ R.T + t, with_scale=True)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert np.allclose(found.R, R, atol=1e-7)  # three nearly collinear points may lose half the digits
    assert np.allclose(found.apply(source), scale * source @ R.T + t, atol=1e-8 * max(1, scale))
    rigid = align_positions(source, source @ R.T + t)
    assert rigid.scale == 1
    assert_proper(rigid.R)


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from([2, 3]), st.integers(1, 6))
def test_no_other_rotation_is_better(seed: int, dimensions: int, count: int) -> None:
    """Random pairs, mirrored ones among them: a small turn or shift never helps."""
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, count, dimensions))
    if seed % 3 == 0:
        target = source * np.r_[-1, np.ones(dimensions - 1)]
    found = align_positions(source, target)
    assert_proper(found.R)
    best = ((found.apply(source) - target) ** 2).sum()
    for _ in range(8):
        if dimensions == 3:
            turn = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
        else:
            angle = rng.normal(0, 0.05)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        other = source @ (turn @ found.R).T
        other += (target - other).mean(axis=0)
        assert ((other - target) ** 2).sum() >= best - 1e-12


def straight(count: int) -> Trajectory:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    return Trajectory(np.arange(count, dtype=float), poses)


@pytest.mark.parametrize("count", [2, 3, 50])
@pytest.mark.parametrize("seed", range(5))
def test_a_straight_path_is_turned_as_its_orientations_say(count: int, seed: int) -> None:
    """Positions on a line leave the turn about it open; the orientations know it."""
    truth = straight(count)
    T = exp(np.random.default_rng(seed).normal(size=6) * (1, 1, 1, 10, 10, 10))
    estimate = Trajectory(truth.stamps, T @ truth.poses)
    errors = absolute_errors(estimate, truth)
    assert errors.alignment is not None
    assert errors.alignment.rank == 1
    assert_proper(errors.alignment.R)
    assert errors.translation.max() < 1e-9
    assert errors.rotation.max() < 1e-5  # [deg]


@pytest.mark.parametrize("count", [1, 2, 10])
@pytest.mark.parametrize("with_scale", [False, True])
def test_standing_still(count: int, with_scale: bool) -> None:
    truth = Trajectory(np.arange(count, dtype=float), np.tile(exp(np.array([0.3, -2, 1, 5, 6, 7.0])), (count, 1, 1)))
    estimate = Trajectory(truth.stamps, np.tile(np.eye(4), (count, 1, 1)))
    errors = absolute_errors(estimate, truth, with_scale=with_scale)
    assert errors.alignment is not None
    assert (errors.alignment.rank, errors.alignment.scale) == (0, 1.0)
    assert errors.translation.max() < 1e-9
    assert errors.rotation.max() < 1e-5


def test_an_estimate_that_moves_while_the_truth_stands_still() -> None:
    truth = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    errors = absolute_errors(straight(5), truth)
    assert errors.translation == pytest.approx([2, 1, 0, 1, 2])
    assert errors.rotation.max() < 1e-9


def test_alignment_is_stable_on_a_nearly_straight_path() -> None:
    """A micrometre more or less at one pose must not swing the aligned positions."""
    truth = wander(50, 7, step=1.2, turn=0.0002)
    estimate = disturb(truth, 7, drift=0.001)
    before = align(estimate, truth)
    poses = estimate.poses.copy()
    poses[20, 0, 3] += 1e-6
    after = align(Trajectory(estimate.stamps, poses), truth)
    assert_proper(before.R)
    assert np.abs(after.apply(estimate.positions) - before.apply(estimate.positions)).max() < 1e-4


def test_impossible_alignments() -> None:
    with pytest.raises(TrajectoryError, match="do not go together"):
        align_positions(np.zeros((3, 3)), np.zeros((4, 3)))
    with pytest.raises(TrajectoryError, match="do not go together"):
        align_positions(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(TrajectoryError, match="not finite"):
        align_positions(np.full((3, 3), np.nan), np.zeros((3, 3)))
    with pytest.raises(TrajectoryError, match="3 estimated poses, 2 true ones"):
        align(straight(3), straight(2))


# ------------------------------------------------------------------------------------------- common stamps


def test_association_by_nearest_stamp() -> None:
    truth = straight(10)
    stamps = np.array([-0.5, 0.995, 2.004, 2.02, 3.5, 8.0, 9.3])
    estimate = Trajectory(stamps, np.tile(np.eye(4), (7, 1, 1)))
    ours, true = associate(estimate, truth, tolerance=0.01)
    assert ours.stamps.tolist() == [0.995, 2.004, 8.0]
    assert true.stamps.tolist() == [1, 2, 8]
    assert true.positions[:, 2].tolist() == [1, 2, 8]
    ours, true = associate(estimate, truth, tolerance=0.6)
    assert len(ours) == 6  # two stamps near 2: the nearer has it; -0.5 is paired with 0
    assert len(np.unique(true.stamps)) == 6


def test_association_with_interpolated_truth() -> None:
    truth = straight(10)
    estimate = Trajectory(np.array([-0.1, 0.25, 2.004, 3.5, 9.0, 9.1]), np.tile(np.eye(4), (6, 1, 1)))
    ours, true = associate(estimate, truth, tolerance=0.5, interpolated=True)
    assert ours.stamps.tolist() == true.stamps.tolist() == [0.25, 2.004, 3.5, 9.0]
    assert true.positions[:, 2] == pytest.approx([0.25, 2.004, 3.5, 9.0])
    ours, _ = associate(estimate, truth, tolerance=0.3, interpolated=True)
    assert ours.stamps.tolist() == [0.25, 2.004, 9.0]


@pytest.mark.parametrize("interpolated", [True, False])
def test_nothing_to_associate(interpolated: bool) -> None:
    late = Trajectory(straight(3).stamps + 1.4e9, straight(3).poses)
    with pytest.raises(
        TrajectoryError, match=r"within 0\.01 s: estimate from 0\.000 to 2\.000 s, truth from 1400000000"
    ):
        associate(straight(3), late, interpolated=interpolated)
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    for a, c in ((empty, late), (late, empty)):
        with pytest.raises(TrajectoryError, match="is empty"):
            associate(a, c, interpolated=interpolated)


def test_interpolation_follows_a_screw() -> None:
    ends = Trajectory(
        np.array([1.0, 3.0]), np.array([exp(np.array([0.2, 0, 0, 1, 2, 3.0])), exp(np.array([0.8, 0, 0, 2, 2, 5.0]))])
    )
    middle = interpolate(ends, np.array([1.0, 1.5, 3.0]))
    expected = Rotation.from_matrix(ends.poses[0, :3, :3]).as_rotvec() + np.array([0.15, 0, 0])
    assert np.allclose(Rotation.from_matrix(middle.poses[1, :3, :3]).as_rotvec(), expected)
    assert np.allclose(middle.positions[1], 0.75 * ends.positions[0] + 0.25 * ends.positions[1])
    assert np.allclose(middle.poses[[0, 2]], ends.poses)
    with pytest.raises(TrajectoryError, match="outside"):
        interpolate(ends, np.array([3.1]))


# ------------------------------------------------------------------------------------------- RPE and segments


def test_a_scale_error_of_two_percent_is_two_percent_at_every_length() -> None:
    truth = straight(1200)
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 1.02
    errors = segment_errors(Trajectory(truth.stamps, poses), truth)
    assert sorted(set(errors.lengths)) == list(KITTI_LENGTHS)
    for length in KITTI_LENGTHS:
        rows = errors.lengths == length
        # a stretch ends at the first frame beyond its length, here one metre later, as in KITTI's own kit
        assert np.allclose(errors.translation[rows], 2 * (length + 1) / length)
        assert rows.sum() == len(range(0, 1200 - int(length) - 1, 10))
    assert np.all(errors.rotation == 0)


def test_a_turn_of_a_tenth_of_a_degree_per_metre() -> None:
    truth = straight(300)
    turns = np.array([exp(np.array([0, np.radians(0.1) * i, 0, 0, 0, 0])) for i in range(300)])
    estimate = Trajectory(truth.stamps, pose(turns[:, :3, :3], truth.positions))
    errors = segment_errors(estimate, truth, lengths=[99.5, 199.5])
    assert np.allclose(errors.rotation[errors.lengths == 99.5], 0.1 * 100 / 99.5)
    assert np.allclose(errors.rotation[errors.lengths == 199.5], 0.1 * 200 / 199.5)


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
    lengths = [10.0, 37.5, 100.0]
    ours = segment_errors(estimate, truth, lengths)
    theirs = np.array(kitti_development_kit(truth.poses, estimate.poses, lengths))
    assert len(ours.lengths) == len(theirs)
    for length in lengths:
        own, rows = ours.lengths == length, theirs[theirs[:, 0] == length]
        assert np.allclose(ours.translation[own], rows[:, 1], atol=1e-9)
        assert np.allclose(ours.rotation[own], rows[:, 2], atol=1e-7)  # arccos loses half the digits near 0
    assert ours.mean_translation == pytest.approx(theirs[:, 1].mean(), abs=1e-9)


def test_segments_of_short_paths() -> None:
    assert segment_lengths(3724.0) == KITTI_LENGTHS
    assert segment_lengths(59.9) == pytest.approx([5.99 * i for i in range(1, 9)])
    assert segment_lengths(0.0) == ()
    assert len(segment_errors(straight(60), straight(60)).lengths) > 8
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    for errors in (segment_errors(still, still), segment_errors(straight(3), straight(3), [100.0])):
        assert isinstance(errors, SegmentErrors)
        assert len(errors.lengths) == 0
        assert np.isnan(errors.mean_translation)


def test_impossible_relative_errors() -> None:
    with pytest.raises(TrajectoryError, match="delta must be at least 1"):
        relative_errors(straight(5), straight(5), 0)
    with pytest.raises(TrajectoryError, match="3 poses are too few, 4 are needed"):
        relative_errors(straight(3), straight(3), 3)
    with pytest.raises(TrajectoryError, match="associate them first"):
        relative_errors(straight(3), straight(4))
    with pytest.raises(TrajectoryError, match="must be positive"):
        segment_errors(straight(3), straight(3), [0.0])
    with pytest.raises(TrajectoryError, match="nothing could be compared"):
        Statistics.of(np.zeros(0))


# ------------------------------------------------------------------------------------------- GPS


def test_plane_errors_do_not_depend_on_heading_origin_or_world_frame() -> None:
    truth = wander(100, 13, turn=0.0)
    rng = np.random.default_rng(13)
    flat = truth.positions[:, [2, 0]] + rng.normal(0, 0.1, (100, 2))
    errors = []
    for heading, shift, xi in ((0.0, 0.0, np.zeros(6)), (2.1, 1e4, rng.normal(size=6))):
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        gps = np.column_stack([truth.stamps, flat @ turn.T + shift, np.zeros(100)])
        estimate = Trajectory(truth.stamps, exp(xi) @ truth.poses)
        errors.append(plane_errors(estimate, gps))
    assert np.allclose(errors[0], errors[1], atol=1e-8)
    # two axes of 0.1 m each, less the three parameters of the alignment
    assert np.sqrt(np.mean(errors[0] ** 2)) == pytest.approx(0.1 * np.sqrt(2 * (1 - 3 / 200)), rel=0.15)


def test_a_mirrored_track_is_not_made_to_fit() -> None:
    truth = wander(100, 17)
    gps = np.column_stack([truth.stamps, truth.positions[:, 2], -truth.positions[:, 0]])
    assert plane_errors(truth, gps).max() > 0.5
    gps[:, 2] *= -1
    assert plane_errors(truth, gps).max() < 1e-9


def test_plane_errors_associate_by_stamp() -> None:
    truth = straight(10)
    gps = np.column_stack([truth.stamps[::2] + 0.004, truth.positions[::2, 2], np.zeros(5)])
    assert len(plane_errors(truth, gps)) == 5
    with pytest.raises(TrajectoryError, match="no estimated pose has a GPS position"):
        plane_errors(truth, gps + 0.5)
    assert plane_errors(truth, gps[:1]).tolist() == [0.0]


# ------------------------------------------------------------------------------------------- consistency


def test_nees_of_samples_lies_in_its_band() -> None:
    rng = np.random.default_rng(19)
    A = rng.normal(size=(6, 6)) * 0.02
    covariance = A @ A.T + 1e-6 * np.eye(6)
    residuals = rng.multivariate_normal(np.zeros(6), covariance, size=2000)
    estimated = exp(rng.normal(size=(2000, 6)))
    true = estimated @ exp(residuals)
    found = pose_residuals(estimated, true)
    assert np.allclose(found, residuals, atol=1e-9)
    values = nees(found, np.tile(covariance, (2000, 1, 1)))
    low, high = chi_square_band(6, 2000, 0.999)
    assert low < values.mean() < high
    assert not low < nees(2 * found, np.tile(covariance, (2000, 1, 1))).mean() < high
    one_low, one_high = chi_square_band(6)
    assert np.mean((values > one_low) & (values < one_high)) == pytest.approx(0.95, abs=0.02)


def test_nees_against_the_formula() -> None:
    P = np.diag([1.0, 4.0])
    assert nees(np.array([[1.0, 2.0], [0.0, 0.0]]), np.array([P, P])) == pytest.approx([2.0, 0.0])
    with pytest.raises(TrajectoryError, match="not positive definite"):
        nees(np.ones((1, 2)), np.diag([1.0, -1.0])[None])


def test_chi_square_band_of_a_table() -> None:
    assert chi_square_band(6, 1, 0.95) == pytest.approx((1.237, 14.449), abs=1e-3)
    low, high = chi_square_band(6, 50)
    assert 5 < low < 6 < high < 7.1


# ------------------------------------------------------------------------------------------- real data


def test_real_truth_against_itself(slam_data: Path) -> None:
    sequence = open_sequence(slam_data / "kitti_odometry" / "sequences" / "06")
    truth = sequence.ground_truth
    assert truth is not None
    moved = Trajectory(truth.stamps, exp(np.array([0.5, 1, -2, 30, 40, 50.0])) @ truth.poses)
    errors = absolute_errors(moved, truth)
    assert errors.alignment is not None
    assert_proper(errors.alignment.R)
    assert errors.translation.max() < 1e-9
    assert errors.rotation.max() < 1e-4  # [deg]; nearly straight: the roll hangs on half a metre of curve


def test_real_euroc_truth_at_the_frames(slam_data: Path) -> None:
    sequence = open_sequence(slam_data / "euroc" / "V1_01_keyframes_a")
    truth = sequence.ground_truth
    assert truth is not None
    estimate = Trajectory(sequence.stamps, np.tile(np.eye(4), (20, 1, 1)))
    nearest = associate(estimate, truth)[1]
    between = associate(estimate, truth, interpolated=True)[1]
    assert len(nearest) == len(between) == 20
    assert np.abs(nearest.positions - between.positions).max() < 0.005


def test_the_ends_of_a_path_that_was_written_and_read_again_keep_their_truth() -> None:
    truth = wander(8, 0)
    stamps = truth.stamps.copy()
    stamps[[0, -1]] += (-1e-9, 1e-9)  # as nine decimals round them
    own, true = associate(Trajectory(stamps, truth.poses), truth, 0.02, interpolated=True)
    assert len(own) == 8
    np.testing.assert_array_equal(true.stamps, stamps)
    np.testing.assert_allclose(true.poses, truth.poses, atol=1e-12)
    stamps[-1] += 1e-3
    assert len(associate(Trajectory(stamps, truth.poses), truth, 0.02, interpolated=True)[0]) == 7
