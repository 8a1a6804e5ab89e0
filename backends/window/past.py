"""Poses that have left the window: what later frames measure still moves them, as a smoother would."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from slam.data import IdArray, IndexArray
from slam.geometry.se3 import Array, exp, inverse, log
from slam.window.marginal import Conditional


@dataclass(frozen=True, eq=False)
class Left:
    """A pose that left the window, and landmarks that left the prior with it, given all that stayed."""

    frame: int  # number of its frame, and T_world_left (4, 4) then
    pose: Array
    serials: IdArray  # of landmarks that left (G,), and positions then (G, 3)
    points: Array
    frames: IndexArray  # of poses that stayed (K,), (K, 4, 4)
    poses: Array
    stayed: IdArray  # of landmarks that stayed (D,), (D, 3)
    positions: Array
    conditional: Conditional  # changes of the pose and of landmarks that left, by those of what stayed


@dataclass(frozen=True, eq=False)
class Past:
    """Poses that have left, the oldest first."""

    left: tuple[Left, ...] = ()

    def __len__(self) -> int:
        return len(self.left)

    def with_one(self, one: Left) -> Past:
        """With one more."""
        return replace(self, left=(*self.left, one))

    def without(self, count: int) -> Past:
        """Without the oldest ones."""
        return replace(self, left=self.left[count:])

    def displaced(self, serials: IdArray, displacement: Array) -> Past:
        """With landmarks by serial number (S,), ascending, displaced (S, 3), as if they had stood there before."""

        def of(own: IdArray) -> Array:
            at = np.searchsorted(serials, own).clip(0, len(serials) - 1)
            return np.where((serials[at] == own)[:, None], displacement[at], 0.0)

        return Past(tuple(
            replace(one, points=one.points + of(one.serials), positions=one.positions + of(one.stayed))
            for one in self.left
        ))  # fmt: skip

    def revised(self, poses: Mapping[int, Array], points: Mapping[int, Array]) -> dict[int, Array]:
        """Poses (4, 4) by frame, given those of the window by frame and landmarks of its prior by serial number.

        Each pose follows from what stayed when it left, beginning with the one that left last (as in the backward pass
        of Rauch, Tung and Striebel).
        """
        known, where = dict(poses), dict(points)
        for one in reversed(self.left):
            now = np.array([where[serial] for serial in one.stayed.tolist()]).reshape(-1, 3)
            poses_now = np.array([known[frame] for frame in one.frames.tolist()])
            moved, pose = one.conditional.of(now - one.positions, log(inverse(one.poses) @ poses_now))
            known[one.frame] = one.pose @ exp(pose)
            where.update(zip(one.serials.tolist(), one.points + moved))
        return {one.frame: known[one.frame] for one in self.left}
