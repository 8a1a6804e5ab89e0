"""Which feature continues which track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.bodies.following import follow
from slam.geometry.se3 import transform
from tests.slam.bodies.test_recovery import POINTS, begin, frame_of, scene


@pytest.mark.parametrize(("missed", "by_both"), [(1, False), (2, True)])
def test_a_body_that_was_not_measured_has_no_claim_to_features(missed, by_both):
    body, tracks, features, truth = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    free = begin(tracks, features, np.arange(4), transform(truth, POINTS[:4]))
    tracks.row[:] = -1
    follow(tracks, {1: replace(body, missed=missed)}, frame_of(features, 25.0))
    assert (np.sort(np.append(tracks.row[members], tracks.row[free])) >= 0).sum() == (8 if by_both else 4)
    if by_both:
        assert tracks.row[free].tolist() == tracks.row[members].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("missed", "keeps"), [(1, False), (2, True)])
def test_points_of_a_body_that_is_out_of_sight_keep_their_looks(missed, keeps):
    body, tracks, features, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    before = tracks.look[members].copy()
    features.descriptors[:] = np.roll(features.descriptors, 20, axis=1) * 0.3 + features.descriptors * 0.9
    tracks.row[:] = -1
    follow(tracks, {1: replace(body, missed=missed)}, frame_of(features, 25.0))
    assert (tracks.row[members] >= 0).all()
    np.testing.assert_array_equal(tracks.look[members], before if keeps else features.descriptors)


def test_landmarks_that_were_found_keep_their_features_wherever_they_were_expected():
    """Also members of a body that is lost."""
    body, tracks, features, truth = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    free = begin(tracks, features, np.arange(4), transform(truth, POINTS[:4]))
    tracks.row[:] = -1
    tracks.set_features(np.array([free[0], free[1], members[2]]), np.array([1, 0, 3]))
    follow(tracks, {1: replace(body, missed=2)}, frame_of(features, 25.0))
    assert tracks.row[[free[0], free[1], members[2]]].tolist() == [1, 0, 3]
