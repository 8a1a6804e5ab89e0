"""What the smoother knows: a frozen value that a call replaces when all of it is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from backends.smoother.landmarks import Landmarks
from slam.data import IdArray, IndexArray
from slam.geometry.se3 import Array, adjoint, inverse


@dataclass(frozen=True, eq=False)
class Sight:
    """What was measured from one pose.

    Attributes:
        serials: of the landmarks (M,).
        begun: which of each one's smart factors it goes into (M,), see `Landmarks.begun`.
        z: measurements (M, 3) of the rectified rig, uR NaN where missing.
    """

    serials: IdArray
    begun: IndexArray
    z: Array

    def __len__(self) -> int:
        return len(self.serials)

    @classmethod
    def none(cls) -> Sight:
        """Nothing."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp), np.zeros((0, 3)))

    @classmethod
    def of(cls, marks: Landmarks, rows: IndexArray, z: Array) -> Sight:
        """Of measurements z (M, 3) that landmarks have just had."""
        return cls(marks.serial[rows], marks.begun[rows], z)

    def joined(self, other: Sight) -> Sight:
        """These measurements and others."""
        both = zip((self.serials, self.begun, self.z), (other.serials, other.begun, other.z))
        return Sight(*(np.concatenate(pair) for pair in both))


@dataclass(frozen=True, eq=False)
class Tie:
    """What the motion model said of a pose before it was measured.

    Attributes:
        relative: the pose relative to the one before it in the graph (4, 4).
        covariance: of that (6, 6).
        times: of the three frames that the motion model ties [s]; the first is NaN where the velocity is unknown. None
            where not all of them are poses of the graph, one after the other: then the above counts in its place.
    """

    relative: Array
    covariance: Array
    times: Array | None = None


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a landmark besides its measurements.

    Attributes:
        position: in the world, or in the camera's coordinates (3,) [m].
        covariance: of that (3, 3) [m²].
        pose: number of the pose that it is relative to; −1 for the world.
    """

    position: Array
    covariance: Array
    pose: int


@dataclass(frozen=True, eq=False)
class State:
    """The poses of the graph, the newest two frames, and the landmarks.

    The poses of the graph are numbered; one that is kept has its row in `poses` and all else. Frames that are no pose
    of the graph hang at the last one before them.

    Attributes:
        first: number of the first pose that is kept.
        begun: number of the pose with which the present problem begins: the first, or that of a restart.
        poses: T_world_left (K, 4, 4).
        sights: what was measured from each.
        ties: of each to the one before it; None of the one with which the problem begins.
        spread: covariance in the world of each when it was the newest (K, 6, 6).
        stamps: times of the last frame but one and the last (2,) [s]; NaN where there is none.
        last: their poses (2, 4, 4).
        pair: their joint covariance (12, 12), where the newest pose of the graph is known.
        tie: of the newest frame to the newest pose of the graph that is before it.
        frame: number of the newest frame.
        since: frames since the problem has begun, 0 for its first one.
        inside: whether the newest frame is the newest pose of the graph.
        landmarks: the map.
        serials: number of landmarks so far.
        known: by serial number.
        measured: whether the newest frame may not be updated any more.
        revisions: how often the measurements were revised.
        contradicted: updates in succession in which most observations agreed on another pose than was expected.
    """

    first: int
    begun: int
    poses: Array
    sights: tuple[Sight, ...]
    ties: tuple[Tie | None, ...]
    spread: Array
    stamps: Array
    last: Array
    pair: Array
    tie: Tie | None = None
    frame: int = -1
    since: int = 0
    inside: bool = True
    landmarks: Landmarks = field(default_factory=Landmarks.none)
    serials: int = 0
    known: Mapping[int, Known] = field(default_factory=dict)
    measured: bool = False
    revisions: int = 0
    contradicted: int = 0

    @classmethod
    def empty(cls) -> State:
        """Before the first prediction."""
        none = np.zeros((0, 4, 4))
        return cls(
            0, 0, none, (), (), np.zeros((0, 6, 6)), np.full(2, np.nan), np.tile(np.eye(4), (2, 1, 1)),
            np.zeros((12, 12)),
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
        """Covariance (6, 6) of the newest frame, where the newest pose of the graph is known."""
        return self.pair[6:, 6:]

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the newest frame in the world."""
        A = adjoint(inverse(self.last[1]) @ self.poses[-1])
        P = A @ self.spread[-1] @ A.T + self.own
        return np.asarray(0.5 * (P + P.T))

    def of(self, number: int) -> int:
        """Row of a pose of the graph."""
        return number - self.first

    def without_old(self, past: int) -> State:
        """Without what is kept of all but the last `past` poses."""
        gone = len(self.poses) - past
        if gone <= 0:
            return self
        return replace(
            self, first=self.first + gone, poses=self.poses[gone:], sights=self.sights[gone:], ties=self.ties[gone:],
            spread=self.spread[gone:],
            known={k: one for k, one in self.known.items() if not 0 <= one.pose < self.first + gone},
        )  # fmt: skip


def relative_covariance(P: Array, earlier: Array, later: Array) -> Array:
    """Covariance (6, 6) of a pose where another one is known, from their joint covariance (12, 12).

    Args:
        P: of the pose that is known, then the other.
        earlier: the pose that is known (4, 4).
        later: the other (4, 4).
    """
    A = adjoint(inverse(later) @ earlier)
    cross = A @ P[:6, 6:]
    C = P[6:, 6:] + A @ P[:6, :6] @ A.T - cross - cross.T
    return np.asarray(0.5 * (C + C.T))
