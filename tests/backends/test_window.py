"""The window back end: against the optimum, its consistency over many runs, and memory that does not grow."""

import numpy as np
import pytest

import backends
from experiments.long_run import Corridor
from experiments.long_run import run as run_long
from slam.data import Observations
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, cloud, observe, path, run, scene, step


def test_a_path_longer_than_the_window_is_the_optimum():
    """Most poses have left the window: marginalised, and revised by those that stayed."""
    sigma = 0.003  # the measurements are linear over their uncertainty
    models = EstimatorModels(
        MotionModel(0.3, 0.3), pixel_sigma=sigma, initial_position_sigma=1e-6, initial_rotation_sigma=1e-7
    )
    poses = path(25, 0.1, np.array([0.05, 0.0, 0.3]), np.array([0.0, 0.05, 0.0]))
    data = scene(poses, points=60, sigma=sigma, limit=20)
    window, batch = (backends.create(name, RIG, models=models) for name in ("window", "batch"))
    for backend in (window, batch):
        run(backend, data)
    mine, optimum = window.estimate(), batch.estimate()
    deviation = np.sqrt(np.diag(optimum.covariance))
    off = se3.log(se3.inverse(optimum.T_world_left) @ mine.T_world_left) / deviation
    assert np.abs(off).max() < 1e-3  # standard deviations
    np.testing.assert_allclose(np.sqrt(np.diag(mine.covariance)), deviation, rtol=1e-3)
    before, found = batch.trajectory().poses, window.trajectory().poses
    assert np.abs(se3.log(se3.inverse(before[5:]) @ found[5:]) / deviation).max() < 1e-3
    marginal = np.sqrt(np.diagonal(optimum.covariances, axis1=1, axis2=2))
    assert (np.abs(mine.positions - optimum.positions) / marginal).max() < 5e-3


def test_a_landmark_that_is_seen_alone_is_used():
    """It holds the pose by itself in some directions: there its residual is 0, and so is the variance of that."""
    motion, reports = MotionModel(1.0, 1.0), []
    poses = path(40, 0.1, np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.1, 0.0]))
    for seed in range(8):
        rng = np.random.default_rng(seed)
        backend = backends.create("window", RIG, models=EstimatorModels(motion, pixel_sigma=1.0))
        points, known = cloud(poses[:1], 12, rng, 1.5, 4.0), set()
        for k, T in enumerate(poses):
            seen = observe(T, points, 1.0, rng)
            reports.append(step(backend, 0.1 * k, seen.select(np.arange(len(seen)) < (12 if k < 5 else 1)), known))
    assert all(report.status.value != "failed" and not len(report.rejected) for report in reports)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_run():
    """Of the process, beyond the trajectory, once the poses that are still revised are there."""
    first, *_, last = run_long("window", 900, 300, Corridor(density=4, speed=2.0))
    assert last.frame - first.frame == 600
    assert 1e6 * (last.beyond - first.beyond) < 4096 * 600


def test_a_rig_whose_errors_move_nothing_changes_no_byte():
    """Consider columns stand beside the estimate: they take no part in its arithmetic."""
    found, data = [], scene(path(25, 0.1, np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.3, 0.0])), points=300)
    for field in (None, lambda z: np.zeros((*z.shape, 5))):
        backend = backends.create("window", RIG)
        if field is not None:
            backend.consider(field)
        run(backend, data)
        found.append((backend.estimate(), backend.trajectory()))
    (mine, one), (its, other) = found
    for name in ("T_world_left", "covariance", "positions", "covariances"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(its, name))
    np.testing.assert_array_equal(one.poses, other.poses)


def test_a_revision_that_takes_a_depth_away_leaves_a_path():
    rig = RIG
    backend = backends.create("window", rig, models=EstimatorModels(pixel_sigma=0.5))
    backend.predict(0.0)
    depth = rig.left.fu * rig.baseline / 0.15  # of a disparity of 0.15 px
    points = np.array([[0.1 * depth, 0.0, depth], [0.3, 0.2, 4.0], [-0.4, 0.1, 5.0], [0.2, -0.3, 6.0], [0.0, 0.3, 3.0]])
    left, right = rig.project(points)
    seen = Observations(np.arange(5), left, right)
    backend.add(seen)
    backend.predict(0.1)
    backend.update(seen)
    backend.revise(lambda z: z + np.array([0.0, 0.0, 0.5]))
    assert len(backend.trajectory()) == 2


@pytest.mark.parametrize("name", ["smoother", "window"])
def test_a_revision_moves_the_past_and_not_the_newest_pose(name):
    """With disparities 3 % larger the path so far is 3 % shorter; the next pose is where it would have been."""
    last, data = 11, scene(path(12, 0.1, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.03, 0.0])), points=200)
    mended, as_it_was = (backends.create(name, RIG, models=EstimatorModels(MotionModel(0.5, 0.5))) for _ in range(2))
    known: list[set[int]] = [set(), set()]
    for k, (stamp, _, seen) in enumerate(data):
        right = seen.uv_right + np.outer(0.03 * (seen.uv_left - seen.uv_right)[:, 0], [1.0, 0.0])
        wrong = Observations(seen.ids, seen.uv_left, right)
        if k == last:
            mended.revise(lambda z: z - np.outer(0.03 / 0.97 * (z[:, 0] - z[:, 2]), [0.0, 0.0, 1.0]))
        for backend, ids, given in zip((mended, as_it_was), known, (seen if k == last else wrong, wrong)):
            step(backend, stamp, given, ids)
    ours, theirs = (backend.trajectory().positions for backend in (mended, as_it_was))
    assert np.linalg.norm(ours[-1] - theirs[-1]) < 4e-3
    assert np.linalg.norm(ours[0] - theirs[0]) > 0.02


def test_a_landmark_known_in_the_world_is_as_uncertain_as_the_pose():
    pose = np.eye(4)
    pose[:3, :3] = se3.so3_exp(np.array([0.0, np.pi / 2, 0.0]))
    models = EstimatorModels(initial_position_sigma=0.3, initial_rotation_sigma=0.05, T_world_left=pose.tolist())
    covariances = np.diag([0.04, 1e-4, 1e-4])[None]  # along what the camera sees as depth
    deviations = []
    for name in ("ekf", "window"):
        backend = backends.create(name, RIG, models=models)
        backend.insert(np.array([7]), (pose[:3, :3] @ [0.1, 0.1, 5.0])[None], covariances)
        prediction = backend.predict(0.0)
        deviations.append(np.sqrt(np.trace(prediction.innovation[0])))
    assert deviations[1] == pytest.approx(deviations[0], rel=0.05)


def test_landmarks_that_no_frame_measures_for_a_while_are_as_uncertain_as_in_the_smoother():
    """Others are measured; the covariances of these are not computed anew, but follow the camera's motion."""
    deviations = {}
    for name in ("smoother", "window"):
        rng, known = np.random.default_rng(0), set()
        poses = path(40, 0.1, np.array([0.02, 0.0, 0.05]), np.array([0.0, 0.02, 0.0]))
        points = cloud(poses[:1], 60, rng, 3, 8)
        backend = backends.create(name, RIG, models=EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5))
        for k, T in enumerate(poses):
            seen = observe(T, points, 0.5, rng, 60)
            step(backend, 0.1 * k, seen.select((k < 30) | (seen.ids % 3 > 0)), known)
        prediction = backend.predict(4.0)
        deviations[name] = np.trace(prediction.innovation, axis1=1, axis2=2)[prediction.ids % 3 == 0]
    np.testing.assert_allclose(deviations["window"], deviations["smoother"], rtol=0.05)


def test_landmarks_known_in_the_world_stay_known_beyond_the_priors_limit():
    deviations = []
    for limit in (5, 150):
        backend = backends.create("window", RIG, models=EstimatorModels(pixel_sigma=0.5), landmarks=limit)
        poses = path(40, 0.1, np.array([0.0, 0.0, 0.1]), np.zeros(3))
        rng = np.random.default_rng(0)
        points, known = cloud(poses, 40, rng), set(range(40))
        backend.insert(np.arange(40), points, np.tile(1e-6 * np.eye(3), (40, 1, 1)))
        for k, T in enumerate(poses):
            step(backend, 0.1 * k, observe(T, points, 0.5, rng), known)
        deviations.append(np.sqrt(np.trace(backend.estimate().covariance[3:, 3:])))
    assert deviations[0] < 2 * deviations[1]
