"""Which rectangle each sample of a view shows."""

from __future__ import annotations

import cv2
import numpy as np

from slam.worlds.lens import View
from slam.worlds.placing import Placed

_TOUCH = 1e-6  # rectangles that reach through each other's plane by less than this share of the distance only touch


def shown(placed: Placed, view: View) -> np.ndarray:
    """Which rectangle each sample shows (H, W) uint8 or uint16: its row in `placed` plus 1, or 0 for none.

    Rectangles that can be put in order are entered from back to front. Where some reach through each other, or hide
    each other in a ring, a depth buffer settles it, which takes several times as long.
    """
    order = painting_order(placed)
    return by_depth(placed, view) if order is None else by_order(placed, view, order)


def painting_order(placed: Placed) -> np.ndarray | None:
    """Rows from back to front, so that none is hidden by an earlier one; None if there is no such order.

    A rectangle can be entered after another one if it lies on the camera's side of the other's plane, or the other lies
    beyond its plane. The camera sees the front of all.
    """
    beyond = np.einsum("jk,ilk->jil", placed.Q[:, 2], placed.corners)  # i's corners: 1 on j's plane, more beyond it
    this_side = (beyond <= 1 + _TOUCH).all(axis=2).T
    after = this_side | (beyond >= 1 - _TOUCH).all(axis=2)  # [i, j]: i may be entered after j
    (x0, x1), (y0, y1) = placed.columns.T, placed.rows.T
    meet = (x0[:, None] < x1) & (x0 < x1[:, None]) & (y0[:, None] < y1) & (y0 < y1[:, None])
    i, j = np.nonzero(np.triu(meet & ~(after & after.T), 1))
    by_others = _separated(placed, i, j)
    after[i, j] |= by_others[0]
    after[j, i] |= by_others[1]
    after |= ~meet
    if not (after | after.T).all():
        return None
    waits = ~after.T  # [i, j]: i must be entered after j
    order: list[int] = []
    left = np.ones(len(placed), bool)
    while left.any():
        ready = np.flatnonzero(left & ~waits[:, left].any(axis=1))
        if not len(ready):
            return None
        order += ready.tolist()
        left[ready] = False
    return np.array(order, int)


def _separated(placed: Placed, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether rectangles i may be entered after j (N,), and j after i, by other planes that lie between the two.

    Two convex surfaces that do not touch are parted by a plane along an edge of each; and planes through the camera and
    an edge part what does not overlap in the view.
    """
    edges = np.swapaxes(np.linalg.inv(placed.Q)[:, :, :2], 1, 2)
    across = np.cross(edges[i][:, [0, 0, 1, 1]], edges[j][:, [0, 1, 0, 1]])
    s, t, n = np.moveaxis(placed.Q, 1, 0)
    outline = np.stack([s, n - s, t, n - t], axis=1)
    normals = np.concatenate([across, outline[i], outline[j]], axis=1)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals /= np.where(length > 0, length, np.nan)  # parallel edges give no plane
    along = [normals @ np.swapaxes(placed.corners[k], 1, 2) for k in (i, j)]
    touch = _TOUCH * np.abs(along[0]).max(axis=2)
    (low_i, high_i), (low_j, high_j) = ((a.min(axis=2), a.max(axis=2)) for a in along)
    i_below, j_below = high_i <= low_j + touch, high_j <= low_i + touch
    # The camera is at the origin: what is on its side of the plane may be entered after the other.
    i_after = i_below & (low_j >= -touch) | j_below & (high_j <= touch)
    j_after = j_below & (low_i >= -touch) | i_below & (high_i <= touch)
    return i_after.any(axis=1), j_after.any(axis=1)


def by_order(placed: Placed, view: View, order: np.ndarray) -> np.ndarray:
    """`shown`, entering rectangles in this order, from back to front."""
    kind = _kind(placed)
    entered = np.zeros((view.height, view.width), kind)
    x = np.arange(view.width, dtype=np.uint16)
    begin = placed.first.view(np.uint16)[:, None]
    length = np.maximum(placed.last - placed.first + 1, 0).view(np.uint16)[:, None]
    for number, i in enumerate(order.tolist(), start=1):
        (y0, y1), (x0, x1) = placed.rows[i].tolist(), placed.columns[i].tolist()
        if x0 < x1:
            part = slice(placed.start[i], placed.start[i + 1])
            inside = x[x0:x1] - begin[part] < length[part]  # left of its beginning, the difference wraps to a large one
            there = entered[y0:y1, x0:x1]
            np.maximum(there, inside.view(np.uint8) * kind(number), out=there)
    rows = np.concatenate([[0], order + 1]).astype(kind)
    return cv2.LUT(entered, np.resize(rows, 256)) if kind is np.uint8 else rows[entered]


def by_depth(placed: Placed, view: View) -> np.ndarray:
    """`shown`, by a depth buffer."""
    kind = _kind(placed)
    result = np.zeros((view.height, view.width), kind)
    nearness = np.zeros((view.height, view.width), np.float32)
    x = np.arange(view.width, dtype=np.int16)
    in_column = (placed.Q[:, 2, 0, None] * np.arange(view.width)).astype(np.float32)
    in_row = (placed.Q[:, 2, 1, None] * np.arange(view.height) + placed.Q[:, 2, 2, None]).astype(np.float32)
    for i in range(len(placed)):  # nearest first, so that each overwrites only smaller numbers
        (y0, y1), (x0, x1) = placed.rows[i].tolist(), placed.columns[i].tolist()
        part = slice(placed.start[i], placed.start[i + 1])
        near = in_column[i, x0:x1] + in_row[i, y0:y1, None]
        there = nearness[y0:y1, x0:x1]
        seen = near > there
        seen &= x[x0:x1] >= placed.first[part, None]
        seen &= x[x0:x1] <= placed.last[part, None]
        if seen.any():
            cv2.copyTo(near, seen.view(np.uint8), there)
            numbers = result[y0:y1, x0:x1]
            np.maximum(numbers, seen.view(np.uint8) * kind(i + 1), out=numbers)
    return result


def _kind(placed: Placed) -> type[np.uint8] | type[np.uint16]:
    """The smallest integers that can number the rectangles."""
    return np.uint8 if len(placed) < 256 else np.uint16
