"""What the smoother knows: a frozen value that a call replaces when all of it is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from backends.smoother.landmarks import SmootherLandmarks
from slam.data import IdArray, IndexArray
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array, adjoint, inverse


@dataclass(frozen=True, eq=False)
class Sight(Table):
    """What was measured from one pose."""

    serials: IdArray  # of the landmarks (M,)
    factor: IndexArray  # which of each one's smart factors it goes into (M,), see `SmootherLandmarks.factor`
    z: Array  # measurements (M, 3) of the rectified rig, uR NaN where missing

    @classmethod
    def none(cls) -> Sight:
        """Nothing."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp), np.zeros((0, 3)))

    @classmethod
    def of(cls, marks: SmootherLandmarks, rows: IndexArray, z: Array) -> Sight:
        """Of measurements z (M, 3) that landmarks have just had."""
        return cls(marks.serial[rows], marks.factor[rows], z)


@dataclass(frozen=True, eq=False)
class Tie:
    """What the motion model said of a pose before it was measured.

    The velocity between two poses of the graph is that between the two before them, but for noise. Where frames that
    saw nothing lie between two poses the velocity is the mean one, and the impulses of all frames are in the noise: see
    `over`. Where the model does not say that (at rest, or after a gap that hides a turn) `times` is None, and the
    pose is tied by where it was predicted, as if that did not depend on the graph: it counts the velocity twice.
    """

    relative: Array  # the pose relative to the one before it in the graph (4, 4)
    covariance: Array  # of that (6, 6)
    shared: Array  # of the error in the world of the one before it with that of this (6, 6)
    span: float | None = None  # time since that one [s]; None where the model's velocity does not tell what it moved by
    weight: float = 0.0  # sum [s²] over the frames since of their intervals times the time from their start to the pose
    times: Array | None = None  # (3,) of the three poses [s]; the first is NaN where the velocity is unknown
    over: float = 0.0  # time [s] over which the motion model's impulses give the noise


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a landmark besides its measurements."""

    position: Array  # in the world, or in the camera's coordinates (3,) [m]
    covariance: Array  # of that (3, 3) [m²]
    pose: int  # number of the pose that it is relative to; −1 for the world
    used: int = -1  # number of the pose that measured the landmark first; −1 for none


@dataclass(frozen=True, eq=False)
class SmootherState:
    """The poses of the graph, the newest two frames, and the landmarks.

    The poses of the graph are numbered; one that is kept has its row in `poses` and all else. Frames that are no pose
    of the graph hang at the last one before them.
    """

    first: int  # number of the first pose that is kept
    begun: int  # number of the pose with which the present problem begins: the first, or that of a restart
    poses: Array  # T_world_left (K, 4, 4)
    sights: tuple[Sight, ...]  # what was measured from each
    ties: tuple[Tie | None, ...]  # of each to the one before it; None of the one with which the problem begins
    spread: Array  # covariance in the world of each when it was the newest that was solved for (K, 6, 6)
    stamps: Array  # times of the last frame but one and the last (2,) [s]; NaN where there is none
    last: Array  # their poses (2, 4, 4)
    pair: Array  # joint covariance (12, 12) of their errors relative to the newest pose of the graph
    shared: Array  # covariance (6, 12) of that pose's own error in the world with these
    by_rig: Array  # their derivatives by errors of the rig (12, m)
    # covariance (6, 6) of the pose with which the problem begins before anything was measured from it, and that of its
    # attitude about the world's axes (3, 3) [rad²]
    prior: Array = field(default_factory=lambda: np.zeros((6, 6)))
    start: Array = field(default_factory=lambda: np.eye(4))  # where that pose was believed to be then (4, 4)
    turned: Array = field(default_factory=lambda: np.zeros((3, 3)))
    tie: Tie | None = None  # of the newest frame to the newest pose of the graph that is before it
    frame: int = -1  # number of the newest frame
    since: int = 0  # frames since the problem has begun, 0 for its first one
    inside: bool = True  # whether the newest frame is the newest pose of the graph
    follows_pose: bool = False  # whether the frame before it is a pose of the graph
    landmarks: SmootherLandmarks = field(default_factory=SmootherLandmarks.none)
    serials: int = 0  # number of landmarks so far
    known: Mapping[int, Known] = field(default_factory=dict)  # by serial number
    measured: bool = False  # whether the newest frame may not be updated any more
    revisions: int = 0  # how often the measurements were revised
    contradicted: int = 0  # updates in succession in which most observations agreed on another pose than expected

    @classmethod
    def empty(cls, by_rig: Array) -> SmootherState:
        """Before the first prediction; `by_rig` (6, m) is of the first pose."""
        none = np.zeros((0, 4, 4))
        return cls(
            0, 0, none, (), (), np.zeros((0, 6, 6)), np.full(2, np.nan), np.tile(np.eye(4), (2, 1, 1)),
            np.zeros((12, 12)), np.zeros((6, 12)), np.tile(by_rig, (2, 1)),
            landmarks=SmootherLandmarks.none(by_rig.shape[1]),
        )  # fmt: skip

    @property
    def started(self) -> bool:
        """Whether there was a prediction."""
        return len(self.poses) > 0

    @property
    def number(self) -> int:
        """Number of the newest pose of the graph."""
        return self.first + len(self.poses) - 1

    @property
    def anchored(self) -> bool:
        """Whether landmarks are known in the world: then the path may not be moved in it."""
        return any(known.pose < 0 for known in self.known.values())

    @property
    def own(self) -> Array:
        """Covariance (6, 6) of the newest frame's error relative to the newest pose of the graph."""
        return self.pair[6:, 6:]

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the newest frame in the world.

        It moves as the last poses did, so what it is off by relative to the newest one has to do with that one's error.
        """
        A = adjoint(inverse(self.last[1]) @ self.poses[-1])
        P = A @ (self.spread[-1] @ A.T + 2 * self.shared[:, 6:]) + self.own
        return np.asarray(0.5 * (P + P.T))

    @property
    def followed(self) -> tuple[Array, Array]:
        """How the last two frames follow the newest pose of the graph, see `follows`."""
        A = adjoint(inverse(self.last) @ self.poses[-1]).reshape(12, 6)
        return follows(A, self.spread[-1], self.shared, self.pair)

    def of(self, number: int) -> int:
        """Row of a pose of the graph."""
        return number - self.first

    def without_old(self, past: int, lag: int) -> SmootherState:
        """Without what is kept of all but the last `past` poses, of which `lag` are smoothed."""
        gone = len(self.poses) - past
        return replace(
            self, first=self.first + gone, poses=self.poses[gone:], sights=self.sights[gone:], ties=self.ties[gone:],
            spread=self.spread[gone:], landmarks=self.landmarks.folded(self.first + gone, self.number - lag),
            known={k: one for k, one in self.known.items() if not 0 <= one.pose < self.first + gone},
        )  # fmt: skip


def follows(A: Array, P: Array, shared: Array, own: Array) -> tuple[Array, Array]:
    """Gain G (n, 6) and covariance (n, n) of an error ``G x + rest``, whose rest has nothing to do with a pose's x.

    P (6, 6) is the covariance of x. The error less ``A x`` has a covariance `own` (n, n), and `shared` (6, n) with x.
    """
    gain = np.linalg.solve(P, shared).T
    return A + gain, own - gain @ shared
