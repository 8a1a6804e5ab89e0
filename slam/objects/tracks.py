"""Features followed from frame to frame: what a track remembers, and how it fits a fixed point or a constant velocity.

Every measurement is kept as a point in world coordinates with its information: the point ``p`` that the pixels say,
relative to the track's own anchor, and ``A = Jᵀ J / σ²``. Sums over the window give the least-squares fixed point, the
least-squares point with an even velocity, and the χ² of both.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.se3 import Array
from slam.objects.track_kernels import constant_velocities, fit_fixed_points, leave_window

_MEMORY = 0.98  # share of what has left the window that is remembered from frame to frame
MOVES = 12.0  #: derived: χ²(3) at 99.3 % of the velocity, from which it counts
AGREES = 11.3  #: derived: χ²(3) at 99 %, of places or velocities that are the same
EXPLAINED = 0.2  #: share of the χ² of "still" that a motion, itself uncertain, may leave of what moves with it
_ROOM = 1000  # cost: rows that a table begins with


@dataclass(eq=False)
class Tracks:
    """A table of tracks; the one mutable thing of the detector. Rows of tracks that were given up are used again."""

    ids: IdArray  # (N,), never used twice; −1 for unused rows, which are neither seen nor of a body
    descriptors: NDArray[np.float32]  # as last seen (N, D)
    laplacian: NDArray[np.int8]  # sign of the Laplacian as last seen (N,)
    row: NDArray[np.intp]  # row of the feature in this frame (N,), −1 where not seen
    landmark: IdArray  # id of the landmark that it is (N,), −1 for none
    body: IdArray  # id of the body that it belongs to (N,), −1 for none
    missed: IdArray  # frames since a feature was last found that looks like it (N,)
    anchor: Array  # origin of the track's own coordinates, in world axes (N, 3)
    A: Array  # information (N, W, 3, 3), zero where there is no measurement; slot ``frame % W``
    p: Array  # the point that the pixels say (N, W, 3), relative to the anchor
    dof: NDArray[np.int8]  # numbers measured (N, W): 3, 2 or 0
    older_A: Array  # fading sum of A of what has left the window (N, 3, 3)
    older_b: Array  # fading sum of its ``A p`` (N, 3)
    older_age: Array  # fading sum of its ages in frames, each times the trace of its A (N,)
    position: Array  # where it is now, in world coordinates (N, 3)
    covariance: Array  # of the position (N, 3, 3)
    velocity: Array  # of those that a fixed point does not explain (N, 3) [m/s]; zero for the others
    velocity_covariance: Array  # (N, 3, 3), of those that have one
    # number of frames in which it was part of a moving group, less those since in which it was not (N,)
    streak: IdArray
    doubtful: BoolArray  # not still for certain (N,)
    local: Array  # point in the body's coordinates (N, 3)
    local_information: Array  # its information (N, 3, 3)
    misfit: IdArray  # how often lately it disagreed with its body (N,)
    sure: BoolArray  # whether its motion with the body is certain (N,)
    # whether it was removed from a body (N,): then it needs proof of its motion to become a member again
    expelled: BoolArray
    still: BoolArray  # whether its feature stays at its pixel while the camera stands (N,): it belongs to no body

    @classmethod
    def empty(cls, dimensions: int, window: int, rows: int = _ROOM) -> Tracks:
        """A table without tracks."""
        none, zero = np.full(rows, -1, np.int64), np.zeros(rows, np.int64)
        vector, matrix = np.zeros((rows, 3)), np.zeros((rows, 3, 3))
        return cls(
            none.copy(), np.zeros((rows, dimensions), np.float32), np.zeros(rows, np.int8), none.astype(np.intp),
            none.copy(), none.copy(), zero.copy(), vector.copy(), np.zeros((rows, window, 3, 3)),
            np.zeros((rows, window, 3)), np.zeros((rows, window), np.int8), matrix.copy(), vector.copy(),
            np.zeros(rows),
            vector.copy(), matrix.copy(), vector.copy(), matrix.copy(), zero.copy(), np.zeros(rows, bool),
            vector.copy(), matrix.copy(), zero.copy(), np.zeros(rows, bool), np.zeros(rows, bool),
            np.zeros(rows, bool),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def seen(self) -> BoolArray:
        """Which are seen in this frame (N,)."""
        return self.row >= 0

    def count(self, rows: NDArray[np.intp]) -> IdArray:
        """Number of measurements of tracks in the window (M,)."""
        return np.asarray(np.count_nonzero(self.dof[rows], axis=1))

    def begin(self, ids: IdArray, features: StereoFeatures, rows: NDArray[np.intp], points: Array) -> NDArray[np.intp]:
        """Begin tracks at features whose points in world coordinates are `points` (M, 3); returns their rows (M,)."""
        unused = np.flatnonzero(self.ids < 0)
        if len(unused) < len(rows):
            more = Tracks.empty(self.descriptors.shape[1], self.dof.shape[1], max(len(self), len(rows)))
            for f in fields(Tracks):
                setattr(self, f.name, np.concatenate([getattr(self, f.name), getattr(more, f.name)]))
            unused = np.flatnonzero(self.ids < 0)
        new = unused[: len(rows)]
        self.ids[new], self.row[new], self.missed[new] = ids, rows, 0
        self.descriptors[new], self.laplacian[new] = features.descriptors[rows], features.laplacian[rows]
        self.anchor[new] = self.position[new] = points
        self.landmark[new], self.expelled[new] = -1, False
        self.forget_past(new)
        return new

    def give_up(self, rows: NDArray[np.intp]) -> None:
        """Make rows unused."""
        self.ids[rows] = self.row[rows] = self.body[rows] = self.landmark[rows] = -1
        self.dof[rows] = 0

    def forget_past(self, rows: NDArray[np.intp]) -> None:
        """Make tracks free and without measurements."""
        self.body[rows], self.misfit[rows], self.streak[rows], self.doubtful[rows] = -1, 0, 0, False
        for array in (self.A, self.p, self.dof, self.older_A, self.older_b, self.older_age, self.velocity):
            array[rows] = 0


def make_room(tracks: Tracks, slot: int) -> None:
    """Let what `slot` held leave the window for the fading sums, in place."""
    t = tracks
    leave_window(t.ids, t.A, t.p, t.dof, t.older_A, t.older_b, t.older_age, slot, _MEMORY)


def record(tracks: Tracks, rows: NDArray[np.intp], slot: int, points: Array, information: Array, dof: NDArray) -> None:
    """Enter measurements of this frame: points (M, 3) with information (M, 3, 3), in place; see `make_room`."""
    tracks.A[rows, slot] = information
    tracks.p[rows, slot] = points - tracks.anchor[rows]
    tracks.dof[rows, slot] = dof


def fit_positions(tracks: Tracks, rows: NDArray[np.intp]) -> None:
    """Fit fixed points to the windows of tracks, in place."""
    t = tracks
    fit_fixed_points(t.A, t.p, t.anchor, rows, t.position, t.covariance)
    t.velocity[rows] = 0


@dataclass(frozen=True, eq=False)
class ConstantVelocity:
    """Points with an even velocity, a row each."""

    position: Array  # now (N, 3)
    covariance: Array  # of the position (N, 3, 3)
    velocity: Array  # (N, 3) [m/s]
    velocity_covariance: Array  # (N, 3, 3)
    test: Array  # χ²(3) of the velocity (N,)


def constant_velocity(tracks: Tracks, rows: NDArray[np.intp], times: Array, max_speed: float) -> ConstantVelocity:
    """Points with an even velocity, fitted to the windows of tracks.

    Args:
        tracks: all tracks.
        rows: which of them.
        times: of the window's slots less the present (W,) [s].
        max_speed: deviation of velocities before anything is known [m/s].
    """
    points, *rest = constant_velocities(tracks.A, tracks.p, rows, times, max_speed**-2)
    return ConstantVelocity(tracks.anchor[rows] + points, *rest)


def fit_velocities(tracks: Tracks, rows: NDArray[np.intp], times: Array, max_speed: float) -> None:
    """Give tracks a velocity, in place, where a fixed point does not explain them; see `constant_velocity`."""
    m = constant_velocity(tracks, rows, times, max_speed)
    moves = m.test > MOVES
    moving = rows[moves]
    tracks.velocity[moving], tracks.velocity_covariance[moving] = m.velocity[moves], m.velocity_covariance[moves]
    tracks.position[moving], tracks.covariance[moving] = m.position[moves], m.covariance[moves]


def times_vectors(M: Array, v: Array) -> Array:
    """Products (..., 3) of matrices (..., 3, 3) and vectors (..., 3)."""
    return np.asarray((M @ v[..., None])[..., 0])
