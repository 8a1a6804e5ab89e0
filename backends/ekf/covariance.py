"""The filter's covariance: of what is in the state, and of what has left it.

A landmark that has left is corrected no more, but its error's covariance with the state goes on: this is the filter of
Schmidt, whose covariance is exact for what it does. With the gain of such a landmark zero, ``P_AA`` changes as ever,
``P_Ab ← (1 − K H) P_Ab`` and ``P_bb`` not at all. When it is measured again it joins the state with its covariances.
The camera's last poses, as they were believed in their time, are kept in the same way (stochastic clones).
What is known of a landmark from elsewhere is independent of all else until it is measured: nothing need be carried.

Errors of the rig (`slam.interfaces.ConsideringBackend`) are such states, too: they are considered, but not estimated.
Their columns of the cross-covariance hold the derivatives of the state by them, which the same gain moves: a landmark's
measurement is off by ``H x − F δ``, with a field F. Their own covariance is not needed here.
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
    """Covariance of ``[camera (12), landmark 0 (3), ...]``, the state, and of what has left it."""

    camera: Array  # (12, 12 + 3A), of the camera with itself and all landmarks of the state: a motion changes no more
    marks: Array  # (3A, 3A), of these landmarks
    cross: Array  # (12 + 3A, 6K + 3B + m), with K poses, by right perturbations, B landmarks that left, m rig errors
    left: Array  # (6K + 3B + m, 6K + 3B + m), of these
    known: Array  # (C, 3, 3), of each landmark that is independent of all else
    poses: int = 0  # K, the newest first
    rig: int = 0  # m

    @classmethod
    def of_camera(cls, P: Array) -> Covariance:
        """Of the camera alone (12, 12)."""
        return cls(P, np.zeros((0, 0)), np.zeros((CAMERA, 0)), np.zeros((0, 0)), np.zeros((0, 3, 3)))

    def considering(self, by_rig: Array) -> Covariance:
        """With errors of the rig, by derivatives (12, m) of the camera's error; nothing else has left the state yet."""
        m = by_rig.shape[1]
        cross = np.concatenate([by_rig, np.zeros((len(self.marks), m))])
        return replace(self, cross=cross, left=np.zeros((m, m)), rig=m)

    @property
    def count(self) -> int:
        """Number of landmarks in the state: the first rows of the table of landmarks."""
        return len(self.marks) // 3

    @property
    def correlated(self) -> int:
        """Number of landmarks that are in it or have left it: those after them are known from elsewhere."""
        return self.count + (len(self.left) - POSE * self.poses - self.rig) // 3

    @property
    def pose(self) -> Array:
        """The block of [r, φ] (6, 6)."""
        return self.camera[:POSE, :POSE]

    @property
    def dense(self) -> Array:
        """Of the state (12 + 3A, 12 + 3A)."""
        return np.block([[self.camera], [self.camera[:, CAMERA:].T, self.marks]])

    def marginals(self, rows: IndexArray) -> tuple[Array, Array]:
        """Covariances (M, 3, 3) of some landmarks, and theirs (M, 3, 6) with the camera's [r, φ]."""
        numbers, known = self._numbers(rows), rows >= self.correlated
        blocks, cross = kernels.marginals(self.camera, self.marks, self.cross, self.left, numbers)
        blocks[known] = self.known[rows[known] - self.correlated]
        return blocks, cross

    def by_rig(self, rows: IndexArray) -> tuple[Array, Array]:
        """Derivatives of the camera's error (12, m), and of some landmarks (M, 3, m), by errors of the rig."""
        first, numbers = len(self.left) - self.rig, self._numbers(rows)
        columns = len(self.cross) + np.arange(first, first + self.rig)
        landmarks = kernels.gather(self.camera, self.marks, self.cross, self.left, numbers, columns)
        return self.cross[:CAMERA, first:], landmarks.reshape(len(rows), 3, self.rig)

    def displaced(self, rows: IndexArray, change: Array) -> Covariance:
        """After a change (M, 3) of some landmarks' coordinates that is none of their error: the last of the rig's."""
        if not self.rig:
            return self
        numbers, cross, left = self._numbers(rows), self.cross.copy(), self.left.copy()
        for table, first in ((cross, 0), (left, len(cross))):
            here = (numbers >= first) & (numbers < first + len(table))
            table[numbers[here] - first, -1] -= change.reshape(-1)[here]
        return replace(self, cross=cross, left=left)

    def with_pose(self, J: Array, most: int) -> Covariance:
        """With the present pose among those that are kept, J (6, 6) times [r, φ]; and at most so many of them."""
        k = POSE * min(self.poses, most - 1)
        stay = np.concatenate([np.arange(k), np.arange(POSE * self.poses, len(self.left))])
        left = np.empty((POSE + len(stay), POSE + len(stay)))
        left[:POSE, :POSE], left[:POSE, POSE:] = J @ self.pose @ J.T, J @ self.cross[:POSE, stay]
        left[POSE:, :POSE], left[POSE:, POSE:] = left[:POSE, POSE:].T, self.left[stay[:, None], stay]
        cross = np.concatenate([self.camera[:POSE].T @ J.T, self.cross[:, stay]], axis=1)
        return replace(self, cross=cross, left=left, poses=k // POSE + 1)

    def joint_poses(self, J: Array, n: int) -> Array:
        """Joint covariance (6n, 6n) of the last poses, the present one last, which is J (6, 6) times [r, φ]."""
        k = POSE * (n - 1)
        cross = self.cross[:POSE, :k].T @ J.T
        P = np.block([[self.left[:k, :k], cross], [cross.T, J @ self.pose @ J.T]])
        order = np.arange(POSE * n).reshape(n, POSE)
        order[:-1] = order[-2::-1]
        return np.asarray(P[order.reshape(-1)][:, order.reshape(-1)])

    def camera_moved(self, J: Array, noise: Array) -> Covariance:
        """The camera's error (12,) becomes J times what it was, plus noise (12, 12)."""
        camera, cross = J @ self.camera, self.cross.copy()
        own = camera[:, :CAMERA] @ J.T + noise
        camera[:, :CAMERA], cross[:CAMERA] = 0.5 * (own + own.T), J @ cross[:CAMERA]
        return replace(self, camera=camera, cross=cross)

    def appended(self, J: Array, noise: Array, by_rig: Array) -> Covariance:
        """With landmarks ``Y = g(r, φ) + noise`` (paper A, Eq. 10), by derivatives (M, 3, 6) and covariances (M, 3, 3).

        They are the last ones of the state. With the pose known, errors of the rig move them by `by_rig` (M, 3, m).
        """
        by_pose, n, each = J.reshape(-1, POSE), len(self.marks), np.arange(len(J))
        rows = by_pose @ self.camera[:POSE]
        marks = np.empty((n + len(rows), n + len(rows)))
        marks[:n, :n], marks[n:, :n], marks[:n, n:] = self.marks, rows[:, CAMERA:], rows[:, CAMERA:].T
        own = rows[:, :POSE] @ by_pose.T
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        marks[n:, n:] = _positive(0.5 * (own + own.T), own.diagonal(), POSE)
        camera = np.concatenate([self.camera, rows[:, :CAMERA].T], axis=1)
        new = by_pose @ self.cross[:POSE]
        new[:, len(self.left) - self.rig :] += by_rig.reshape(len(rows), self.rig)
        cross = np.concatenate([self.cross, new])
        return replace(self, camera=camera, marks=marks, cross=cross)

    def rearranged(self, dense: IndexArray, left: IndexArray, known: IndexArray) -> Covariance:
        """With other landmarks in each of its parts, or fewer; by their rows of the table of landmarks."""
        parts, first_known = (self.camera, self.marks, self.cross, self.left), self.correlated
        begin, end, camera = CAMERA + len(self.marks), CAMERA + len(self.marks) + len(self.left), np.arange(CAMERA)
        poses, rig = np.arange(begin, begin + POSE * self.poses), np.arange(end - self.rig, end)
        state, outside = self._numbers(dense), np.concatenate([poses, self._numbers(left), rig])
        marks, new = kernels.gather(*parts, state, state), np.flatnonzero(dense >= first_known)
        rows = 3 * new[:, None] + np.arange(3)
        marks[rows[:, :, None], rows[:, None, :]] = self.known[dense[new] - first_known]
        state = np.concatenate([camera, state])
        cross, own = kernels.gather(*parts, state, outside), kernels.gather(*parts, outside, outside)
        rest = self.known[known - first_known]
        return Covariance(kernels.gather(*parts, camera, state), marks, cross, own, rest, self.poses, self.rig)

    def _numbers(self, rows: IndexArray) -> IndexArray:
        """Of landmarks' coordinates (3M,) in ``[camera, landmarks, left]``; −1 for those that are known."""
        numbers = CAMERA + 3 * rows[:, None] + np.arange(3)
        numbers[rows >= self.count] += POSE * self.poses
        numbers[rows >= self.correlated] = -1
        return numbers.reshape(-1)

    def corrected(self, others: IndexArray, anew: Array, lost: tuple[Array, Array, Array], J: Array, K: Array) -> Covariance:
        """After an update, in the coordinates of the corrected state: ``P − V Vᵀ`` with ``V = P Hᵀ L⁻ᵀ``.

        For a landmark of which all three pixels are measured this is written differently. Of its error y as seen from
        the camera, in pixels, the part of S is ``P_yy + R``, so that

            P_yy − P_yy S⁻¹ P_yy = R − R S⁻¹ R,    P_yx − P_yy S⁻¹ P_yx = R S⁻¹ P_yx:

        as if the landmark had been put in anew where it is measured, independent of all else, with ``V = −R L⁻ᵀ``.
        What a landmark's prior covariance has lost by rounding is so made good whenever it is measured.

        Args:
            others: landmarks (U,) of the state that stay in it as they are; they become the first ones of the state.
            anew: covariances (F, 3, 3) of the measured ones' errors as seen from the camera, R in their coordinates.
            lost: V of the camera, of the others and those anew, in Fortran's order, and of what has left.
            J: the camera's error becomes J (12, 12) times what it was,
            K: and then to those of the landmarks K (U + F, 3, 6) times that of the pose is added.
        """
        V_camera, V, V_left = lost
        n, rows = 3 * len(others), 3 * others[:, None] + np.arange(3)
        shift, here = np.asfortranarray(K.reshape(-1, POSE)), rows.reshape(-1)
        camera, cross = np.zeros((CAMERA, len(V))), np.zeros((len(V), len(self.left)))
        camera[:, :n], cross[:n] = self.camera[:, CAMERA + here], self.cross[CAMERA + here]
        own = J @ (self.camera[:, :CAMERA] - V_camera @ V_camera.T) @ J.T
        own = _positive(0.5 * (own + own.T), self.camera.diagonal(), len(V.T))
        with_marks = J @ (camera - V_camera @ V.T)
        marks = np.zeros((0, 0))
        if len(V):
            before = kernels.with_independent(self.marks, others, anew)  # of which the upper triangle counts
            variances = before.diagonal().copy()
            marks = dsyrk(-1.0, V, beta=1.0, c=before.T, lower=1, overwrite_c=1)
            half = with_marks[:POSE].T + 0.5 * shift @ own[:POSE, :POSE]
            marks = dsyr2k(1.0, shift, half, beta=1.0, c=marks, lower=1, overwrite_c=1).T
            kernels.mirror(marks)
            _positive(marks, variances, len(V.T))
        with_marks += own[:, :POSE] @ shift.T
        head, rest = J @ (self.cross[:CAMERA] - V_camera @ V_left.T), cross - V @ V_left.T
        cross = np.concatenate([head, rest + shift @ head[:POSE]])
        return replace(self, camera=np.concatenate([own, with_marks], axis=1), marks=marks, cross=cross)


def _positive(P: Array, before: Array, terms: int) -> Array:
    """P (N, N), a difference or sum of so many terms, with the variances that rounding may have taken from it.

    By the variances (N,) of which it was made. Without them, a landmark that is hardly known in one direction may lose
    its variance in another one.
    """
    P.reshape(-1)[:: len(P) + 1] += terms * np.finfo(float).eps * before
    return P
