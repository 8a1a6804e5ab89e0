"""The table of tracks: a row is one point, whatever becomes of it."""

from __future__ import annotations

import numpy as np

from slam.data import StereoFeatures
from slam.tracks.table import LandmarkTable, Tracks

HERE = np.zeros(3)


def features(count: int) -> StereoFeatures:
    """Features that all look otherwise."""
    one, uv = np.ones(count), np.zeros((count, 2))
    return StereoFeatures(0.0, uv, uv, one, one, one, one.astype(np.int8), np.eye(count, 8, dtype=np.float32))


def followed(count: int) -> Tracks:
    """A table in which the first rows are found as one feature each, and followed."""
    tracks, rows = Tracks.empty(8, 4, rows=count + 2), np.arange(count)
    tracks.set_features(rows, rows)
    tracks.begin(rows, 100 + rows, features(count), np.zeros((count, 3)))
    return tracks


def test_a_track_that_becomes_a_landmark_keeps_its_row_and_its_past():
    tracks = followed(3)
    tracks.dof[1] = 3
    tracks.enter_landmarks(7, np.array([20, 5]), features(3), np.array([2, 1]), HERE)
    assert tracks.ids[:3].tolist() == [-1, 5, 20] and tracks.number[:3].tolist() == [100, 101, 102]
    assert tracks.count(np.array([1])) == 4
    assert tracks.landmarks().ids.tolist() == [5, 20] and tracks.landmarks().last_seen.tolist() == [7, 7]
    assert tracks.rows(np.array([20, 5])).tolist() == tracks.mapped[::-1].tolist() == [2, 1]


def test_a_feature_of_another_landmark_s_track_or_of_none_begins_a_row():
    tracks = followed(2)
    tracks.enter_landmarks(0, np.array([5]), features(3), np.array([0]), HERE)
    tracks.enter_landmarks(1, np.array([6, 7]), features(3), np.array([0, 2]), HERE)
    assert tracks.ids.tolist() == [5, -1, 6, 7] and tracks.number[2:].tolist() == [-1, -1]
    assert tracks.found.tolist() == [True, True, False, False]  # the new rows are not followed yet


def test_landmarks_of_a_saved_map_take_unused_rows():
    tracks, looks = followed(3), features(6)
    tracks = tracks.with_landmarks(LandmarkTable(np.arange(6) + 9, looks.descriptors, looks.laplacian))
    assert tracks.landmarks().ids.tolist() == list(range(9, 15)) and (tracks.ids[:3] < 0).all()
    np.testing.assert_array_equal(tracks.landmarks().descriptors, looks.descriptors)
