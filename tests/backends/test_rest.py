"""A step at rest: a zero-velocity update."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from slam.data import Observations
from slam.geometry.se3 import exp, inverse, transform
from tests.slam.scene import RIG


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother", "window"])
def test_at_rest_neither_the_pose_nor_its_covariance_changes_and_the_velocity_is_zero(name):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (30, 2)), rng.uniform(2, 5, 30)])
    backend, ids = backends.create(name, RIG), np.arange(30)

    def seen(T: np.ndarray) -> Observations:
        z, _ = RIG.project_stereo(transform(inverse(T), points), jacobian=False)
        return Observations(ids, z[:, :2], z[:, [2, 1]])

    backend.predict(0.0)
    backend.add(seen(np.eye(4)))
    for k in range(1, 5):
        backend.predict(0.1 * k)
        backend.update(seen(exp(k * np.array([0, 0, 0, 0.02, 0, 0]))))
    before = backend.estimate(landmarks=False)
    rests = backend.predict_at_rest(0.5)
    np.testing.assert_allclose(rests.T_world_left, before.T_world_left, atol=1e-12)
    np.testing.assert_allclose(backend.estimate(landmarks=False).covariance, before.covariance, rtol=1e-6, atol=3e-10)
    np.testing.assert_allclose(backend.predict(0.6).T_world_left, before.T_world_left, atol=1e-12)
    backend.update(seen(before.T_world_left))  # it is no motion that begins again
    np.testing.assert_allclose(backend.estimate(landmarks=False).T_world_left, before.T_world_left, atol=1e-3)
    assert len(backend.trajectory().stamps) == 7
