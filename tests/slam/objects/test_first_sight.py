"""What a body gives to points that have only just been seen: where it takes them, and how deep it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.data import StereoFeatures
from slam.geometry.se3 import transform
from slam.objects.config import ObjectsConfig
from slam.objects.following import follow
from slam.objects.points import shape_of
from tests.slam.objects.test_recovery import POINTS, RIG, SIGMA, scene


def test_a_body_takes_points_along_that_are_too_young_for_a_velocity():
    body, tracks, _, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    before = body.T.copy()
    before[0, 3] -= 1.2  # 56 px, where its speed allows 5
    points = np.append(POINTS, [[0.1, 0.1, 0.0]], axis=0)
    uv, uv_right = RIG.project(transform(body.T, points))
    features = StereoFeatures(
        0.0, uv, uv_right, np.ones(5), np.zeros(5), np.ones(5), np.ones(5, np.int8), np.eye(5, 64, dtype=np.float32)
    )
    (young,) = tracks.begin(np.array([10]), features, np.array([4]), transform(before, points[4:]))
    local, config = RIG.triangulate(uv, uv_right), ObjectsConfig(max_speed=1.0)
    follow(tracks, {1: replace(body, T_before=before)}, [], np.eye(4), features, local, 0.1, RIG, SIGMA, config)
    assert tracks.row[young] == 4


def test_the_noise_of_depth_is_no_extent():
    rng = np.random.default_rng(0)
    noise = np.array([0.02, 0.02, 0.6])
    points = rng.uniform(-1, 1, (400, 3)) + noise * rng.standard_normal((400, 3))
    shape = shape_of(points, np.tile(np.diag(noise**2), (400, 1, 1)))
    assert np.diag(shape.covariance) == pytest.approx([1 / 3] * 3, rel=0.25)  # with the noise: 0.69 in depth
