"""The rig's uncertainty in poses and landmarks: its sensitivities against what a wrong rig really does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import backends
from slam.calibration import RigModel, SelfCalibrationConfig
from slam.calibration.consider import SchmidtFilter
from slam.config import SystemConfig
from slam.data import Observations, StereoFeatures
from slam.geometry.se3 import inverse, log, transform
from slam.mapping.config import MapConfig
from slam.models import EstimatorModels
from slam.system import StereoSlam
from tests.slam.scene import RIG, Cloud, path

BACKENDS = ("ekf", "iekf", "smoother", "window")
NEVER_LEARNS = SelfCalibrationConfig(minimum_common=10_000)
CONFIG = SystemConfig(
    models=EstimatorModels(pixel_sigma=0.3),
    map=MapConfig(target_in_view=60, max_depth_error=0.3),
    self_calibration=NEVER_LEARNS,
)
MODEL = RigModel(RIG)


def with_error(features: StereoFeatures, delta: np.ndarray) -> StereoFeatures:
    """What a rig that is off by `delta` sees: the correction by it gives the ideal pixels."""
    z = np.column_stack([features.uv_left, features.uv_right[:, 0]])
    points = MODEL.points(z)
    z = MODEL.rows(points - MODEL.field(points) @ delta)
    return replace(features, uv_left=z[:, :2].copy(), uv_right=np.column_stack([z[:, 2], z[:, 1]]))


def error_of(name: str, size: float) -> np.ndarray:
    delta = np.zeros(len(MODEL.names))
    delta[MODEL.names.index(name)] = size
    return delta


def run(backend: str, delta: np.ndarray, frames: int = 45) -> tuple[StereoSlam, np.ndarray]:
    cloud, system = Cloud(150), StereoSlam(RIG, None, backend, config=CONFIG)
    truth = path(frames)
    for k, T in enumerate(truth):
        system.process_features(with_error(cloud.features(T, k / 30)[0], delta))
    return system, truth[-1]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("name", "size"), [("yaw", 1e-3), ("right_f", 2e-3), ("right_k1", 5e-3)])
def test_the_pose_moves_as_its_sensitivity_says(backend, name, size):
    delta = error_of(name, size)
    system, T_true = run(backend, delta)
    T = system.backend.estimate(landmarks=False).T_world_left
    actual = log(inverse(T) @ T_true)
    predicted = system._session.rig_error.uncertainty.pose[:, : len(delta)] @ delta
    assert np.linalg.norm(actual[3:]) > 1e-3  # the rig's error does something: millimetres at least
    # what the landmarks' errors have in common is left out: up to a fifth, most of it across the way
    assert np.linalg.norm(predicted - actual) < 0.25 * np.linalg.norm(actual)


@pytest.mark.parametrize("backend", BACKENDS)
def test_landmarks_move_as_their_sensitivities_say(backend):
    delta = error_of("right_cx", 1e-3)
    cloud, truth = Cloud(150), path(10)
    system = StereoSlam(RIG, None, backend, config=CONFIG)
    points = {}
    for k, T in enumerate(truth):
        features, ids = cloud.features(T, k / 30)
        result = system.process_features(with_error(features, delta))
        points.update({i: ids[row] for i, row in zip(result.added.tolist(), result.added_features)})
    marks = system._session.rig_error.uncertainty.landmarks
    ids, by_rig = marks.ids, marks.by_rig
    estimated = system.backend.positions(ids)
    actual = cloud.points[[points[i] for i in ids.tolist()]] - estimated
    predicted = by_rig[:, :, : len(delta)] @ delta
    assert np.linalg.norm(predicted - actual) < 0.1 * np.linalg.norm(actual)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_known_of_the_rig_is_in_the_covariances(backend):
    system, _ = run(backend, np.zeros(len(MODEL.names)), frames=20)
    plain, whole = system.backend.estimate(), system.estimate()
    extra = whole.covariance - plain.covariance
    assert np.linalg.eigvalsh(extra).min() > -1e-12
    assert np.trace(extra[3:, 3:]) > 0
    assert (np.linalg.eigvalsh(whole.covariances - plain.covariances) > -1e-9).all()
    exact = replace(CONFIG, self_calibration=replace(NEVER_LEARNS, enabled=False))
    other = StereoSlam(RIG, None, backend, config=exact)
    cloud = Cloud(150)
    for k, T in enumerate(path(20)):
        result = other.process_features(cloud.features(T, k / 30)[0])
    np.testing.assert_array_equal(result.estimate.covariance, other.backend.estimate(landmarks=False).covariance)
    assert not result.common.jacobian.size


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_result_says_what_its_error_shares_with_other_frames(backend):
    system, truth = StereoSlam(RIG, None, backend, config=CONFIG), path(4)
    cloud = Cloud(150)
    for k, T in enumerate(truth):
        result = system.process_features(cloud.features(T, k / 30)[0])
    apart = result.estimate.covariance - result.common.covariance
    np.testing.assert_allclose(apart, system.backend.estimate(landmarks=False).covariance, rtol=1e-6, atol=1e-12)
    assert np.trace(result.common.covariance) > 0


@pytest.mark.parametrize(
    ("backend", "options", "revises"),
    [("ekf", {}, False), ("smoother", {"lag": None}, True), ("smoother", {"lag": 5, "past": 3, "motion": 0.0}, False)],
    ids=["ekf", "smoother", "bounded smoother"],
)
def test_poses_as_given_keep_the_error_that_a_back_end_takes_out_of_its_path(backend, options, revises):
    system = StereoSlam(RIG, None, backend, config=replace(CONFIG, backend=options))
    cloud, truth = Cloud(150), path(20)
    for k, T in enumerate(truth):
        if k == 19:
            known = system.calibration._solution
            mean = error_of("yaw", 1e-3)
            system.calibration._solution = replace(known, mean=mean, inner=1e-4 * known.inner)
            system.calibration._motion_agrees = lambda: True
        result = system.process_features(cloud.features(T, k / 30)[0])
    assert result.revision is not None
    np.testing.assert_array_equal(result.common.root[:-2, -1], mean)
    in_path = system._session.rig_error.common(as_reported=False).root[:-2, -1]
    np.testing.assert_array_equal(in_path, 0 * mean if revises else mean)


def test_a_known_error_stays_in_a_path_that_is_not_revised():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(2, 6, 40)])
    ids = np.arange(40)
    uncertainty = SchmidtFilter(MODEL, CONFIG.models, error_of("right_cx", 0.0))
    none = np.zeros(0, np.int64)
    for k, T in enumerate(path(10)):
        uncertainty.observe(T, k / 30, ids, points)
        uncertainty.change(ids, points, none)
    step = error_of("right_cx", 1e-3)
    before = uncertainty.pose[:, : len(step)] @ step
    uncertainty.path_keeps(step, lambda wanted: points[wanted], landmarks_follow=True)
    np.testing.assert_allclose(uncertainty.pose[:, -1], before, atol=1e-12)
    uncertainty.observe(path(10)[-1], 10 / 30, ids, points)  # the landmarks moved with the pose: nothing brings it back
    np.testing.assert_allclose(uncertainty.pose[:, -1], before, atol=1e-9)


def there_and_back(delta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a filter takes the camera to be at the end of a way out, and back at the start; sensitivities there.

    There are new landmarks every four frames; those of the start are seen again at the end only.
    """
    rng, none = np.random.default_rng(1), np.zeros(0, np.int64)
    backend = backends.create("ekf", RIG, models=CONFIG.models)
    uncertainty = SchmidtFilter(MODEL, CONFIG.models, 0.0 * delta)
    points = np.column_stack([rng.uniform(-2, 2, (220, 2)), rng.uniform(3, 8, 220)])
    points[:, 2] += 0.2 * (np.arange(220) // 20)
    poses, sensitivities, known = [], [], set()
    for k in range(41):
        T, first = np.eye(4), 0 if k == 40 else 20 * (k // 4)
        T[2, 3] = 0.0 if k == 40 else 0.05 * k
        ids = np.arange(first, first + (20 if k == 40 else 40))
        uv_left, uv_right = RIG.project(transform(inverse(T), points[ids]))
        z = np.column_stack([uv_left, uv_right[:, 0]])
        z = MODEL.rows(MODEL.points(z) - MODEL.field(MODEL.points(z)) @ delta)
        seen = Observations(ids, z[:, :2].copy(), np.column_stack([z[:, 2], z[:, 1]]))
        old = np.isin(ids, list(known))
        backend.predict(k / 10)
        used = backend.update(seen.select(old)).used
        pose = backend.estimate(landmarks=False).T_world_left
        uncertainty.observe(pose, k / 10, used, backend.positions(used))
        backend.add(seen.select(~old))
        uncertainty.change(ids[~old], backend.positions(ids[~old]), none)
        known |= set(ids.tolist())
        poses.append(pose)
        sensitivities.append(uncertainty.pose[:, : len(delta)].copy())
    return np.array([poses[39], poses[40]]), np.array([sensitivities[39], sensitivities[40]])


def test_landmarks_of_the_start_bring_the_pose_back_as_they_do_in_a_filter():
    step = error_of("yaw", 1e-4)
    (before, J), (after, _) = there_and_back(-step), there_and_back(step)
    actual = log(inverse(after) @ before)
    predicted = J @ (2 * step)
    assert np.linalg.norm(actual[1]) < 0.5 * np.linalg.norm(actual[0])  # the start is known again
    for one, other in zip(predicted, actual):
        assert np.linalg.norm(one - other) < 0.15 * np.linalg.norm(actual[0])


def walked_after(blackout: int) -> float:
    """The largest sensitivity of a walk that begins when the camera has seen nothing for so many frames.

    Each landmark is seen in two frames of six.
    """
    rng, none, interval = np.random.default_rng(0), np.zeros(0, np.int64), 0.3
    uncertainty = SchmidtFilter(MODEL, CONFIG.models, np.zeros(len(MODEL.names)))
    ids, points = np.arange(60), np.column_stack([rng.uniform(-2, 2, (60, 2)), rng.uniform(3, 9, 60)])
    poses, largest = path(400)[::10], 0.0
    for k in range(blackout + 1):
        uncertainty.observe(poses[0], interval * k, none, np.zeros((0, 3)))
    uncertainty.change(ids, points, none)
    for k, T in enumerate(poses[1:]):
        local = transform(inverse(T), points)
        view = RIG.left.in_image(RIG.project(local)[0]) & (local[:, 2] > 0.3)
        seen = np.flatnonzero(view & ((ids + k) % 6 < 2))
        uncertainty.observe(T, interval * (blackout + k + 1), ids[seen], points[seen])
        largest = max(largest, float(np.abs(uncertainty.pose).max()))
    return largest


@pytest.mark.parametrize("blackout", [30, 400])
def test_a_stretch_without_sight_changes_no_sensitivity(blackout):
    """The walk begins where nothing is known of the pose in the world, and landmarks come and go."""
    assert walked_after(blackout) == pytest.approx(walked_after(0), rel=1e-3)
