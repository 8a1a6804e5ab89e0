"""Runs of the EKF on simulated scenes, for its tests."""

import numpy as np

from backends.ekf import EkfBackend
from backends.ekf.covariance import CAMERA, HEAD, Covariance
from slam.data import Observations
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import Scene, path, run, scene

FORWARD, STILL = np.array([0, 0, 1.5]), np.zeros(3)
YAW, ROLL = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
MODELS = EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5)
DRIVE = scene(path(30, 0.1, FORWARD, 0.3 * YAW), points=300)  # of 30 frames, that turns


def errors(backend: EkfBackend, truth: np.ndarray) -> np.ndarray:
    """Largest rotation [rad] and translation error [m] over the trajectory."""
    xi = se3.log(se3.inverse(truth) @ backend.trajectory().poses)
    return np.array([np.linalg.norm(xi[:, :3], axis=1).max(), np.linalg.norm(xi[:, 3:], axis=1).max()])


def dense(covariance: Covariance) -> np.ndarray:
    """Of camera and landmarks, as one matrix (12 + 3N, 12 + 3N)."""
    rows = np.r_[:CAMERA, HEAD : len(covariance.P)]
    return covariance.P[rows[:, None], rows]


def halfway(data: Scene, frames: int, models: EstimatorModels = MODELS, **options) -> tuple[EkfBackend, set[int]]:
    """A filter after some frames of a scene, and the landmarks it knows."""
    backend, known = EkfBackend(data.rig, models, **options), set()
    run(backend, list(data)[:frames], known)
    return backend, known


def predicted(data: Scene, frames: int, **options) -> tuple[EkfBackend, Observations]:
    """A filter with frame number `frames` predicted, and what it will see there of its map."""
    backend, known = halfway(data, frames, **options)
    backend.predict(float(data.stamps[frames]))
    seen = data.observations[frames]
    return backend, seen.select(np.array([i in known for i in seen.ids.tolist()]))
