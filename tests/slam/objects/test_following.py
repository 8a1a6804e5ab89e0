"""Which feature continues which track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.data import StereoFeatures
from slam.geometry.se3 import transform
from slam.objects.following import follow
from tests.slam.objects.test_recovery import POINTS, RIG, frame_of, scene

NO_LANDMARK = np.full(5, -1)


@pytest.mark.parametrize(("missed", "by_both"), [(1, False), (2, True)])
def test_a_body_that_was_not_measured_has_no_claim_to_features(missed, by_both):
    body, tracks, features, truth = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    free = tracks.begin(np.arange(10, 14), features, np.arange(4), transform(truth, POINTS))
    follow(tracks, {1: replace(body, missed=missed)}, [], frame_of(features, 25.0), NO_LANDMARK)
    assert (np.sort(np.append(tracks.row[members], tracks.row[free])) >= 0).sum() == (8 if by_both else 4)
    if by_both:
        assert tracks.row[free].tolist() == tracks.row[members].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("missed", "keeps"), [(1, False), (2, True)])
def test_points_of_a_body_that_is_out_of_sight_keep_their_looks(missed, keeps):
    body, tracks, features, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    before = tracks.descriptors[members].copy()
    features.descriptors[:] = np.roll(features.descriptors, 20, axis=1) * 0.3 + features.descriptors * 0.9
    follow(tracks, {1: replace(body, missed=missed)}, [], frame_of(features, 25.0), NO_LANDMARK)
    assert (tracks.row[members] >= 0).all()
    np.testing.assert_array_equal(tracks.descriptors[members], before if keeps else features.descriptors)


def test_a_body_takes_points_along_that_are_too_young_for_a_velocity():
    body, tracks, _, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    before = body.T.copy()
    before[0, 3] -= 3.0  # 140 px: its speed and the noise of depth allow 1.9 m
    points = np.append(POINTS, [[0.1, 0.1, 0.0]], axis=0)
    uv, uv_right = RIG.project(transform(body.T, points))
    features = StereoFeatures(
        0.0, uv, uv_right, np.ones(5), np.zeros(5), np.ones(5), np.ones(5, np.int8), np.eye(5, 64, dtype=np.float32)
    )
    (young,) = tracks.begin(np.array([10]), features, np.array([4]), transform(before, points[4:]))
    follow(tracks, {1: replace(body, T_before=before)}, [], frame_of(features, 1.0), NO_LANDMARK)
    assert tracks.row[young] == 4


def test_a_feature_that_was_matched_to_a_landmark_continues_its_track_wherever_it_was_expected():
    _, tracks, features, truth = scene(4, np.zeros(6), np.random.default_rng(3))
    free = tracks.begin(np.arange(10, 14), features, np.arange(4), transform(truth, POINTS))
    tracks.landmark[free] = [7, 3, 12, -1]
    tracks.body[:] = -1
    landmark = np.array([3, 7, -1, 20])  # the first two change places; 12 was not matched, 20 has no track yet
    follow(tracks, {}, [], frame_of(features, 25.0), landmark)
    assert tracks.row[free[:2]].tolist() == [1, 0]
    assert tracks.landmark[tracks.row == 3].tolist() == [20]
    assert np.unique(tracks.row[tracks.seen]).size == tracks.seen.sum()


def test_members_of_a_lost_body_that_are_matched_landmarks_are_seen_and_ids_may_be_as_large_as_a_map_has_them():
    body, tracks, features, _ = scene(4, np.zeros(6), np.random.default_rng(3))
    members = np.flatnonzero(tracks.body == body.id)
    landmark = np.array([7, 3, 2**53, 9])
    tracks.landmark[members] = landmark
    follow(tracks, {1: replace(body, missed=2)}, [], frame_of(features, 25.0), landmark)
    assert tracks.row[members].tolist() == [0, 1, 2, 3]
    assert tracks.landmark[members].tolist() == landmark.tolist()
