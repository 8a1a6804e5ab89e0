"""The rig's uncertainty in poses and landmarks: its sensitivities against what a wrong rig really does."""

from dataclasses import replace

import numpy as np
import pytest

from slam.calibration import RigCorrection, RigModel, RigPosterior, SelfCalibration, SelfCalibrationConfig
from slam.calibration.estimator import BASELINE, RemainingRigError
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.geometry.se3 import inverse, log
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.tracks.config import MapConfig
from tests.slam.scene import RIG, Cloud, path

#: By which share of an error's effect each may be off: the smoother's pose and landmarks are followed one by one, by
#: the gains of each frame, where its graph solves for all of the lag together.
SHARES = {"ekf": 0.05, "iekf": 0.05, "smoother": 0.25, "window": 0.05}
BACKENDS = ["ekf", "window", *(pytest.param(name, marks=pytest.mark.slow) for name in ("iekf", "smoother"))]


class NeverLearns(SelfCalibrationConfig):
    """No view has so many features."""

    minimum_common = 10_000


NEVER_LEARNS = NeverLearns()
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
    z = MODEL.rows(points - MODEL.field(points)[:, :3] @ delta)
    return replace(features, uv_left=z[:, :2].copy(), uv_right=np.column_stack([z[:, 2], z[:, 1]]))


def error_of(name: str, size: float) -> np.ndarray:
    delta = np.zeros(len(MODEL.names))
    delta[MODEL.names.index(name)] = size
    return delta


def run(backend: str, delta: np.ndarray, frames: int = 30) -> tuple[StereoSlam, np.ndarray]:
    cloud, system = Cloud(150), StereoSlam(RIG, None, backend, config=CONFIG)
    truth = path(frames)
    for k, T in enumerate(truth):
        system.process_features(with_error(cloud.features(T, k / 30)[0], delta))
    return system, truth[-1]


def test_what_is_followed_moves_rows_as_errors_of_the_rig_do():
    """By each parameter, by a longer baseline, and by the correction that the rows have had already."""
    rng, calibration = np.random.default_rng(0), SelfCalibration(RIG, NEVER_LEARNS)
    z = rng.uniform([0, 0, -100], [RIG.width, RIG.height, RIG.width], (50, 3))
    z[0, 2] = np.nan
    calibration.applied = RigCorrection(MODEL, 1e-3 * rng.normal(size=len(MODEL.names)))
    found, size = RemainingRigError(calibration).field(z), 1e-7
    for k in range(len(MODEL.names)):
        off = RigCorrection(MODEL, size * np.eye(len(MODEL.names))[k]).rows(z) - z
        np.testing.assert_allclose(found[:, :, k], off / size, atol=1e-3)
    np.testing.assert_allclose(z[:, 2] + BASELINE * found[:, 2, -2], z[:, 2] + BASELINE * (z[:, 0] - z[:, 2]))
    np.testing.assert_allclose(found[:, :, -1], -found[:, :, :-2] @ calibration.applied.parameters)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("name", "size"), [("yaw", 1e-3), ("right_f", 2e-3), ("right_k1", 5e-3)])
def test_the_pose_moves_as_its_sensitivity_says(backend, name, size):
    delta = error_of(name, size)
    system, T_true = run(backend, delta)
    T = system.backend.estimate(landmarks=False).T_world_left
    actual = log(inverse(T) @ T_true)
    predicted = system.backend.sensitivities([])[0][:, :-2] @ delta
    assert np.linalg.norm(actual[3:]) > 1e-3  # the rig's error does something: millimetres at least
    assert np.linalg.norm(predicted - actual) < SHARES[backend] * np.linalg.norm(actual)


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
    ids = system.landmarks.ids
    estimated, by_rig = system.backend.positions(ids), system.backend.sensitivities(ids)[1]
    actual = cloud.points[[points[i] for i in ids.tolist()]] - estimated
    predicted = by_rig[:, :, :-2] @ delta
    assert np.linalg.norm(predicted - actual) < 0.1 * np.linalg.norm(actual)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_known_of_the_rig_is_in_the_covariances(backend):
    system, truth = run(backend, np.zeros(len(MODEL.names)), frames=20)
    result = system.process_features(Cloud(150).features(truth, 1.0)[0])
    plain, whole = system.backend.estimate(), system.estimate()
    extra = whole.covariance - plain.covariance
    np.testing.assert_allclose(result.common.covariance, extra, rtol=1e-6, atol=1e-12)
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


@pytest.mark.parametrize(
    ("backend", "options", "revises"),
    [
        ("ekf", {}, False),
        ("window", {}, True),
        ("smoother", {"lag": None}, True),
        ("smoother", {"lag": 5, "past": 3}, False),
    ],
    ids=["ekf", "window", "smoother", "bounded smoother"],
)
def test_poses_as_given_keep_the_error_that_a_back_end_takes_out_of_its_path(backend, options, revises):
    system = StereoSlam(RIG, None, backend, config=replace(CONFIG, backend=options))
    cloud, truth, mean = Cloud(150), path(30), error_of("yaw", 1e-3)
    revised = None
    for k, T in enumerate(truth):
        if k == 19:
            system.calibration._own = RigPosterior(mean, 1e-4 * system.calibration._own.covariance)
            system.calibration._motion_agrees = lambda: True
        result = system.process_features(with_error(cloud.features(T, k / 30)[0], mean))
        revised = result.revision or revised
    assert revised is not None
    error = log(inverse(result.estimate.T_world_left) @ truth[-1])
    assert np.linalg.norm(error[3:]) > 1e-3
    known = result.common.jacobian @ result.common.root[:, -1]
    assert np.linalg.norm(known - error) < 0.2 * np.linalg.norm(error)
    np.testing.assert_array_equal(result.common.root[:-2, -1], mean)
    in_path = system._tracker.rig_error.common(system.backend, as_reported=False).root[:-2, -1]
    np.testing.assert_array_equal(in_path, 0 * mean if revises else mean)
