"""Numbers of keyframes in arrays that grow."""

from __future__ import annotations

import numpy as np

from slam.mapping.atlas.keyframes import Keyframe
from slam.mapping.atlas.rows import KeyframeRows


def keyframe(number: int, shared: int) -> Keyframe:
    T = np.eye(4)
    T[0, 3] = number
    points, none = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
    return Keyframe(
        number, 0.1 * number, T, np.eye(6), number * np.eye(6), np.full((6, shared), number), 2.0 * number, 1.0, points,
        np.zeros((0, 16), np.float16), np.zeros(0, np.int8), none,
    )  # fmt: skip


def test_rows_are_those_of_the_keyframes_however_many():
    rows, shorter = KeyframeRows(), KeyframeRows()
    for k in range(150):
        rows = rows.with_new(keyframe(k, 3))
        shorter = rows if k == 99 else shorter
    number = np.arange(150)
    assert (rows.poses[:, 0, 3] == number).all() and (rows.steps[:, 2, 2] == number).all()
    assert (rows.jacobian[:, 5, 2] == number).all() and (rows.travelled == 2 * number).all()
    assert len(shorter.stamps) == 100 and (shorter.poses == rows.poses[:100]).all()


def test_shares_of_other_errors_count_as_none():
    rows = KeyframeRows().with_new(keyframe(1, 0)).with_new(keyframe(2, 3))
    assert rows.jacobian.shape == (2, 6, 3) and not rows.jacobian[0].any() and (rows.jacobian[1] == 2).all()
    assert (rows.travelled == [2, 4]).all()
