from dataclasses import replace

import numpy as np
import pytest

import backends
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.input.rectification import Rectification
from slam.system import StereoSlam
from slam.testing import GENERAL_RIG
from tests.slam.scene import Cloud


def test_a_rig_with_lenses_gives_what_its_rectified_pair_gives():
    """In pixels of its own images and with poses of its own left camera."""
    ways = GENERAL_RIG.rectified
    X, config = ways.T_left_rectified, SystemConfig()
    models = Rectification(GENERAL_RIG).models(config.models)
    inside = StereoSlam(ways.rig, None, "window", config=replace(config, models=models))
    system = StereoSlam(GENERAL_RIG, None, "window", config=config)
    cloud = Cloud(200, rig=GENERAL_RIG)
    for k in range(8):
        T = se3.exp(np.array([0.0, 0.02 * k, 0.0, 0.0, 0.0, 0.05 * k]))
        features, _ = cloud.features(T, k / 30, 0.1)
        result = system.process_features(features)
        other = inside.process_features(Rectification(GENERAL_RIG).features_in(features))
        np.testing.assert_allclose(result.estimate.T_world_left @ X, other.estimate.T_world_left, atol=1e-12)
        np.testing.assert_allclose(result.estimate.T_world_left, T, atol=0.02)
        kept = np.isin(features.response, result.features.response)
        assert kept.sum() == len(result.features) > 100
        np.testing.assert_allclose(result.features.uv_left, features.uv_left[kept], atol=1e-6)
        assert np.trace(result.estimate.covariance) == pytest.approx(np.trace(other.estimate.covariance))
    np.testing.assert_allclose(system.trajectory().poses @ X, inside.trajectory().poses, atol=1e-12)
    np.testing.assert_allclose(system.estimate().positions, inside.estimate().positions, atol=1e-12)


def test_a_back_end_with_lenses_is_refused():
    with pytest.raises(ConfigurationError, match="rectified"):
        StereoSlam(GENERAL_RIG, None, backends.create("window", GENERAL_RIG))
