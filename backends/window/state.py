"""What the window back end knows: a frozen value that a call replaces when all of it is done."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from backends.window.past import Past
from slam.data import BoolArray, IdArray, IndexArray
from slam.geometry.arrays import LandmarkRows
from slam.geometry.se3 import Array
from slam.window.problem import Places, RelativePrior, Rows
from slam.window.stereo import relative_covariance


@dataclass(frozen=True, eq=False)
class WindowLandmarks(LandmarkRows):
    """A row for each landmark, and for each that was removed (its id is −1) but has measurements in the window."""

    serial: IdArray  # number of each in the order of their coming (S,); an id may come back, a serial number not
    position: Array  # in world coordinates (S, 3) [m]
    local: Array  # covariance (S, 3, 3) [m²] in the coordinates of the newest pose that was solved for
    world: Array  # covariance (S, 3, 3) [m²] in world coordinates
    last: IndexArray  # number of the frame that measured it last (S,)
    mean: Array  # what was known beforehand, in world coordinates, and is not in the prior yet: position (S, 3)
    information: Array  # and information (S, 3, 3), zero for nothing
    by_rig: Array  # derivatives of the positions by errors of the rig (S, 3, m)

    @classmethod
    def none(cls, m: int = 0) -> WindowLandmarks:
        """No landmark."""
        none, three, nine = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        return cls(none, none, three, nine, nine, none, three, nine, np.zeros((0, 3, m)))


@dataclass(frozen=True, eq=False)
class WindowState:
    """The window."""

    frames: IndexArray  # numbers of its frames (K,), ascending; the last one is the newest
    stamps: Array  # their times (K,) [s]
    rests: BoolArray  # whether the camera stood since the frame before each (K,)
    poses: Array  # T_world_left (K, 4, 4)
    covariance: Array  # of the poses together (6 K, 6 K)
    by_rig: Array  # derivatives of the poses by errors of the rig (6 K, m); of the first one, before it is there
    solved: int  # place in the window of the newest pose that was solved for
    begun: int  # number of the frame in which the present problem begins: the first, or that of a restart
    rows: Rows  # measurements, by place in the window and row of the landmark
    places: Places  # landmarks placed relative to a pose
    prior: RelativePrior  # what left the window says of its poses but the newest, and of landmarks
    cost: float  # sum of squares at the estimate
    landmarks: WindowLandmarks = field(default_factory=WindowLandmarks.none)
    past: Past = field(default_factory=Past)  # poses that have left the window and are still revised
    serials: int = 0  # number of landmarks so far
    measured: bool = False  # whether the newest pose may not be updated any more
    contradicted: int = 0  # updates in succession in which most observations agreed on another pose than expected

    @classmethod
    def empty(cls, by_rig: Array) -> WindowState:
        """Before the first prediction; `by_rig` (6, m) is of the first pose."""
        none = np.zeros(0, np.int64)
        return cls(
            none, np.zeros(0), np.zeros(0, bool), np.zeros((0, 4, 4)), np.zeros((0, 0)), by_rig, 0, 0, Rows.none(),
            Places.none(), RelativePrior.none(), 0.0, WindowLandmarks.none(by_rig.shape[1]),
        )  # fmt: skip

    def revised_poses(self) -> dict[int, Array]:
        """Poses (4, 4) by frame, of the window and of its past."""
        poses = dict(zip(self.frames.tolist(), self.poses))
        marks, members = self.landmarks, self.prior.points
        points = dict(zip(marks.serial[members].tolist(), marks.position[members]))
        return {**self.past.revised(poses, points), **poses}

    def settled(self, lag: int) -> tuple[WindowState, dict[int, Array]]:
        """With a past of `lag` frames, once it is half as long again; and the poses (4, 4) that are final now."""
        surplus = len(self.past) - lag
        if surplus <= lag // 2:
            return self, {}
        poses = self.revised_poses()
        final = {one.frame: poses[one.frame] for one in self.past.left[:surplus]}
        return replace(self, past=self.past.without(surplus)), final


def settle(before: WindowState, after: WindowState, lag: int) -> tuple[WindowState, dict[int, Array]]:
    """The state after a step, with a past of `lag` frames, and the poses (4, 4) by frame that are final with it."""
    if after.begun != before.begun:  # the problem was begun anew: what was before is final
        return after, before.revised_poses()
    return after.settled(lag)


def between(s: WindowState, earlier: int, later: int | None = None) -> Array:
    """Covariance (6, 6) of a pose of the window (the newest) relative to another one, both perturbed on the right."""
    later = len(s.frames) - 1 if later is None else later
    if earlier == later:
        return np.zeros((6, 6))
    both = np.concatenate([6 * earlier + np.arange(6), 6 * later + np.arange(6)])
    return relative_covariance(s.covariance[np.ix_(both, both)], s.poses[earlier], s.poses[later])
