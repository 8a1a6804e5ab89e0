"""Features followed from frame to frame: what a track remembers, and how it fits a fixed point or an even motion.

Every measurement is kept as a point in world coordinates with its information: the point ``p`` that the pixels say,
relative to the track's own anchor, and ``A = Jᵀ J / σ²``. Sums over the window give the least-squares fixed point, the
least-squares point with an even velocity, and the χ² of both.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.se3 import Array

_RIDGE = 1e-9
_MEMORY = 0.98  # share of what has left the window that is remembered from frame to frame
_MOVES = 12.0  # χ²(3) of the velocity from which it counts: 1 % of still points
_ROOM = 1000  # rows that a table begins with


@dataclass
class Tracks:
    """A table of tracks; the one mutable thing of the detector. Rows of tracks that were given up are used again.

    Attributes:
        ids: (N,), never used twice; −1 for unused rows, which are neither seen nor of a body.
        descriptors, laplacian: as last seen (N, D) float32, (N,) int8.
        row: row of the feature in this frame (N,), −1 where not seen.
        landmark: id of the landmark that it is (N,), −1 for none.
        body: id of the body that it belongs to (N,), −1 for none.
        missed: frames since it was last seen (N,).
        anchor: origin of the track's own coordinates, in world axes (N, 3).
        A: information (N, W, 3, 3), zero where there is no measurement; slot ``frame % W``.
        p: the point that the pixels say (N, W, 3), relative to the anchor.
        dof: numbers measured (N, W): 3, 2 or 0.
        older_A, older_b: fading sums of A and ``A p`` of what has left the window (N, 3, 3), (N, 3), and
        older_age: of the ages of these measurements in frames, each times the trace of its A (N,).
        position: where it is now, in world coordinates (N, 3).
        covariance: of the position (N, 3, 3).
        velocity: of those that a fixed point does not explain (N, 3) [m/s]; zero for the others.
        velocity_covariance: (N, 3, 3), of those that have one.
        streak: frames in a row in which it was part of a group that moves alike (N,).
        doubtful: not still for certain (N,).
        local: point in the body's coordinates (N, 3), and
        local_information: its information (N, 3, 3).
        misfit: how often lately it disagreed with its body (N,).
    """

    ids: IdArray
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    row: NDArray[np.intp]
    landmark: IdArray
    body: IdArray
    missed: IdArray
    anchor: Array
    A: Array
    p: Array
    dof: NDArray[np.int8]
    older_A: Array
    older_b: Array
    older_age: Array
    position: Array
    covariance: Array
    velocity: Array
    velocity_covariance: Array
    streak: IdArray
    doubtful: BoolArray
    local: Array
    local_information: Array
    misfit: IdArray

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
            vector.copy(), matrix.copy(), zero.copy(),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def seen(self) -> BoolArray:
        """Which are seen in this frame (N,)."""
        return self.row >= 0

    @property
    def count(self) -> IdArray:
        """Number of measurements in the window (N,)."""
        return (self.dof > 0).sum(axis=1)

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
        self.landmark[new] = -1
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
    """Let what `slot` held leave the window, in place."""
    A = tracks.A[:, slot]
    weight = np.trace(tracks.older_A, axis1=1, axis2=2)
    tracks.older_age[:] = _MEMORY * (tracks.older_age + weight) + tracks.A.shape[1] * np.trace(A, axis1=1, axis2=2)
    tracks.older_b[:] = _MEMORY * tracks.older_b + times_vectors(A, tracks.p[:, slot])
    tracks.older_A[:] = _MEMORY * tracks.older_A + A
    for array in (tracks.A, tracks.p, tracks.dof):
        array[:, slot] = 0


def record(tracks: Tracks, rows: NDArray[np.intp], slot: int, points: Array, information: Array, dof: NDArray) -> None:
    """Enter measurements of this frame: points (M, 3) with information (M, 3, 3), in place; see `make_room`."""
    tracks.A[rows, slot] = information
    tracks.p[rows, slot] = points - tracks.anchor[rows]
    tracks.dof[rows, slot] = dof


def fit_positions(tracks: Tracks, rows: NDArray[np.intp]) -> None:
    """Fit fixed points to the windows of tracks, in place."""
    A = tracks.A[rows]
    M = A.sum(axis=1)
    P = np.linalg.inv(M + _ridge(M))
    tracks.position[rows] = tracks.anchor[rows] + times_vectors(P, times_vectors(A, tracks.p[rows]).sum(axis=1))
    tracks.covariance[rows] = P
    tracks.velocity[rows] = 0


@dataclass(frozen=True)
class EvenMotion:
    """Points with an even velocity, a row each: position now (N, 3), velocity (N, 3) [m/s], covariances (N, 3, 3)."""

    position: Array
    covariance: Array
    velocity: Array
    velocity_covariance: Array


def even_motion(tracks: Tracks, rows: NDArray[np.intp], times: Array, max_speed: float) -> EvenMotion:
    """Points with an even velocity, fitted to the windows of tracks.

    Args:
        tracks: all tracks.
        rows: which of them.
        times: of the window's slots less the present (W,) [s].
        max_speed: deviation of velocities before anything is known [m/s].
    """
    A = tracks.A[rows]
    b = times_vectors(A, tracks.p[rows])
    n, w = len(rows), A.shape[1]
    powers = np.stack([np.ones(w), times, times * times])
    M0, M1, M2 = (powers @ A.reshape(n, w, 9)).reshape(n, 3, 3, 3).transpose(1, 0, 2, 3)
    B0, B1 = (powers[:2] @ b).transpose(1, 0, 2)
    P0 = np.linalg.inv(M0 + _ridge(M0))
    G = P0 @ M1
    S = M2 - np.swapaxes(G, 1, 2) @ M1 + np.eye(3) / max_speed**2
    PV = np.linalg.inv(S + _ridge(S))
    V = times_vectors(PV, B1 - times_vectors(np.swapaxes(G, 1, 2), B0))
    position = tracks.anchor[rows] + times_vectors(P0, B0) - times_vectors(G, V)
    return EvenMotion(position, P0 + G @ PV @ np.swapaxes(G, 1, 2), V, PV)


def fit_velocities(tracks: Tracks, rows: NDArray[np.intp], times: Array, max_speed: float) -> None:
    """Give tracks their even motion, in place, where a fixed point does not explain them; see `even_motion`."""
    m = even_motion(tracks, rows, times, max_speed)
    test = (m.velocity * np.linalg.solve(m.velocity_covariance, m.velocity[..., None])[..., 0]).sum(axis=1)
    moves = test > _MOVES
    tracks.velocity[rows[moves]] = m.velocity[moves]
    tracks.velocity_covariance[rows[moves]] = m.velocity_covariance[moves]
    tracks.position[rows[moves]], tracks.covariance[rows[moves]] = m.position[moves], m.covariance[moves]


def times_vectors(M: Array, v: Array) -> Array:
    """Products (..., 3) of matrices (..., 3, 3) and vectors (..., 3)."""
    return np.asarray((M @ v[..., None])[..., 0])


def _ridge(M: Array) -> Array:
    """What makes (N, 3, 3) information matrices invertible and changes nothing else."""
    return (_RIDGE * np.trace(M, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
