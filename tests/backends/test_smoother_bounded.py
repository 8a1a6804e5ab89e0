"""The smoother's bounded problem: what is marginalised, what is held, and drives that it must not run away on."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from backends.smoother.marginal import MarginalPrior
from backends.smoother.reference_pose import ReferencePose
from backends.smoother.variables import landmark_key, pose_key

from backends.batch import BatchBackend
from backends.smoother import SmootherBackend
from backends.smoother.factors import FactorMaker
from slam.data import Observations
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels, MotionModel
from slam.testing import hostile
from slam.window.pose_only import residual_noise
from slam.window.stereo import RectifiedStereo
from tests.backends.scenes import RIG, path, run, scene, step

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)
DT = 0.1
KITTI = StereoRig.rectified_pair(707.0912, 601.8873, 183.1104, 0.53715065, 1226, 370)


def drive(frames: int, **options):
    poses = path(frames, DT, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0]))
    return scene(poses, **options)


def some_prior() -> tuple[MarginalPrior, gtsam.Values]:
    """A prior on three poses and two landmarks, and values a little off."""
    rng = np.random.default_rng(0)
    poses, landmarks = (pose_key(4), pose_key(5), pose_key(6)), (landmark_key(0), landmark_key(1))
    T = se3.exp(rng.normal(0, 0.5, (3, 6)))
    R = np.triu(rng.normal(0, 1, (24, 24))) + 5 * np.eye(24)
    local = rng.normal(0, 3, (2, 3))
    prior = MarginalPrior(poses, landmarks, T[0], se3.inverse(T[0]) @ T[1:], local, R, rng.normal(0, 1, 24))
    values = gtsam.Values()
    for key, pose in zip(poses, T @ se3.exp(rng.normal(0, 0.1, (3, 6)))):
        values.insert(key, gtsam.Pose3(pose))
    for key, point in zip(landmarks, se3.transform(T[0], local) + rng.normal(0, 0.1, (2, 3))):
        values.insert(key, point)
    return prior, values


def test_derivatives_of_the_prior():
    prior, values = some_prior()
    factor = prior.factor()
    linear = factor.linearize(values)
    A, _ = linear.jacobian()
    numeric, column = np.empty_like(A), 0
    for key in prior.keys:
        for i in range(6 if key in prior.poses else 3):
            errors = []
            for h in (-1e-6, 1e-6):
                moved = gtsam.Values(values)
                if key in prior.poses:
                    moved.update(key, values.atPose3(key).retract(h * np.eye(6)[i]))
                else:
                    moved.update(key, values.atPoint3(key) + h * np.eye(3)[i])
                errors.append(-factor.linearize(moved).jacobian()[1])
            numeric[:, column] = (errors[1] - errors[0]) / 2e-6
            column += 1
    np.testing.assert_allclose(A, numeric, atol=1e-5)


def test_a_prior_but_for_its_reference_goes_along_with_all_of_it():
    prior, values = some_prior()
    R = prior.R.copy()
    R[:, :6] = 0
    prior = replace(prior, R=R)
    T = se3.exp(np.array([0.3, -0.2, 0.5, 100.0, -40.0, 7.0]))
    moved = gtsam.Values()
    for key in prior.poses:
        moved.insert(key, gtsam.Pose3(T @ values.atPose3(key).matrix()))
    for key in prior.landmarks:
        moved.insert(key, se3.transform(T, values.atPoint3(key)[None])[0])
    factor = prior.factor()
    assert factor.error(moved) == pytest.approx(factor.error(values), rel=1e-9)


def test_records_are_bounded_by_the_lag():
    backend, known = SmootherBackend(RIG, MODELS, lag=14, window=8), set()
    counts = []
    for k, (stamp, _, seen) in enumerate(drive(120, points=600)):
        step(backend, stamp, seen, known)
        gone = sorted(known - set(seen.ids.tolist()))
        backend.remove(gone)
        known.difference_update(gone)
        history = backend.measurement_log.history
        factors = len(history.finished) + sum(map(len, history.explicit.values()))
        counts.append((backend.measurement_log.measurements.count, factors, len(history.places), len(history.owner)))
        assert backend.measurement_log.measurements.frame.min(initial=k) >= 0
    early, late = np.max(counts[30:60], axis=0), np.max(counts[60:], axis=0)
    assert (late <= 1.3 * early + 5).all(), (early, late)


def test_whether_the_whole_path_follows_is_told_with_the_present_frame():
    backend, known = SmootherBackend(RIG, MODELS, lag=12, window=12), set()
    answers = []
    for k, (stamp, _, seen) in enumerate(drive(30, points=300)):
        step(backend, stamp, seen, known)
        backend.predict(stamp + 0.5 * DT)  # a frame that waits
        answers.append(backend.revises_path)
        backend.revise(lambda z: z)
        assert backend.revises_path == answers[-1], k
    assert answers[0] and not answers[-1]


def test_mended_measurements_do_not_part_the_path_from_poses_that_have_left():
    """What is left of the problem may stand anywhere in the world; poses that have left do not follow it there."""
    models = replace(MODELS, initial_position_sigma=10.0, initial_rotation_sigma=0.1)
    backend, known = SmootherBackend(RIG, models, lag=12, window=8), set()
    for stamp, _, seen in drive(40, points=400):
        step(backend, stamp, seen, known)
        gone = sorted(known - set(seen.ids.tolist()))
        backend.remove(gone)
        known.difference_update(gone)
    before, first = backend.trajectory().poses, backend.measurement_log.history.first
    backend.revise(lambda z: z + np.array([0.0, 0.0, 2.0]))
    moved = np.linalg.norm(backend.trajectory().poses[:, :3, 3] - before[:, :3, 3], axis=1)
    assert not moved[:first].any()
    assert moved[first] < 0.01 * moved[-1], moved[first:]


def test_a_place_in_the_world_that_is_hardly_known_does_not_move():
    """All that is measured is relative; the smoother must not wander about within what it does not know."""
    models = replace(MODELS, initial_position_sigma=10.0, initial_rotation_sigma=0.1)
    data, known = drive(90, points=500), set()
    backend = SmootherBackend(RIG, models, lag=15, window=8)
    off = []
    for stamp, T, seen in data:
        step(backend, stamp, seen, known)
        off.append(np.linalg.norm(backend.estimate(landmarks=False).T_world_left[:3, 3] - T[:3, 3]))
        gone = sorted(known - set(seen.ids.tolist()))
        backend.remove(gone)
        known.difference_update(gone)
    assert max(off) < 0.3, "where everything is relinearised piece by piece, it runs away by metres"
    deviations = np.sqrt(np.diag(backend.estimate(landmarks=False).covariance))
    assert deviations[:3].min() > 0.09 and deviations[:3].max() < 0.15, "the start's uncertainty stays"
    assert deviations[3:].min() > 9


def test_a_landmark_close_by_does_not_explain_any_pixel():
    stereo = RectifiedStereo.of(KITTI)
    local, own = np.array([[-0.5, -1.0, 1.4]]), np.diag([0.05, 0.05, 1.5])[None] ** 2
    z = np.array([[585.0, 131.6, 570.8]])  # of a point 27 m away
    noise = residual_noise(stereo, 0.7, local, own, z)
    h, _ = stereo.project(local)
    r = (z - h)[0]
    assert r @ np.linalg.solve(noise[0], r) > 1000


def test_a_track_that_cannot_be_triangulated_does_not_end_the_solver():
    """Three real measurements that agree with no point in front of the cameras; gtsam's default mode throws."""
    z = [[233.301, 163.173, 225.768], [222.659, 163.48, 214.243], [211.126, 164.15, 205.841]]
    motion = np.array([[0.000238, 0.0015, -0.000333, -0.028819, -0.056063, 1.498171], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    T = [np.eye(4), se3.exp(motion[0])]
    T.append(T[1] @ se3.exp(np.array([0.001766, 0.001835, -0.00027, -0.031685, -0.045795, 1.462946])))
    make = FactorMaker(RectifiedStereo.of(KITTI), EstimatorModels(pixel_sigma=0.7))
    values = gtsam.Values()
    for i, pose in enumerate(T):
        values.insert(pose_key(i), gtsam.Pose3(gtsam.Rot3.ClosestTo(pose[:3, :3]), pose[:3, 3]))
    factor = make.smart([make.point(row) for row in z], [pose_key(i) for i in range(3)])
    factor.linearize(values)


@pytest.mark.parametrize(("depth", "refined"), [(10.0, False), (30.0, False), (300.0, True)])
def test_only_far_points_are_refined_and_near_ones_are_the_same_without(depth, refined):
    stereo, rng = RectifiedStereo.of(KITTI), np.random.default_rng(0)
    make = FactorMaker(stereo, EstimatorModels(pixel_sigma=0.7))
    values, keys, points = gtsam.Values(), [pose_key(i) for i in range(5)], []
    for i, key in enumerate(keys):
        values.insert(key, gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * i, 0.0, 0.5 * i])))
        z, _ = stereo.project(np.array([[1.0 - 0.1 * i, 0.5, depth - 0.5 * i]]))
        points.append(make.point((z[0] + 0.7 * rng.standard_normal(3)).tolist()))
    assert make._is_far(points) == refined
    assert make._is_far([*points[:-1], make.point([600.0, 180.0, np.nan])])
    if not refined:
        as_it_is = make.smart(points, keys).linearize(values).information()
        make._linear = make._refined
        with_more = make.smart(points, keys).linearize(values).information()
        np.testing.assert_allclose(as_it_is, with_more, atol=0.03 * np.abs(with_more).max())


def test_a_map_may_be_looked_at_before_the_camera_is_in_it():
    backend = SmootherBackend(RIG, MODELS)
    ids, covariances = np.arange(3), np.tile(1e-4 * np.eye(3), (3, 1, 1))
    backend.insert(ids, np.array([[0, 0, 5.0], [1, 0, 5], [0, 1, 6]]), covariances)
    backend.predict(0.0)
    np.testing.assert_allclose(backend.estimate().covariances, covariances)
    wrong = Observations(ids, np.array([[600.0, 400], [10, 10], [20, 460]]), np.full((3, 2), np.nan))
    assert len(backend.update(wrong).rejected) == 3
    np.testing.assert_allclose(backend.estimate().covariances, covariances)


def test_an_infinite_right_pixel_is_refused():
    with pytest.raises(MeasurementError, match="infinite"):
        Observations(np.arange(1), np.zeros((1, 2)), np.array([[np.inf, 0.0]]))


def test_batch_leaves_nothing_out():
    with pytest.raises(ConfigurationError, match="lag"):
        BatchBackend(RIG, MODELS, lag=20)
    data = drive(70, points=300)
    backend = BatchBackend(RIG, MODELS)
    run(backend, data)
    assert len(backend.trajectory()) == 70
    assert backend._smoother.measurement_log.history.first == 0


def test_a_held_pose_gets_back_its_covariance_from_the_solver_that_holds_it():
    rng = np.random.default_rng(2)
    A, B = rng.normal(0, 1, (2, 6, 6))
    known, measured = A @ A.T + np.eye(6), 50 * (B @ B.T)  # information of what left, and of the rest
    held = ReferencePose(pose_key(3), np.eye(4), known, np.linalg.inv(known))
    P = np.linalg.inv(1e4 * known + known + measured)  # it is held by so many times what is known of it
    found = held.with_covariance_from(P)
    truth = np.linalg.inv(known + measured)
    np.testing.assert_allclose(found.covariance, truth, rtol=1e-6, atol=1e-6 * np.abs(truth).max())
    assert np.trace(found.covariance) < 0.9 * np.trace(held.covariance)
    assert held.with_covariance_from(np.linalg.inv(1e4 * known - np.eye(6))) is held  # digits that are lost


def test_queries_are_pure_with_a_short_lag():
    hostile.queries_are_pure(partial(SmootherBackend, lag=4, window=3, track=3, explicit=5))
