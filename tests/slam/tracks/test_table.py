"""The table of tracks: a row is one point, whatever becomes of it."""

import numpy as np
import pytest

from slam.data import StereoFeatures
from slam.tracks.table import LandmarkTable, Patch, Tracks
from tests.slam.scene import features_at

HERE = np.zeros(3)


def features(count: int) -> StereoFeatures:
    """Features that all look otherwise."""
    uv = np.zeros((count, 2))
    return features_at(uv, uv, np.eye(count, 8, dtype=np.float32))


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


def test_a_free_track_has_no_patch_of_the_body_that_it_left_but_a_landmark_keeps_its_own():
    tracks, patch = followed(2), Patch(np.zeros((3, 3), np.float32), np.ones(2), 9.0, 4, np.eye(4))
    tracks.enter_landmarks(0, np.array([5]), features(2), np.array([0]), HERE)
    tracks.patches[:2] = [patch, patch]
    tracks.forget_past(np.arange(2))
    assert tracks.has_patch(np.arange(2), 4).tolist() == [True, False]


def test_a_feature_of_another_landmark_s_track_or_of_none_begins_a_row():
    tracks = followed(2)
    tracks.enter_landmarks(0, np.array([5]), features(3), np.array([0]), HERE)
    tracks.enter_landmarks(1, np.array([6, 7]), features(3), np.array([0, 2]), HERE)
    assert tracks.ids.tolist() == [5, -1, 6, 7] and tracks.number[2:].tolist() == [-1, -1]
    assert tracks.found.tolist() == [True, True, False, False]  # the new rows are not followed yet


def test_a_frame_s_copy_has_room_and_leaves_the_landmarks_of_the_frame_before_as_they_were():
    tracks = followed(2)
    tracks.enter_landmarks(0, np.array([5, 6]), features(2), np.array([0, 1]), HERE)
    before = tracks.landmarks()
    step = tracks.begun(40, 4)
    assert (~step.used).sum() >= 40 and not step.found.any()
    step.renew(np.array([1]), features(3), np.array([2]), 0.5, HERE + 1, 0)
    step.seen[1] += 1
    step.erase_landmarks(np.array([0]))
    after = tracks.landmarks()
    for name in LandmarkTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), name)
    assert step.landmarks().ids.tolist() == [6] and step.landmarks().seen.tolist() == [2]


def test_landmarks_of_a_saved_map_take_unused_rows():
    tracks, looks = followed(3), features(6)
    tracks = tracks.with_landmarks(LandmarkTable(np.arange(6) + 9, looks.descriptors, looks.laplacian))
    assert tracks.landmarks().ids.tolist() == list(range(9, 15)) and (tracks.ids[:3] < 0).all()
    np.testing.assert_array_equal(tracks.landmarks().descriptors, looks.descriptors)


@pytest.mark.parametrize("window", [4, 6])
def test_a_frame_s_copy_leaves_what_waits_for_a_depth_as_it_was(window):
    tracks, waits = followed(1), np.array([1])
    tracks.wait(3, features(3), waits, np.ones((1, 3)), np.eye(4), np.eye(6))
    copies = [tracks.begun(0, window) for _ in range(2)]
    assert copies[0].waiting_since.tolist() == [-1, 3, -1]
    copies[0].waiting_since[:] = -1  # it has a depth, and another feature begins to wait in its row
    copies[0].wait(4, features(3), waits + 1, np.zeros((1, 3)), 2 * np.eye(4), 2 * np.eye(6))
    for table in (tracks, copies[1]):
        assert table.waiting_since.tolist() == [-1, 3, -1] and table.laplacian[1] == 1
        for column, first in (
            (table.look, np.eye(8)[1]), (table.direction, 1), (table.first_pixel, 0), (table.first_pose, np.eye(4)),
            (table.first_covariance, np.eye(6)),
        ):  # fmt: skip
            np.testing.assert_array_equal(column[1], np.broadcast_to(first, column[1].shape))
