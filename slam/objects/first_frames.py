"""Landmarks that move in the first frames of a run, when no track is long enough yet to be classified.

What moves from the beginning on would else pull the camera along until the detector knows its tracks, and that error
stays: the world's axes are those of the first frame. So the way of each landmark from where it was first seen is tested
as `slam.objects.scene` tests displacements of tracks: windows whose landmarks moved together, and single landmarks
that did not move with the rest. The noise is that of these displacements themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.data import BoolArray, IdArray
from slam.geometry.arrays import isin
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.objects.config import ObjectsConfig
from slam.objects.measurement import measure
from slam.objects.scene import Displacements, classify_scene, tail

#: Gives the positions (K, 3) of landmarks in the world [m] by their ids (K,).
Places = Callable[[IdArray], Array]
_LEAST_NOISE = 0.05  # [px] of a pixel from frame to frame: correlation finds it no better; errors of the rig are below
_RIDGE = 1e-6  # numerics: share of the trace


@dataclass(frozen=True, eq=False)
class FirstSights:
    """Landmarks as they were when they were first seen."""

    ids: IdArray  # of the landmarks (N,), ascending
    points: Array  # where they were, in world coordinates (N, 3) [m]
    frame: IdArray  # in which they were seen (N,)

    @classmethod
    def none(cls) -> FirstSights:
        """Of no landmark yet."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int64))

    def after(self, ids: IdArray, places: Places, frame: IdArray) -> FirstSights:
        """A copy with those of the landmarks `ids` (K,) that are new, seen first in the frames `frame` (K,)."""
        new = np.flatnonzero(~isin(ids, self.ids))
        joined = np.concatenate([self.ids, ids[new]])
        order = np.argsort(joined, kind="stable")
        points = np.concatenate([self.points, places(ids[new])])
        frames = np.concatenate([self.frame, frame[new]])
        return FirstSights(joined[order], points[order], frames[order])

    def of(self, ids: IdArray) -> FirstSights:
        """Some of them (K,), in that order."""
        rows = np.searchsorted(self.ids, ids)
        return FirstSights(ids, self.points[rows], self.frame[rows])


def moving_landmarks(
    rig: StereoRig, T_world_left: Array, first: FirstSights, pixels: Array, frame: int, sigma: float,
    config: ObjectsConfig,
) -> BoolArray:  # fmt: skip
    """Which landmarks (N,) moved otherwise than the scene since they were first seen.

    Args:
        rig: the cameras.
        T_world_left: the camera's pose (4, 4), which may be wrong.
        first: the landmarks' first sights.
        pixels: (uL, vL, uR) of each in this frame (N, 3); those without a right pixel are not tested.
        frame: number of this frame, as in `first`.
        sigma: pixel noise [px].
        config: settings of the detector.
    """
    moves = np.zeros(len(pixels), bool)
    points, information, dof = measure(rig, T_world_left, first.points, pixels, sigma)
    local = transform(inverse(T_world_left), first.points)
    known = np.flatnonzero((dof == 3) & (local[:, 2] > 0))
    if len(known) < 3 * config.min_support:
        return moves
    A, local, was = information[known], local[known], first.points[known]
    ridge = _RIDGE * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    lag = (frame - first.frame[known]).astype(float)
    moved = Displacements(was - T_world_left[:3, 3], points[known] - was, 0.5 * (A + ridge), lag)
    place = np.column_stack([local[:, :2] / local[:, 2:], np.log(local[:, 2])])
    scene = classify_scene(moved, place, config.suspect, config.min_support, (_LEAST_NOISE / sigma) ** 2)
    moves[known[~scene.rest | (scene.alone > config.doubtful * tail(scene.alone[scene.rest]))]] = True
    return moves
