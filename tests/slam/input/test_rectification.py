from dataclasses import replace

import numpy as np
import pytest

import backends
from slam.config import SystemConfig
from slam.data import StereoFrame
from slam.errors import ConfigurationError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.input.features import Rectification, outside_masks
from slam.models import models_for
from slam.system import StereoSlam
from tests.slam.scene import GENERAL_RIG, Cloud


def test_a_rig_with_lenses_gives_what_its_rectified_pair_gives():
    """In pixels of its own images and with poses of its own left camera."""
    ways = GENERAL_RIG.rectified
    X, config = ways.T_left_rectified, SystemConfig()
    A = se3.adjoint(X)
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
        P, J = A @ other.estimate.covariance @ A.T, A @ other.common.jacobian
        np.testing.assert_allclose(result.estimate.covariance, P, atol=1e-12 * np.trace(P))
        np.testing.assert_allclose(result.common.jacobian, J, atol=1e-12)
        n, recent = len(other.recent), result.recent
        np.testing.assert_allclose(recent.poses @ X, other.recent.poses, atol=1e-12)
        P = np.kron(np.eye(n), A) @ other.recent.covariance @ np.kron(np.eye(n), A).T
        np.testing.assert_allclose(recent.covariance, P, atol=1e-12 * np.trace(P))
    np.testing.assert_allclose(system.trajectory().poses @ X, inside.trajectory().poses, atol=1e-12)
    np.testing.assert_allclose(system.estimate().positions, inside.estimate().positions, atol=1e-12)


def test_a_back_end_with_lenses_is_refused():
    with pytest.raises(ConfigurationError, match="rectified"):
        StereoSlam(GENERAL_RIG, None, backends.create("window", GENERAL_RIG))


def test_what_is_in_pixels_is_scaled():
    models, scale = models_for("driving"), GENERAL_RIG.rectified.scale
    inside = Rectification(GENERAL_RIG).models(models)
    assert inside.pixel_sigma == pytest.approx(scale * models.pixel_sigma)
    assert inside.objects.drift == pytest.approx(scale * models.objects.drift)


def test_a_fisheyes_pixel_across_its_axis_is_no_right_pixel():
    """In the rectified pair it lies at infinity."""
    camera = {"K_left": [[190, 0, 256], [0, 190, 256], [0, 0, 1]], "D_left": [0.0, 0, 0, 0], "fisheye": True}
    rig = StereoRig.from_pinhole(**camera, size=(512, 512), baseline=0.1)
    features, _ = Cloud(60, rig=rig).features(np.eye(4), 0.0, 0.1)
    across = 256 - 190 * (np.pi / 2 - 1e-4) / np.sqrt(2)
    features.uv_right[0] = across
    inside = Rectification(rig).features_in(features)
    assert np.abs(rig.rectified.rectify_right(features.uv_right[:1])).max() > 1e5
    assert np.isnan(inside.uv_right[0]).all() and np.isfinite(inside.uv_right[1:]).all()


def test_features_in_pixels_of_the_rectified_pair_are_not_taken_there_again():
    raw, _ = Cloud(200, rig=GENERAL_RIG).features(np.eye(4), 0.0, 0.1)
    inside = Rectification(GENERAL_RIG).features_in(raw)
    marked = replace(inside, rectified=True)
    assert Rectification(GENERAL_RIG).features_in(marked) is marked
    row, column = np.indices((GENERAL_RIG.height, GENERAL_RIG.width))
    masks = column < GENERAL_RIG.width // 2, row < GENERAL_RIG.height // 2  # of the images as they were taken
    frame = StereoFrame(0, 0.0, *masks, *masks)
    expected = outside_masks(raw.select(np.isin(raw.response, inside.response)), frame, GENERAL_RIG)
    found = outside_masks(marked, frame, GENERAL_RIG)
    np.testing.assert_array_equal(found.response, expected.response)
    np.testing.assert_array_equal(found.has_stereo, expected.has_stereo)
    assert 0 < len(found) < len(marked) and 0 < found.has_stereo.sum() < len(found)
