"""Running on left images alone, in a prior map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.data import FrameStatus
from slam.geometry import se3
from slam.mapping.map_io import SavedMap
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.tracks.localizer import Localizer, nowhere
from tests.slam.scene import RIG, Cloud

BACKENDS = ("ekf", "smoother", "window")


def test_the_pose_in_a_map_from_left_pixels_alone():
    cloud, T = Cloud(120), se3.exp(np.array([0.05, -0.2, 0.1, 0.4, -0.1, 0.3]))
    known = map_of(cloud)
    features, _ = cloud.features(T, 0.0, 0.3)
    localizer = Localizer(RIG, SystemConfig().association, EstimatorModels(pixel_sigma=0.5))
    left = replace(features, uv_right=features.uv_right * np.nan)
    found = localizer.match(nowhere(0.0, np.eye(4)), known.rows, known.positions, left, seed=0)
    assert np.linalg.norm(se3.log(se3.inverse(T) @ found.T_world_left)[3:]) < 0.02
    other, _ = Cloud(120, seed=5).features(T, 0.0)
    assert not len(localizer.match(nowhere(0.0, np.eye(4)), known.rows, known.positions, other, seed=0))


def map_of(cloud, rows=slice(None)):
    n = len(cloud.points[rows])
    return SavedMap(
        np.arange(n), cloud.points[rows], np.tile(1e-4 * np.eye(3), (n, 1, 1)), cloud.descriptors[rows],
        cloud.laplacian[rows], np.ones(n, np.int64), np.ones(n, np.int64),
    )  # fmt: skip


@pytest.mark.parametrize("backend", BACKENDS)
def test_left_images_alone_in_a_prior_map(backend):
    """Half of the points is known; the others have no depth, so the map stays as it is."""
    cloud = Cloud(150)
    config, known = SystemConfig().with_settings(["models.pixel_sigma=0.5"]), map_of(cloud, slice(0, 75))
    system = StereoSlam(RIG, None, backend, config=config, prior_map=known)
    for k in range(30):
        T = se3.exp(np.array([0, 0, 0, 0.6 * k / 30, 0, 0]))
        features, _ = cloud.features(T, k / 30, 0.3)
        result = system.process_features(replace(features, uv_right=features.uv_right * np.nan))
        assert result.status is FrameStatus.TRACKED and not len(result.added)
        assert np.linalg.norm(result.estimate.T_world_left[:3, 3] - T[:3, 3]) < 0.04
    assert np.isin(system.estimate().ids, known.ids).all()
