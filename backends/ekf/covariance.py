"""The filter's covariance matrix: one triangle of a padded buffer, changed in place.

Only the lower triangle is kept, in Fortran order, so that BLAS updates it in place (``dsyrk``) and the camera's
columns are contiguous. Above the diagonal stand zeros, always. The buffer has a few rows more than the state, all
zero, so that landmarks come and go without copying the rest; zero rows add nothing to any product.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from slam.se3 import Array

CAMERA = 12  #: size of the camera's state [r, φ, v, ω]
POSE = 6  #: its part [r, φ] that measurements depend on

SlotArray = NDArray[np.intp]

_LOWER = np.tri(CAMERA)


class Covariance:
    """Covariance of ``[camera (12), landmark 0 (3), landmark 1 (3), ...]``; landmarks are named by their slot.

    Attributes:
        count: number of landmarks.
    """

    def __init__(self, camera: Array) -> None:
        self.count = 0
        self._P = np.zeros((CAMERA, CAMERA), order="F")
        self._P[:CAMERA, :CAMERA] = np.tril(camera)

    @property
    def size(self) -> int:
        """Number of rows in use."""
        return CAMERA + 3 * self.count

    @property
    def capacity(self) -> int:
        """Number of rows of the buffer."""
        return len(self._P)

    @property
    def camera(self) -> Array:
        """The camera's block (12, 12)."""
        return _mirrored(self._P[:CAMERA, :CAMERA])

    @property
    def pose(self) -> Array:
        """The block of [r, φ] (6, 6)."""
        return _mirrored(self._P[:POSE, :POSE])

    def full(self) -> Array:
        """The whole symmetric matrix (size, size): a copy."""
        return _mirrored(self._P[: self.size, : self.size])

    def blocks(self, slots: SlotArray) -> Array:
        """Marginal covariances (M, 3, 3) of landmarks."""
        out = np.empty((len(slots), 3, 3))
        for below in range(3):
            diagonal = self._P.diagonal(-below)[CAMERA : self.size]
            for i in range(3 - below):
                out[:, i + below, i] = out[:, i, i + below] = diagonal[i::3][slots]
        return out

    def cross(self, slots: SlotArray) -> Array:
        """Covariances (M, 3, 6) of landmarks with the camera's [r, φ]."""
        return self._P[CAMERA : self.size, :POSE].reshape(-1, 3, POSE)[slots]

    def move_camera(self, dt: float, noise: Array) -> None:
        """``P ← A P Aᵀ + noise`` with the printed A of paper B: [r, φ] move by dt times [v, ω]; noise (12, 12)."""
        P, camera = self._P, self.camera
        P[CAMERA:, :POSE] += dt * P[CAMERA:, POSE:CAMERA]
        camera[:POSE] += dt * camera[POSE:]
        camera[:, :POSE] += dt * camera[:, POSE:]
        P[:CAMERA, :CAMERA] = (camera + noise) * _LOWER

    def transform_camera(self, J: Array) -> None:
        """``P ← J P Jᵀ`` for a change of the camera's state (12, 12)."""
        self._P[CAMERA:, :CAMERA] = self._P[CAMERA:, :CAMERA] @ J.T
        self._P[:CAMERA, :CAMERA] = np.tril(J @ self.camera @ J.T)

    def gather(self, slots: SlotArray) -> Array:
        """Columns (capacity, 6 + 3M) of the camera's [r, φ] and of landmarks, in Fortran order."""
        P = self._P
        rows = np.empty((POSE + 3 * len(slots), len(P)))  # the transposed result: each row is written in one go
        rows[:POSE] = P[:, :POSE].T
        rows[:POSE, :POSE] = self.pose
        starts = CAMERA + 3 * slots
        for row, start in zip(range(POSE, len(rows), 3), starts.tolist()):
            rows[row : row + 3, :start] = P[start : start + 3, :start]
            rows[row : row + 3, start:] = P[start:, start : start + 3].T
        own = POSE + 3 * np.arange(len(slots))
        for i, j in ((1, 0), (2, 0), (2, 1)):
            rows[own + i, starts + j] = P[starts + i, starts + j]
        return rows.T

    def subtract(self, W: Array) -> None:
        """``P ← P − W Wᵀ`` in place; W (capacity, K) in Fortran order."""
        self._P = dsyrk(-1.0, W, beta=1.0, c=self._P, lower=1, overwrite_c=1)

    def append(self, J: Array, noise: Array) -> None:
        """Landmarks that hang on the camera's [r, φ] (paper A, Eq. 10): ``Y = g(r, φ) + noise``.

        Args:
            J: derivatives (M, 3, 6) of the landmarks by [r, φ].
            noise: covariances (M, 3, 3) of what does not hang on it.
        """
        n, new = self.size, slice(self.size, self.size + 3 * len(J))
        if new.stop > len(self._P):
            self._resize(new.stop)
        by_pose = J.reshape(-1, POSE)
        cross = by_pose @ self.gather(np.zeros(0, np.intp))[:n].T
        own = cross[:, :POSE] @ by_pose.T
        for i, block in enumerate(noise):
            own[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
        self._P[new, :n] = cross
        self._P[new, new] = np.tril(own)
        self.count += len(J)

    def drop(self, slots: SlotArray) -> tuple[SlotArray, SlotArray]:
        """Take landmarks out; the last ones move into their slots.

        Moving a landmark costs its rows alone, so that only where most of a map goes would copying the rest be faster.

        Args:
            slots: of the landmarks (M,), each once.

        Returns:
            the slots filled anew and the slots that they were filled from; all others keep their place.
        """
        left = self.count - len(slots)
        gone = np.zeros(self.count, bool)
        gone[slots] = True
        holes, movers = np.flatnonzero(gone[:left]), left + np.flatnonzero(~gone[left:])
        for hole, mover in zip(holes.tolist(), movers.tolist()):
            self._move(CAMERA + 3 * hole, CAMERA + 3 * mover)
        self._P[CAMERA + 3 * left : self.size] = 0.0
        self.count = left
        if len(self._P) > self.size + 4 * _spare(self.size):
            self._resize(self.size)
        return holes, movers

    def _move(self, to: int, row: int) -> None:
        """Copy a landmark's rows and columns, which start at `row`, to `to` < `row`."""
        P = self._P
        P[to : to + 3, :to] = P[row : row + 3, :to]
        P[to + 3 : row, to : to + 3] = P[row : row + 3, to + 3 : row].T
        P[row + 3 : self.size, to : to + 3] = P[row + 3 : self.size, row : row + 3]
        P[to : to + 3, to : to + 3] = P[row : row + 3, row : row + 3]

    def _resize(self, rows: int) -> None:
        """Make the buffer hold `rows` rows, with a little room to grow."""
        capacity = rows + _spare(rows)
        P = np.zeros((capacity, capacity), order="F")
        P[: self.size, : self.size] = self._P[: self.size, : self.size]
        self._P = P


def _spare(rows: int) -> int:
    """Spare rows: few, as BLAS works through them, but a share of all, so that growing seldom copies the matrix."""
    return max(24, rows // 24)


def _mirrored(lower: Array) -> Array:
    """The symmetric matrix of a lower triangle with zeros above."""
    full = lower + lower.T
    np.fill_diagonal(full, lower.diagonal())
    return full
