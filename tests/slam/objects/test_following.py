"""Which feature continues which track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.geometry.se3 import transform
from slam.objects.config import ObjectsConfig
from slam.objects.following import follow
from tests.slam.objects.test_recovery import POINTS, RIG, SIGMA, scene


@pytest.mark.parametrize(("missed", "by_both"), [(1, False), (2, True)])
def test_a_body_that_was_not_measured_has_no_claim_to_features(missed, by_both):
    body, tracks, features, truth = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    free = tracks.begin(np.arange(10, 14), features, np.arange(4), transform(truth, POINTS))
    local = RIG.triangulate(features.uv_left, features.uv_right)
    config = ObjectsConfig(max_speed=25.0)
    follow(tracks, {1: replace(body, missed=missed)}, [], np.eye(4), features, local, 0.1, RIG, SIGMA, config)
    assert (np.sort(np.append(tracks.row[members], tracks.row[free])) >= 0).sum() == (8 if by_both else 4)
    if by_both:
        assert tracks.row[free].tolist() == tracks.row[members].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("missed", "keeps"), [(1, False), (2, True)])
def test_points_of_a_body_that_is_out_of_sight_keep_their_looks(missed, keeps):
    body, tracks, features, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    before = tracks.descriptors[members].copy()
    features.descriptors[:] = np.roll(features.descriptors, 20, axis=1) * 0.3 + features.descriptors * 0.9
    local = RIG.triangulate(features.uv_left, features.uv_right)
    config = ObjectsConfig(max_speed=25.0)
    follow(tracks, {1: replace(body, missed=missed)}, [], np.eye(4), features, local, 0.1, RIG, SIGMA, config)
    assert (tracks.row[members] >= 0).all()
    np.testing.assert_array_equal(tracks.descriptors[members], before if keeps else features.descriptors)
