"""The filter's covariance: dense for what is in the state, and what has left it.

A landmark that has left is corrected no more, but its error's covariance with the state goes on: this is the filter of
Schmidt, whose covariance is exact for what it does. With the gain of such a landmark zero, ``P_AA`` changes as ever,
``P_Ab ← (1 − K H) P_Ab`` and ``P_bb`` not at all. When it is measured again it joins the state with its covariances.
The camera's last poses, as they were believed in their time, are kept in the same way (stochastic clones).
What is known of a landmark from elsewhere is independent of all else until it is measured: nothing need be carried.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.blas import dsyr2k, dsyrk

from backends.ekf import kernels
from slam.data import IndexArray
from slam.geometry.se3 import Array

CAMERA = 12  #: fixed: size of the camera's state [r, φ, v, ω]
POSE = 6  #: fixed: its part [r, φ] that measurements depend on


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of ``[camera (12), landmark 0 (3), ...]``, the dense part, and of what is outside of it.

    Attributes:
        dense: (12 + 3A, 12 + 3A), symmetric.
        cross: of it with what has left: K poses, by their right perturbations, and B landmarks (12 + 3A, 6K + 3B).
        left: of these (6K + 3B, 6K + 3B).
        known: of each landmark that is independent of all else (C, 3, 3).
        poses: K, the newest first.
    """

    dense: Array
    cross: Array
    left: Array
    known: Array
    poses: int = 0

    @classmethod
    def of_camera(cls, P: Array) -> Covariance:
        """Of the camera alone (12, 12)."""
        return cls(P, np.zeros((CAMERA, 0)), np.zeros((0, 0)), np.zeros((0, 3, 3)))

    @property
    def count(self) -> int:
        """Number of landmarks in the dense part: the first rows of the table of landmarks."""
        return (len(self.dense) - CAMERA) // 3

    @property
    def correlated(self) -> int:
        """Number of landmarks that are in it or have left it: those after them are known from elsewhere."""
        return self.count + (len(self.left) - POSE * self.poses) // 3

    @property
    def pose(self) -> Array:
        """The block of [r, φ] (6, 6)."""
        return self.dense[:POSE, :POSE]

    def marginals(self) -> tuple[Array, Array]:
        """Covariances (N, 3, 3) of all landmarks, and theirs (N, 3, 6) with the camera's [r, φ]."""
        a, b, n, k = self.count, self.correlated, self.correlated + len(self.known), POSE * self.poses
        blocks, cross = np.empty((n, 3, 3)), np.zeros((n, 3, POSE))
        for part, P in ((slice(0, a), self.dense[CAMERA:, CAMERA:]), (slice(a, b), self.left[k:, k:])):
            each, three = np.arange(len(P) // 3), np.arange(3)
            rows = 3 * each[:, None] + three
            blocks[part] = P[rows[:, :, None], rows[:, None, :]]
        blocks[b:] = self.known
        cross[:a] = self.dense[CAMERA:, :POSE].reshape(-1, 3, POSE)
        cross[a:b] = self.cross[:POSE, k:].T.reshape(-1, 3, POSE)
        return blocks, cross

    def with_pose(self, J: Array, most: int) -> Covariance:
        """With the present pose among those that are kept, J (6, 6) times [r, φ]; and at most so many of them."""
        k = POSE * min(self.poses, most - 1)
        stay = np.concatenate([np.arange(k), np.arange(POSE * self.poses, len(self.left))])
        own, left = self.dense[:, :POSE] @ J.T, np.empty((POSE + len(stay), POSE + len(stay)))
        left[:POSE, :POSE], left[:POSE, POSE:] = J @ own[:POSE], J @ self.cross[:POSE, stay]
        left[POSE:, :POSE], left[POSE:, POSE:] = left[:POSE, POSE:].T, self.left[stay][:, stay]
        cross = np.concatenate([own, self.cross[:, stay]], axis=1)
        return replace(self, cross=cross, left=left, poses=k // POSE + 1)

    def camera_moved(self, J: Array, noise: Array, K: Array | None = None) -> Covariance:
        """The camera's error (12,) becomes J times what it was, plus noise (12, 12).

        With K (A, 3, 6), K times what the pose's error x has lost, ``x − x'``, is added to those of the landmarks.
        """
        P, X = self.dense.copy(), self.cross.copy()
        rows = J @ P[:CAMERA]
        own = rows[:, :CAMERA] @ J.T + noise
        if K is not None:
            lost, D = P[:POSE] - rows[:POSE], np.eye(POSE, CAMERA) - J[:POSE]
            with_all = np.concatenate([J @ lost[:, :CAMERA].T - noise[:, :POSE], lost[:, CAMERA:].T])
            variance = lost[:, :CAMERA] @ D.T + noise[:POSE, :POSE]
        P[:CAMERA, CAMERA:], P[CAMERA:, :CAMERA] = rows[:, CAMERA:], rows[:, CAMERA:].T
        P[:CAMERA, :CAMERA] = 0.5 * (own + own.T)
        before, X[:CAMERA] = X[:POSE].copy(), J @ X[:CAMERA]
        if K is None:
            return replace(self, dense=P, cross=X)
        X[CAMERA:] += K.reshape(-1, POSE) @ (before - X[:POSE])
        return replace(self, dense=_sheared(P.T, K, with_all, variance), cross=X)

    def appended(self, J: Array, noise: Array) -> Covariance:
        """With landmarks ``Y = g(r, φ) + noise`` (paper A, Eq. 10), by derivatives (M, 3, 6) and covariances (M, 3, 3).

        They are the last ones of the dense part.
        """
        n, by_pose, each = len(self.dense), J.reshape(-1, POSE), np.arange(len(J))
        P = np.empty((n + 3 * len(J), n + 3 * len(J)))
        P[:n, :n] = self.dense
        P[n:, :n] = by_pose @ self.dense[:POSE]
        P[:n, n:] = P[n:, :n].T
        own = P[n:, :POSE] @ by_pose.T
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        P[n:, n:] = 0.5 * (own + own.T)
        return replace(self, dense=P, cross=np.concatenate([self.cross, by_pose @ self.cross[:POSE]]))

    def rearranged(self, dense: IndexArray, left: IndexArray, known: IndexArray) -> Covariance:
        """With other landmarks in each of its parts, or fewer; by their rows of the table of landmarks."""
        parts, first_known = (self.dense, self.cross, self.left), self.correlated
        state = np.concatenate([np.arange(CAMERA), self._numbers(dense)])
        poses = len(self.dense) + np.arange(POSE * self.poses)
        P, outside = kernels.gather(*parts, state, state), np.concatenate([poses, self._numbers(left)])
        new = np.flatnonzero(dense >= first_known)
        rows = CAMERA + 3 * new[:, None] + np.arange(3)
        P[rows[:, :, None], rows[:, None, :]] = self.known[dense[new] - first_known]
        cross, own = kernels.gather(*parts, state, outside), kernels.gather(*parts, outside, outside)
        return Covariance(P, cross, own, self.known[known - first_known], self.poses)

    def _numbers(self, rows: IndexArray) -> IndexArray:
        """Of landmarks' coordinates (3M,) in ``[dense, left]``; −1 for those of landmarks that are known."""
        numbers = CAMERA + 3 * rows[:, None] + np.arange(3)
        numbers[rows >= self.count] += POSE * self.poses
        numbers[rows >= self.correlated] = -1
        return numbers.reshape(-1)

    def corrected(self, V: Array, V_left: Array, J: Array | None = None, K: Array | None = None) -> Covariance:
        """After an update, ``P − V Vᵀ``; with J and K in the coordinates of the corrected state.

        Args:
            V: ``P Hᵀ L⁻ᵀ`` (n, m), in Fortran's order.
            V_left: the same of what has left (6K + 3B, m).
            J: the camera's error becomes J (12, 12) times what it was,
            K: and then to those of the landmarks K (A, 3, 6) times that of the pose is added.
        """
        P = dsyrk(-1.0, V, beta=1.0, c=self.dense.T, lower=1)  # a copy, of which the lower triangle counts
        X = self.cross - V @ V_left.T
        if J is None or K is None:
            kernels.mirror(P.T)
            return replace(self, dense=P.T, cross=X)
        camera = P[:, :CAMERA].copy()
        camera[:CAMERA] = np.tril(camera[:CAMERA]) + np.tril(camera[:CAMERA], -1).T
        camera = camera @ J.T
        camera[:CAMERA] = J @ camera[:CAMERA]
        P[:, :CAMERA] = camera
        X[:CAMERA] = J @ X[:CAMERA]
        X[CAMERA:] += K.reshape(-1, POSE) @ X[:POSE]
        return replace(self, dense=_sheared(P, K, camera[:, :POSE], camera[:POSE, :POSE]), cross=X)

    def sheared(self, K: Array) -> Covariance:
        """K (A, 3, 6) times the error of the camera's pose is added to those of the landmarks of the dense part."""
        X = self.cross.copy()
        X[CAMERA:] += K.reshape(-1, POSE) @ X[:POSE]
        dense = _sheared(self.dense.copy().T, K, self.dense[:, :POSE], self.pose)
        return replace(self, dense=dense, cross=X)


def _sheared(P: Array, K: Array, with_all: Array, variance: Array) -> Array:
    """P (n, n) where K (A, 3, 6) times some y (6,) is added to the landmarks' errors.

    Args:
        P: in Fortran's order, its lower triangle counts; overwritten.
        K: by landmark.
        with_all: covariance (n, 6) of all, before that, with y.
        variance: of y (6, 6).
    """
    shift = np.zeros((len(P), POSE), order="F")
    shift[CAMERA:] = K.reshape(-1, POSE)
    half = np.asfortranarray(with_all + 0.5 * shift @ variance)
    P = dsyr2k(1.0, shift, half, beta=1.0, c=P, lower=1, overwrite_c=1)
    kernels.mirror(P.T)
    return np.asarray(P.T)
