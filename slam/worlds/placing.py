"""Where the rectangles of a world lie in a view: which may be seen, which samples each covers, and which it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.geometry import RectangleArrays

NEAR = 0.02  #: what is nearer than this is not drawn [m]
_OVERLAP = 1e-4  # rectangles reach over their edges by this share, so that no sample falls between two that meet


class View(NamedTuple):
    """An undistorted view to draw: camera matrix (3, 3) in samples, and size in samples."""

    K: Array
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Placed:
    """Rectangles in a view, nearest first, a row each."""

    source: np.ndarray  # which rectangle of the world (P,)
    Q: Array  # takes a sample's (x, y, 1) to (s, t, 1) / depth; s, t are shares of its edges (P, 3, 3)
    nearness: Array  # 1 / depth of the farthest and of the nearest corner of the part before the camera (P, 2)
    rows: np.ndarray  # first that may be covered, and the one after the last (P, 2)
    columns: np.ndarray  # the same (P, 2)
    start: np.ndarray  # where the rows of a rectangle begin in `first` and `last` (P + 1,)
    first: np.ndarray  # first sample covered, a row of the view after the other (sum of rows,) int16
    last: np.ndarray  # last sample covered

    def __len__(self) -> int:
        return len(self.source)


def place(rectangles: RectangleArrays, T_world_body: Array, T_world_camera: Array, view: View) -> Placed:
    """The rectangles that may be seen in a view.

    Args:
        rectangles: all rectangles in their body frames.
        T_world_body: body poses (B + 1, 4, 4), row 0 the identity.
        T_world_camera: the camera's pose (4, 4).
        view: the camera.
    """
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    world = rectangles.placed(T_world_body)
    source = _in_frustum(world, R, c, view)
    edges = np.stack([world.along[source], world.down[source], world.origin[source] - c], axis=2)
    H = view.K @ (R.T @ edges)  # take (s, t, 1) to depth · (x, y, 1)
    corners = _corners_before(H)
    outline = corners[..., :2] / corners[..., 2:]
    low = np.maximum(np.ceil(outline.min(axis=1) - 0.1), 0).astype(int)
    high = np.minimum(np.floor(outline.max(axis=1) + 0.1) + 1, (view.width, view.height)).astype(int)
    nearness = 1 / np.stack([corners[..., 2].max(axis=1), corners[..., 2].min(axis=1)], axis=1)
    order = np.argsort(-nearness[:, 1], kind="stable")
    order = order[(low < high).all(axis=1)[order]]
    Q = np.linalg.inv(H[order])
    rows = np.stack([low[order, 1], high[order, 1]], axis=1)
    start = np.concatenate([[0], np.cumsum(rows[:, 1] - rows[:, 0])])
    first, last = _covered(Q, rows, start, view.width)
    columns = np.zeros_like(rows)
    if len(order):
        columns[:, 0] = np.minimum.reduceat(first, start[:-1])
        columns[:, 1] = np.maximum(np.maximum.reduceat(last, start[:-1]) + 1, columns[:, 0])
    return Placed(source[order], Q, nearness[order], rows, columns, start, first, last)


def _in_frustum(world: RectangleArrays, R: Array, c: Array, view: View) -> np.ndarray:
    """Rectangles whose front faces a camera (pose R, c) and whose surrounding sphere reaches into the view."""
    offset = world.origin - c
    middle = (offset + (world.along + world.down) / 2) @ R
    fx, fy, cx, cy = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    walls = np.array([[fx, 0, cx], [-fx, 0, view.width - cx], [0, fy, cy], [0, -fy, view.height - cy]])
    walls /= np.linalg.norm(walls, axis=1, keepdims=True)  # inward normals of the planes that bound the view
    inside = ((offset * world.normal).sum(axis=1) < -1e-6) & (middle[:, 2] > NEAR - world.radius)
    inside &= (middle @ walls.T > -world.radius[:, None]).all(axis=1)
    return np.flatnonzero(inside)


_SQUARE = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def _corners_before(H: Array) -> Array:
    """Corners (M, 8, 3) as depth · (x, y, 1) of the parts of rectangles that lie before the camera; they may repeat.

    A rectangle of which nothing does gets points outside of every view.
    """
    corner = _SQUARE @ np.swapaxes(H, 1, 2)
    step = np.roll(corner, -1, axis=1) - corner
    before = corner[..., 2] >= NEAR
    crosses = before != np.roll(before, -1, axis=1)  # the edge from this corner to the next passes the nearest depth
    share = (NEAR - corner[..., 2]) / np.where(crosses, step[..., 2], 1.0)
    points = np.concatenate([corner, corner + share[..., None] * step], axis=1)
    valid = np.concatenate([before, crosses], axis=1)
    some = points[np.arange(len(H)), valid.argmax(axis=1)]
    some[~valid.any(axis=1)] = (-1e6, -1e6, NEAR)
    return np.where(valid[..., None], points, some[:, None])


def _covered(Q: Array, rows: np.ndarray, start: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last sample covered in each row of each rectangle (sum of rows,) int16; last < first where none."""
    s, t, n = Q[:, 0], Q[:, 1], Q[:, 2]
    edges = np.stack([s, n - s, t, n - t], axis=0) + _OVERLAP * n
    a, b, c = np.moveaxis(edges, 2, 0)  # inside, a·x + b·y + c ≥ 0 for all four
    a = np.where(a == 0, 1e-300, a)
    begins = a > 0
    which = np.repeat(np.arange(len(Q)), np.diff(start))
    y = np.arange(start[-1]) - (start[:-1] - rows[:, 0])[which]
    first, last = np.zeros(len(y)), np.full(len(y), float(width))
    for bound, limit, chosen in ((first, np.maximum, begins), (last, np.minimum, ~begins)):
        slope = np.where(chosen, -b / a, 0.0)
        offset = np.where(chosen, -c / a, 0.0 if limit is np.maximum else float(width))
        for k in range(4):
            limit(bound, slope[k, which] * y + offset[k, which], out=bound)
    first, last = np.ceil(np.minimum(first, width)), np.floor(np.maximum(last, -1.0))
    return first.astype(np.int16), np.minimum(last, width - 1).astype(np.int16)


def shown(placed: Placed, view: View) -> np.ndarray:
    """Which rectangle each sample shows (H, W) uint8 or uint16: its row in `placed` plus 1, or 0 for none."""
    kind = np.uint8 if len(placed) < 256 else np.uint16
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
