"""All back ends assume the same: on a short problem that is nearly linear they give the same answer."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from slam.geometry import se3
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, path, run, scene


@pytest.mark.parametrize("name", [name for name in backends.names() if name != "ekf"])
def test_the_pose_and_its_covariance_are_the_filters(name):
    # With so little noise the measurements are linear over their uncertainty; what differed would be the models. The
    # start is known better than they could tell: else what a filter believes to learn by linearising again counts.
    sigma = 0.003
    models = EstimatorModels(
        MotionModel(0.3, 0.3), pixel_sigma=sigma, initial_position_sigma=1e-6, initial_rotation_sigma=1e-7
    )
    poses = path(8, 0.1, np.array([0.05, 0.0, 0.3]), np.array([0.0, 0.05, 0.0]))
    data = scene(poses, points=60, sigma=sigma, limit=20)
    estimates = []
    for each in ("ekf", name):
        backend = backends.create(each, RIG, models=models)
        run(backend, data)
        estimates.append(backend.estimate())
    filtered, other = estimates
    deviation = np.sqrt(np.diag(filtered.covariance))
    difference = se3.log(se3.inverse(filtered.T_world_left) @ other.T_world_left) / deviation
    assert np.abs(difference).max() < 1e-3  # standard deviations
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), deviation, rtol=1e-3)
    marginals = [np.sqrt(np.diagonal(e.covariances, axis1=1, axis2=2)) for e in estimates]
    np.testing.assert_allclose(marginals[1], marginals[0], rtol=0.02)
    assert (np.abs(other.positions - filtered.positions) / marginals[0]).max() < 5e-3


def test_the_smoother_gives_what_least_squares_does_where_velocities_are_well_known():
    """The motion model ties three poses: as a prediction of the third it would count twice what the first two tell."""
    models = EstimatorModels(MotionModel(0.02, 0.02), pixel_sigma=0.3)
    poses = path(16, 0.1, np.array([0.05, 0.0, 0.3]), np.array([0.0, 0.05, 0.0]))
    data = scene(poses, points=60, sigma=0.3, limit=8)
    estimates = []
    for name, options in (
        ("batch", {}),
        ("smoother", {"track": 1000, "lag": None}),
    ):  # it leaves nothing out
        backend = backends.create(name, RIG, models=models, **options)
        run(backend, data)
        estimates.append(backend.estimate())
    best, ours = estimates
    deviation = np.sqrt(np.diag(best.covariance))
    difference = se3.log(se3.inverse(best.T_world_left) @ ours.T_world_left) / deviation
    assert np.abs(difference).max() < 0.05  # standard deviations
    np.testing.assert_allclose(np.sqrt(np.diag(ours.covariance)), deviation, rtol=0.03)
