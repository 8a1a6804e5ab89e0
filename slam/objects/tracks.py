"""Features followed from frame to frame: what a track remembers, and how it fits a fixed point or an even motion.

Every measurement is kept as information about a point in world coordinates: a matrix ``A = Jᵀ S⁻¹ J`` (3, 3) and a
vector ``A p``, p being the point that the pixels say, relative to the track's own anchor. S holds the pixel noise and
the camera pose's uncertainty. Sums over the window give the least-squares fixed point, the least-squares point with an
even velocity, and the χ² of both.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.se3 import Array

_RIDGE = 1e-9
_MEMORY = 0.98  # share of what has left the window that is remembered from frame to frame
MOVES = 12.0  #: χ²(3) of the velocity from which it counts in the position: 1 % of still points


@dataclass
class Tracks:
    """Tracks, a row each; the one mutable table of the detector.

    Attributes:
        ids: (N,), ascending, never used twice.
        descriptors, laplacian: as last seen (N, D) float32, (N,) int8.
        row: row of the feature in this frame (N,), −1 where not seen.
        landmark: id of the landmark that it is (N,), −1 for none.
        body: id of the body that it belongs to (N,), −1 for none.
        missed: frames since it was last seen (N,).
        anchor: origin of the track's own coordinates, in world axes (N, 3).
        A: information (N, W, 3, 3), zero where there is no measurement; slot ``frame % W``.
        b: ``A p`` (N, W, 3) with p relative to the anchor.
        c: ``pᵀ A p`` (N, W).
        dof: numbers measured (N, W): 3, 2 or 0.
        older_A, older_b: fading sums of what has left the window (N, 3, 3), (N, 3), and
        older_age: of the ages of these measurements in frames, each times the trace of its A (N,).
        position: where it is now, in world coordinates (N, 3).
        velocity: of the fit with an even velocity (N, 3) [m/s]; zero where there are too few measurements.
        covariance: of the position (N, 3, 3).
        velocity_covariance: (N, 3, 3).
        test: χ²(3) of the velocity: of "still" against "even velocity" (N,).
        residual: χ² left by the even velocity, per degree of freedom (N,).
        streak: frames in a row in which it was part of a group that moves alike (N,).
        moving: judged to move without belonging to a body (N,).
        doubtful: neither still nor moving for certain (N,).
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
    b: Array
    c: Array
    dof: NDArray[np.int8]
    older_A: Array
    older_b: Array
    older_age: Array
    position: Array
    velocity: Array
    covariance: Array
    velocity_covariance: Array
    test: Array
    residual: Array
    streak: IdArray
    moving: BoolArray
    doubtful: BoolArray
    local: Array
    local_information: Array
    misfit: IdArray

    @classmethod
    def new(cls, ids: IdArray, features: StereoFeatures, rows: NDArray[np.intp], points: Array, window: int) -> Tracks:
        """Tracks begun at features whose points in world coordinates are `points` (N, 3); no measurement yet."""
        n = len(rows)
        none, zero = np.full(n, -1, np.int64), np.zeros(n, np.int64)
        return cls(
            ids, features.descriptors[rows], features.laplacian[rows], rows.astype(np.intp), none, none.copy(), zero,
            points, np.zeros((n, window, 3, 3)), np.zeros((n, window, 3)), np.zeros((n, window)),
            np.zeros((n, window), np.int8), np.zeros((n, 3, 3)), np.zeros((n, 3)),
            np.zeros(n), points.copy(), np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3)),
            np.zeros(n), np.zeros(n), zero.copy(), np.zeros(n, bool), np.zeros(n, bool), np.zeros((n, 3)),
            np.zeros((n, 3, 3)), zero.copy(),
        )  # fmt: skip

    @classmethod
    def empty(cls, dimensions: int, window: int) -> Tracks:
        """No tracks."""
        nothing = StereoFeatures.empty(0.0, dimensions)
        return cls.new(np.zeros(0, np.int64), nothing, np.zeros(0, np.intp), np.zeros((0, 3)), window)

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

    def select(self, keep: NDArray) -> Tracks:
        """Some of the rows, in order."""
        return Tracks(*(getattr(self, f.name)[keep] for f in fields(Tracks)))

    def joined(self, others: Tracks) -> Tracks:
        """These rows and others below."""
        return Tracks(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)]) for f in fields(Tracks)))


def make_room(tracks: Tracks, slot: int) -> None:
    """Let what `slot` held leave the window, in place."""
    weight = np.trace(tracks.older_A, axis1=1, axis2=2)
    tracks.older_age[:] = _MEMORY * (tracks.older_age + weight)
    tracks.older_age += tracks.A.shape[1] * np.trace(tracks.A[:, slot], axis1=1, axis2=2)
    tracks.older_A[:] = _MEMORY * tracks.older_A + tracks.A[:, slot]
    tracks.older_b[:] = _MEMORY * tracks.older_b + tracks.b[:, slot]
    for array in (tracks.A, tracks.b, tracks.c, tracks.dof):
        array[:, slot] = 0


def record(tracks: Tracks, rows: NDArray[np.intp], slot: int, points: Array, information: Array, dof: NDArray) -> None:
    """Enter measurements of this frame: points (M, 3) with information (M, 3, 3), in place; see `make_room`."""
    p = points - tracks.anchor[rows]
    Ap = np.einsum("nij,nj->ni", information, p)
    tracks.A[rows, slot] = information
    tracks.b[rows, slot] = Ap
    tracks.c[rows, slot] = np.einsum("ni,ni->n", p, Ap)
    tracks.dof[rows, slot] = dof


def fit(tracks: Tracks, rows: NDArray[np.intp], times: Array, max_speed: float, floor: float) -> None:
    """Fit position and velocity of tracks to their windows, in place.

    Args:
        tracks: all tracks.
        rows: which of them.
        times: of the window's slots less the present (W,) [s].
        max_speed: deviation of velocities before anything is known [m/s].
        floor: standard deviation [m/s] of a still point's apparent velocity, beyond what the noise explains.
    """
    if not len(rows):
        return
    A, b = tracks.A[rows], tracks.b[rows]
    n, w = len(rows), A.shape[1]
    powers = np.stack([np.ones(w), times, times * times])
    M0, M1, M2 = (powers @ A.reshape(n, w, 9)).reshape(n, 3, 3, 3).transpose(1, 0, 2, 3)
    B0, B1 = (powers[:2] @ b).transpose(1, 0, 2)
    M0 = M0 + _ridge(M0)
    P0 = np.linalg.inv(M0)
    G = P0 @ M1
    S = M2 - np.swapaxes(G, 1, 2) @ M1
    u = B1 - np.einsum("nji,nj->ni", G, B0)
    judged = (tracks.dof[rows] > 0).sum(axis=1) >= 2
    S = S + np.eye(3) / max_speed**2
    PV = np.zeros((n, 3, 3))
    PV[judged] = np.linalg.inv(S[judged] + _ridge(S[judged]))
    V = np.einsum("nij,nj->ni", PV, u)
    tracks.velocity[rows] = V
    tracks.velocity_covariance[rows] = PV
    still = np.einsum("nij,nj->ni", P0, B0)
    explained = np.einsum("ni,ni->n", B0, still) + np.einsum("ni,ni->n", u, V)
    dof = np.maximum(tracks.dof[rows].sum(axis=1) - 6, 1)
    tracks.residual[rows] = np.maximum(tracks.c[rows].sum(axis=1) - explained, 0) / dof
    test = np.zeros(n)
    loose = np.linalg.inv(PV[judged] + floor**2 * np.eye(3))
    test[judged] = np.einsum("ni,nij,nj->n", V[judged], loose, V[judged])
    tracks.test[rows] = test
    moves = (test > MOVES)[:, None]
    tracks.position[rows] = tracks.anchor[rows] + still - moves * np.einsum("nij,nj->ni", G, V)
    tracks.covariance[rows] = P0 + moves[..., None] * (G @ PV @ np.swapaxes(G, 1, 2))


def _ridge(M: Array) -> Array:
    """What makes (N, 3, 3) information matrices invertible and changes nothing else."""
    return (_RIDGE * np.trace(M, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
