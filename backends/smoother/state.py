"""What the smoother knows: a frozen value that a call replaces when all of it is done."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from backends.smoother.landmarks import SmootherLandmarks
from slam.data import BoolArray, IdArray, IndexArray
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window.motion import LONGEST, predicted
from slam.window.stereo import RectifiedStereo


@dataclass(frozen=True, eq=False)
class Sight(Table):
    """What was measured from one pose."""

    serials: IdArray  # of the landmarks (M,)
    since: IndexArray  # which of each one's smart factors it goes into (M,), see `SmootherLandmarks.since`
    z: Array  # measurements (M, 3) of the rectified rig, uR NaN where missing

    @classmethod
    def none(cls) -> Sight:
        """Nothing."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a landmark besides its measurements."""

    position: Array  # in the world, or in the camera's coordinates (3,) [m]
    covariance: Array  # of that (3, 3) [m²]
    pose: int  # number of the pose that it is relative to; −1 for the world
    used: int = -1  # number of the pose that measured the landmark first; −1 for none


@dataclass(frozen=True, eq=False)
class SmootherState:
    """The poses of all frames that are kept, by number, and the landmarks.

    A pose from which nothing was measured follows from the motion model alone. Covariances of landmarks are relative to
    the anchor.
    """

    first: int  # number of the first pose that is kept
    begun: int  # number of the pose with which the present problem begins: the first, or where it began anew
    poses: Array  # T_world_left (K, 4, 4)
    stamps: Array  # their times (K,) [s]
    rests: BoolArray  # whether the camera rested since the pose before (K,)
    ticks: IndexArray  # how many poses up to each gave the graph anything (K,): the lag is counted in these
    sights: tuple[Sight, ...]  # what the graph is given of each
    covariances: Array  # covariance in the world of each when it was the newest that was solved for (K, 6, 6)
    joint: Array  # covariance (18, 18) of the anchor and the last two poses, see `backends.smoother.joint`
    by_rig: Array  # derivatives of the last two poses' errors by errors of the rig (12, m)
    # of the pose with which the problem begins, before anything was measured from it: covariance (6, 6), and where it
    # was believed to be (4, 4)
    prior: Array = field(default_factory=lambda: np.zeros((6, 6)))
    start: Array = field(default_factory=lambda: np.eye(4))
    anchor: int = 0  # number of the last pose that gave the graph anything
    solved: int = -1  # number of the newest pose that the graph solved for; −1 for none
    landmarks: SmootherLandmarks = field(default_factory=SmootherLandmarks.none)
    serials: int = 0  # number of landmarks so far
    known: Mapping[int, Known] = field(default_factory=dict)  # by serial number
    left_stamps: Array = field(default_factory=lambda: np.zeros(0))  # times of poses that are kept no more (N,) [s]
    left_poses: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))  # and these, in no order
    measured: bool = False  # whether the newest pose may not be updated any more
    revisions: int = 0  # how often a new graph was needed: measurements revised, landmarks first known in the world
    contradicted: int = 0  # updates in succession in which most observations agreed on another pose than expected

    @classmethod
    def empty(cls, by_rig: Array) -> SmootherState:
        """Before the first prediction; `by_rig` (6, m) is of the first pose."""
        return cls(
            0, 0, np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, bool), np.zeros(0, np.intp), (), np.zeros((0, 6, 6)),
            np.zeros((18, 18)), np.tile(by_rig, (2, 1)), landmarks=SmootherLandmarks.none(by_rig.shape[1]),
        )  # fmt: skip

    @property
    def started(self) -> bool:
        """Whether there was a prediction."""
        return len(self.poses) > 0

    @property
    def number(self) -> int:
        """Number of the newest pose."""
        return self.first + len(self.poses) - 1

    @property
    def fixed(self) -> bool:
        """Whether landmarks are known in the world, so that the path may not be moved in it."""
        return any(known.pose < 0 for known in self.known.values())

    @property
    def relative(self) -> Array:
        """Covariance (6, 6) of the newest pose's error relative to the anchor."""
        return self.joint[12:, 12:]

    @property
    def gain(self) -> Array:
        """By how much (6, 6) the last but one pose's error relative to the anchor follows the newest one's."""
        if self.number == self.begun:
            return np.zeros((6, 6))
        return np.asarray(np.linalg.solve(self.relative, self.joint[12:, 6:12]).T)

    def intervals(self, number: int) -> tuple[float, float | None]:
        """Time [s] from the pose before to a pose, and from the one before that; None where there is none."""
        row = self.of(number)
        dt = np.minimum(np.diff(self.stamps[max(row - 2, 0) : row + 1]), LONGEST).tolist()
        return dt[-1], dt[0] if number - 2 >= self.begun and len(dt) == 2 else None

    def moved(self, models: EstimatorModels, number: int) -> tuple[Array, Array, Array, bool]:
        """Where a pose is by the motion model, from the two before it; see `slam.window.motion.predicted`."""
        row, (dt, before) = self.of(number), self.intervals(number)
        return predicted(models, self.poses[[max(row - 2, 0), row - 1]], before, dt, bool(self.rests[row]))

    def of(self, number: int) -> int:
        """Row of a pose."""
        return number - self.first

    def tick(self, numbers: IndexArray | int) -> IndexArray:
        """`ticks` of poses, −1 for one that is not kept."""
        rows = np.asarray(numbers) - self.first
        return np.where(rows < 0, -1, self.ticks[np.maximum(rows, 0)])

    def oldest(self, lag: int | None, newest: int) -> int:
        """Number of the oldest pose in the graph, once it has the newest one of such a number."""
        least = max(self.begun, self.first)
        if lag is None:
            return least
        return max(least, self.first + int(np.searchsorted(self.ticks, self.ticks[self.of(newest)] - lag)))

    def corrected(self, correct: Callable[[Array], Array]) -> SmootherState:
        """With corrected measurements; MeasurementError if one is not finite."""

        def again(z: Array) -> Array:
            return RectifiedStereo.corrected("smoother", z, correct) if len(z) else z

        z, there = self.landmarks.z.copy(), self.landmarks.pose >= 0
        z[there] = again(z[there])
        sights = tuple(replace(sight, z=again(sight.z)) for sight in self.sights)
        return replace(self, sights=sights, landmarks=replace(self.landmarks, z=z), revisions=self.revisions + 1)

    def without_old(self, past: int, lag: int) -> SmootherState:
        """Without what is kept of all but the last `past` poses before those that are smoothed."""
        oldest = self.oldest(lag, self.number)
        gone = max(self.of(oldest) - past, 0)
        return replace(
            self._without(np.arange(gone)), first=self.first + gone,
            landmarks=self.landmarks.folded(self.first + gone, oldest),
            known={k: one for k, one in self.known.items() if not 0 <= one.pose < self.first + gone},
        )  # fmt: skip

    def without_dark(self, keep: int) -> SmootherState:
        """Without the poses after the anchor but the last ones, so many: the motion over the others is one step."""
        begin, end = self.of(self.anchor) + 1, len(self.poses) - keep
        rests = self.rests.copy()
        rests[end] = rests[begin : end + 1].all()
        return replace(self, rests=rests)._without(np.arange(begin, end))

    def _without(self, rows: IndexArray) -> SmootherState:
        """Without what is kept of some poses; these and their times stay in the path."""
        names, gone = ("poses", "stamps", "rests", "ticks", "covariances"), set(rows.tolist())
        return replace(
            self, **{name: np.delete(getattr(self, name), rows, 0) for name in names},
            sights=tuple(one for row, one in enumerate(self.sights) if row not in gone),
            left_stamps=np.append(self.left_stamps, self.stamps[rows]),
            left_poses=np.concatenate([self.left_poses, self.poses[rows]]),
        )  # fmt: skip
