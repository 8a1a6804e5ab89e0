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

    def of_matches(self, frame: int, result: FrameResult) -> Array:
        """Take in what was made of a frame; distances [px] of its matches from where their landmarks truly are.

        Infinite for landmarks that were first seen on something that moves, or on nothing. First sights have none, as
        of landmarks that came back with a place: their points are those that they show.
        """
        uv = result.features.uv_left
        matched = uv[result.matched_features]
        known = np.array([i in self._points for i in result.matched.tolist()], bool)
        self._add(frame, result.matched[~known], matched[~known])
        self._add(frame, result.added, uv[result.added_features])
        local = transform(inverse(self._world.ground_truth.poses[frame]), self.positions(result.matched[known]))
        errors = np.linalg.norm(matched[known] - self._world.rig.left.project(local), axis=1)
        return np.where(np.isfinite(errors), errors, np.inf)

    def _add(self, frame: int, ids: IdArray, uv: Array) -> None:
        """Landmarks (N,) first seen at left pixels (N, 2) of a frame; NaN on nothing, and on what moves."""
        if not len(ids):
            return
        depth, objects = self._world.depth(frame), self._world.object_ids(frame)
        column, row = np.clip(np.rint(uv).astype(int), 0, np.array(depth.shape[::-1]) - 1).T
        still = (depth[row, column] > 0) & (objects[row, column] == 0)
        local = self._world.rig.left.rays(uv) * np.where(still, depth[row, column], np.nan)[:, None]
        self._points.update(zip(ids.tolist(), transform(self._world.ground_truth.poses[frame], local)))

    def positions(self, ids: IdArray) -> Array:
        """Where landmarks truly are (N, 3) [m], in the world of the truth; NaN on no still surface, and never seen."""
        nowhere = np.full(3, np.nan)
        return np.array([self._points.get(i, nowhere) for i in ids.tolist()]).reshape(-1, 3)
