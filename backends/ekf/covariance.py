"""The filter's covariance: of the camera, clones of its past poses, and the landmarks, one dense matrix.

The clones are not corrected: they stay as they were estimated in their time. Their covariance with the others goes on,
as in a Schmidt filter: with a gain of zero ``P_ab ← (1 − K H) P_ab``, and their own ``P_bb`` stays. They are the last
poses, and the reference pose of landmarks that have left the state (`backends.ekf.state`).

Errors δ of the rig (`slam.interfaces.ConsideringBackend`) are consider parameters. Kept are the derivatives of all
errors by them, which the same gain changes: a measurement is off by ``H x − F δ``, with the rig's field F.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsyr2k, dsyrk

from slam.data import IndexArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array
from slam.runtime.compilation import kernel

CAMERA = 12  #: fixed: size of the camera's state [r, φ, v, ω]
POSE = 6  #: fixed: its part [r, φ] that measurements depend on
CLONES = 4  #: cost: clones of the last poses before the present one
HEAD = CAMERA + POSE * (CLONES + 1)  #: fixed: size of camera and clones, behind which the landmarks stand
REFERENCE = slice(HEAD - POSE, HEAD)  #: fixed: where the last clone stands, the reference pose
_BLOCK = 32  # cost: rows and columns that are mirrored at once


@dataclass(frozen=True, eq=False)
class Covariance:
    """Of ``[camera (12), last poses (24), reference pose (6), N landmarks (3N)]``, with n rows.

    The last poses are perturbed on the right, the newest first; zero before there are so many. The error of the
    reference pose is a displacement of the world; zero, the world itself, before a landmark has left the state. The
    landmarks are the first of the table of all, in its order.
    """

    P: Array  # (n, n)
    by_rig: Array  # derivatives (n, m) of all errors by those of the rig

    @classmethod
    def of_camera(cls, P: Array, by_rig: Array | None = None) -> Covariance:
        """Of the camera alone (12, 12), with derivatives (12, m) of its error by errors of the rig."""
        by_rig, more = np.zeros((CAMERA, 0)) if by_rig is None else by_rig, (0, HEAD - CAMERA)
        return cls(np.pad(P, more), np.pad(by_rig, (more, (0, 0))))

    @property
    def active(self) -> int:
        """N: as many landmarks are in the state."""
        return (len(self.P) - HEAD) // 3

    @property
    def camera(self) -> Array:
        """Of the camera (12, 12)."""
        return self.P[:CAMERA, :CAMERA]

    @property
    def pose(self) -> Array:
        """Of its [r, φ] (6, 6)."""
        return self.P[:POSE, :POSE]

    def indices(self, rows: IndexArray) -> IndexArray:
        """Indices (M, 3) of the coordinates of landmarks, by rows of the table."""
        return np.asarray(HEAD + 3 * rows[:, None] + np.arange(3))

    def joint_poses(self, J: Array, n: int) -> Array:
        """Joint covariance (6n, 6n) of the last poses, the present one, J (6, 6) times [r, φ], last."""
        past = CAMERA + np.arange(POSE * (n - 1)).reshape(-1, POSE)[::-1]
        order = np.append(past, np.arange(POSE))
        P = self.P[order[:, None], order]
        P[-POSE:] = J @ P[-POSE:]
        P[:, -POSE:] = P[:, -POSE:] @ J.T
        return np.asarray(0.5 * (P + P.T))

    # --- the camera moves ---

    def camera_moved(self, J: Array, noise: Array | float = 0.0) -> Covariance:
        """The camera's error (12,), or with that of past poses, becomes J times what it was, plus noise (12, 12)."""
        F, P, by_rig = np.eye(HEAD), self.P.copy(), self.by_rig.copy()
        F[: len(J), : len(J)] = J
        P[:HEAD], by_rig[:HEAD] = F @ P[:HEAD], F @ by_rig[:HEAD]
        own = P[:HEAD, :HEAD] @ F.T
        own[:CAMERA, :CAMERA] += noise
        P[:HEAD, :HEAD] = 0.5 * (own + own.T)
        P[HEAD:, :HEAD] = P[:HEAD, HEAD:].T
        return changed(self, P=P, by_rig=by_rig)

    def advanced(self, J: Array, noise: Array, by_error: Array) -> Covariance:
        """The same, and the pose before, `by_error` (6, 6) times [r, φ], becomes the newest clone; the oldest goes."""
        F = np.eye(HEAD, k=-POSE)
        F[:CAMERA, :CAMERA], F[REFERENCE], F[REFERENCE, REFERENCE] = J, 0.0, np.eye(POSE)
        F[CAMERA : CAMERA + POSE, :CAMERA] = np.pad(by_error, ((0, 0), (0, POSE)))
        return self.camera_moved(F, noise)

    def with_reference(self, W: Array) -> Covariance:
        """With the present pose as the reference pose; W (6, 6) is its `gauge_by_error`."""
        F = np.eye(HEAD)
        F[REFERENCE, REFERENCE], F[REFERENCE, :POSE] = 0.0, W
        return self.camera_moved(F)

    def drift(self, W: Array) -> Array:
        """Covariance (6, 6) of the drift from the reference pose to the present one, a displacement of the world."""
        D = W @ self.P[:POSE, REFERENCE]
        D = W @ self.pose @ W.T - D - D.T + self.P[REFERENCE, REFERENCE]
        return np.asarray(0.5 * (D + D.T))

    def walked(self, rows: IndexArray, walk: Array) -> Covariance:
        """After landmarks (`rows` (M,) of the table) walk by (M, 3, 3)."""
        P, at = self.P.copy(), self.indices(rows)
        P[at[:, :, None], at[:, None, :]] += walk
        return changed(self, P=P)

    # --- landmarks join and leave ---

    def appended(self, J: Array, noise: Array, by_rig: Array, shared: Array | float = 0.0) -> Covariance:
        """With landmarks ``Y = g(r, φ) + noise`` (paper A, Eq. 10), by derivatives (M, 3, 6), the last ones.

        The noise has covariances (M, 3, 3), beside one (3M, 3M) that they share. Errors of the rig move them by
        `by_rig` (M, 3, m).
        """
        n, by_pose, each = len(self.P), J.reshape(-1, POSE), np.arange(len(J))
        P, cross = np.empty((n + len(by_pose),) * 2), by_pose @ self.P[:POSE]
        P[:n, :n], P[n:, :n], P[:n, n:] = self.P, cross, cross.T
        own = cross[:, :POSE] @ by_pose.T + shared
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        P[n:, n:] = positive(0.5 * (own + own.T), own.diagonal(), POSE)
        return changed(self, P=P, by_rig=np.concatenate([self.by_rig, by_rig.reshape(len(by_pose), -1)]))

    def only(self, rows: IndexArray) -> Covariance:
        """With these landmarks alone, by their rows of the table."""
        if len(rows) == self.active:
            return self
        indices = np.append(np.arange(HEAD), self.indices(rows))
        return Covariance(reordered(self.P, indices), self.by_rig[indices])

    # --- an update ---

    def corrected(self, V: Array, by_rig: Array, J: Array, shift: Array) -> Covariance:
        """After an update, in the coordinates of the corrected state: ``P − K S Kᵀ`` (paper A, Eq. 11).

        The clones keep the covariance that they have among themselves.

        Args:
            V: ``K S Kᵀ = V Vᵀ`` (n, ·).
            by_rig: by which derivatives by errors of the rig fall (n, m).
            J: the corrected camera's error is J (12, 12) times that of the camera before.
            shift: the error of a corrected landmark is what it was plus its shift (N, 3, 6) times that of the pose.
        """
        clones, by_rig, D = slice(CAMERA, HEAD), self.by_rig - by_rig, np.zeros((len(self.P), CAMERA))
        P = dsyrk(-1.0, V, 1.0, self.P.T).T  # the lower triangle: BLAS counts by columns
        mirror(P, CAMERA)
        D[:CAMERA], D[HEAD:] = J - np.eye(CAMERA), shift.reshape(-1, POSE) @ J[:POSE]
        # F P Fᵀ = P + D Yᵀ + Y Dᵀ, with F = 1 + [D, 0] and Y = P[:, :12] + D P_cc / 2
        half = 0.5 * D @ P[:CAMERA, :CAMERA]
        P = dsyr2k(1.0, D, P[:, :CAMERA] + half, 1.0, P.T, overwrite_c=1).T
        by_rig += D @ by_rig[:CAMERA]
        P[clones, clones], by_rig[clones] = self.P[clones, clones], self.by_rig[clones]
        summands = self.P.diagonal() + 2 * (half * D).sum(axis=1)
        summands[clones] = 0.0
        mirror(P, len(P))
        return changed(self, P=positive(P, summands, V.shape[1]), by_rig=by_rig)


@kernel
def mirror(P: Array, n: int) -> None:
    """The lower triangle of the first n rows and columns of P also above its diagonal, in place."""
    for first in range(0, n, _BLOCK):
        for left in range(0, first + 1, _BLOCK):
            for i in range(first, min(first + _BLOCK, n)):
                for j in range(left, min(left + _BLOCK, i)):
                    P[j, i] = P[i, j]


@kernel
def reordered(P: Array, order: IndexArray) -> Array:
    """P (n, n) with its rows and columns in an order (k,)."""
    out = np.empty((len(order), len(order)))
    for i in range(len(order)):
        for j in range(len(order)):
            out[i, j] = P[order[i], order[j]]
    return out


def positive(P: Array, summands: Array, terms: int) -> Array:
    """P (..., N, N), a sum or difference of so many terms, with what rounding may have taken from its variances.

    The summands (..., N) are the variances of which these were made. Large ones may cancel: without this, a landmark
    that is hardly known in one direction loses its variance in another one.
    """
    each = np.arange(P.shape[-1])
    P[..., each, each] += terms * np.finfo(float).eps * summands
    return P
