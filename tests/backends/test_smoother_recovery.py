"""A camera that has lost its way is seated again among the landmarks, by the smoother itself and without a guess."""

from __future__ import annotations

import numpy as np
import pytest

from backends.smoother import SmootherBackend
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from slam.window import recovery
from slam.window.pose_only import PoseProblem
from slam.window.stereo import RectifiedStereo
from tests.backends.scenes import RIG, cloud, observe, path, scene, step

MODELS = EstimatorModels(MotionModel(0.5, 0.5), pixel_sigma=0.5)
DT = 0.1


def drive(backend, poses, points, sigma, unseen=(), seed=0):
    """Take a back end along a path without a guess; the errors of the newest pose and what was rejected."""
    rng, known, errors, rejected = np.random.default_rng(seed), set(), [], []
    for k, T in enumerate(poses):
        seen = observe(T, points, sigma, rng)
        seen = seen.select(np.zeros(len(seen), bool)) if k in unseen else seen
        report = step(backend, k * DT, seen, known)
        errors.append(se3.log(se3.inverse(T) @ backend.estimate(landmarks=False).T_world_left))
        rejected.append(len(report.rejected))
    return np.array(errors), rejected


def moved_in_the_dark(frames: int):
    """A path (F, 4, 4) that looks round once and is turned by 150 degrees in frame 70, and points all around."""
    rng = np.random.default_rng(1)
    poses = path(frames, DT, np.array([0.1, 0.0, 0.1]), np.array([0.0, 1.0, 0.0]))
    directions = rng.standard_normal((400, 3)) * (1.0, 0.3, 1.0)
    points = directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(3.0, 8.0, (400, 1))
    poses[70:] = poses[70:] @ se3.exp(np.array([0.1, 2.6, -0.2, 0.5, 0.1, 0.0]))
    return poses, points


@pytest.mark.parametrize("lag", [None, 50])
def test_a_camera_that_was_moved_while_it_saw_nothing(lag):
    """It sees nothing for three frames, and is elsewhere then."""
    poses, points = moved_in_the_dark(90)
    errors, rejected = drive(SmootherBackend(RIG, MODELS, lag=lag), poses, points, 0.5, range(67, 70))
    assert sum(rejected[70:73]) > 30 and sum(rejected[74:]) < 10
    assert np.abs(errors[74:]).max() < 0.03


def test_what_is_known_of_the_pose_in_the_world_outlasts_the_lag():
    poses, points = moved_in_the_dark(110)
    backend = SmootherBackend(RIG, MODELS, lag=12)
    drive(backend, poses, points, 0.5, range(67, 70))
    assert backend.measurement_log.history.first > 80
    assert np.sqrt(np.diag(backend.estimate(landmarks=False).covariance)).max() < 0.3


@pytest.mark.parametrize(("lag", "seed"), [(None, 0), (None, 1), (50, 2)])
def test_a_map_that_begins_where_nobody_knows_how_the_camera_is_turned(lag, seed):
    """Two landmarks, then six seconds in the dark: no linearisation in the world holds for what is seen then."""
    rng = np.random.default_rng(seed)
    models = EstimatorModels(MotionModel(1.0, 1.0), pixel_sigma=4.0)
    turns = 0.3 * np.cumsum(rng.standard_normal((160, 3)), axis=0) * np.sqrt(DT)
    poses = [np.eye(4)]
    for k in range(1, 160):
        poses.append(poses[-1] @ se3.exp(DT * np.concatenate([0.5 * np.sin(turns[k]), 0.3 * np.cos(turns[k])])))
    poses = np.array(poses)
    points = np.concatenate([cloud(poses[:1], 2, rng), cloud(poses[80:], 60, rng, 2.0, 6.0)])
    backend = SmootherBackend(RIG, models, lag=lag)
    known, found, rejected = set(), [], 0
    for k, T in enumerate(poses):
        seen = observe(T, points, 4.0, rng, 12)
        seen = seen.select((seen.ids < 2) & (k < 10) if k < 70 else seen.ids >= 0)
        rejected += len(step(backend, k * DT, seen, known).rejected)
        found.append(backend.estimate(landmarks=False).T_world_left)
    moved = se3.inverse(np.array(found[90:-10])) @ np.array(found[100:])
    truth = se3.inverse(poses[90:-10]) @ poses[100:]
    off = np.linalg.norm(moved[:, :3, 3] - truth[:, :3, 3], axis=1)

    assert np.sqrt((off**2).mean()) < 0.1 and rejected < 60


def test_a_few_wrong_matches_that_agree_by_chance_move_nothing():
    rng, stereo = np.random.default_rng(0), RectifiedStereo.of(RIG)
    points = cloud(np.eye(4)[None], 60, rng)
    z, _ = stereo.project(points)
    wrong = rng.permutation(60)[: 60 - 8]
    z[wrong, :2] = rng.uniform(0, 480, (len(wrong), 2))
    z[wrong, 2] = z[wrong, 0] - rng.uniform(5, 60, len(wrong))
    noise = np.tile(4.0 * np.eye(3), (60, 1, 1))
    problem = PoseProblem(stereo, points, z, noise, np.eye(4), 100.0 * np.eye(6), 0.999)
    assert recovery.agreement(problem, np.eye(4), lambda: None, 0, False).used.sum() >= 8  # they are no chance
    z[:, :2] += rng.uniform(-150, 150, (60, 2))
    assert not recovery.agreement(problem, np.eye(4), lambda: None, 0, False).used.any()


@pytest.mark.parametrize(
    ("stamps", "seen_in"),
    [
        ([1e9, 1e9 + 0.1, 2e9, 2e9 + 0.1, 3e9], (0, 1)),
        ([1e-9, 1e9, 2e9], (0, 1, 2, 3)),
        ([1.0, 1.0 + 1e-9, 1e5], (0, 1)),
    ],
)
def test_covariances_hold_over_gaps_of_any_length(stamps, seen_in):
    data = scene(path(len(stamps) + 1, 0.1, np.array([0.0, 0.0, 0.5]), np.zeros(3)), points=60)
    backend, known = SmootherBackend(RIG, EstimatorModels(pixel_sigma=0.5)), np.zeros(0, np.int64)
    for k, (stamp, (_, _, seen)) in enumerate(zip([0.0, *stamps], data)):
        covariances = [backend.predict(stamp).covariance]
        if k in seen_in:
            old = np.isin(seen.ids, known)
            backend.update(seen.select(old))
            backend.add(seen.select(~old))
            known = np.union1d(known, seen.ids)
        for P in [*covariances, backend.estimate().covariance]:
            scale = np.sqrt(np.diag(P))
            assert np.linalg.eigvalsh(P / scale / scale[:, None]).min() > 0
