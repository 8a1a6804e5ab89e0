"""How many associations are right, where a world's truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam.data import FrameResult, IdArray
from slam.geometry.se3 import Array, inverse, transform


class SurfacePoints:
    """Which point of the still world each landmark is: the one that its feature showed at first sight."""

    def __init__(self, world: Any) -> None:
        self._world = world
        self._points: dict[int, Array] = {}

    def add(self, frame: int, ids: IdArray, uv_left: Array) -> None:
        """Landmarks `ids` (N,) first seen at left pixels (N, 2) of this frame."""
        if not len(ids):
            return
        depth, objects = self._world.depth(frame), self._world.object_ids(frame)
        column, row = _nearest_pixels(uv_left, depth.shape)
        still = (depth[row, column] > 0) & (objects[row, column] == 0)
        local = self._world.rig.left.rays(uv_left) * np.where(still, depth[row, column], np.nan)[:, None]
        points = transform(self._world.ground_truth.poses[frame], local)
        self._points.update(zip(np.asarray(ids).tolist(), points))

    def positions(self, ids: IdArray) -> Array:
        """Where landmarks `ids` truly are (N, 3) [m], in the world of the truth; NaN for those on no still surface,
        and for those that were never seen.
        """
        nowhere = np.full(3, np.nan)
        return np.array([self._points.get(i, nowhere) for i in np.asarray(ids).tolist()]).reshape(-1, 3)

    def errors(self, frame: int, ids: IdArray, uv_left: Array) -> Array:
        """Distances (N,) [px] of left pixels (N, 2) from where the landmarks `ids` (N,) truly are.

        Infinite for landmarks that were first seen on something that moves, or on nothing; NaN for those of which this
        is the first sight, as of landmarks that came back with a place: their points are those that it shows.
        """
        if not len(ids):
            return np.zeros(0)
        known = np.array([i in self._points for i in np.asarray(ids).tolist()])
        self.add(frame, ids[~known], uv_left[~known])
        points = np.array([self._points[i] for i in np.asarray(ids).tolist()])
        expected = self._world.rig.left.project(transform(inverse(self._world.ground_truth.poses[frame]), points))
        distance = np.linalg.norm(uv_left - expected, axis=1)
        return np.where(known, np.where(np.isfinite(distance), distance, np.inf), np.nan)

    def of_matches(self, frame: int, result: FrameResult) -> Array:
        """Take in what was made of a frame; the `errors` of its matches but first sights, infinite ones among them."""
        uv = result.features.uv_left
        errors = self.errors(frame, result.matched, uv[result.matched_features])
        self.add(frame, result.added, uv[result.added_features])
        return errors[~np.isnan(errors)]


def _nearest_pixels(uv: Array, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows (N,) of the pixels that hold these positions."""
    pixels = np.rint(uv).astype(int)
    return np.clip(pixels[:, 0], 0, shape[1] - 1), np.clip(pixels[:, 1], 0, shape[0] - 1)
