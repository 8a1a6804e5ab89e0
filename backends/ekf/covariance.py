"""The filter's covariance: of what is in the state, and of what has left it.

A landmark that has left is corrected no more, but its error's covariance with the state goes on: this is the filter of
Schmidt, whose covariance is exact for what it does. With the gain of such a landmark zero, ``P_AA`` changes as ever,
``P_Ab ← (1 − K H) P_Ab`` and ``P_bb`` not at all. When it is measured again it joins the state with its covariances.
The camera's last poses, as they were believed in their time, are kept in the same way (stochastic clones).
What is known of a landmark from elsewhere is independent of all else until it is measured: nothing need be carried.

Errors of the rig (`slam.interfaces.ConsideringBackend`) are such states, too: they are considered, but not estimated.
Their columns hold the derivatives of the state by them, which the same gain moves: a landmark's measurement is off by
``H x − F δ``, with a field F. Their own covariance is not needed here.
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
    """Of ``[camera (12), last poses (6K), A landmarks of the state (3A), B that left it (3B), errors of the rig (m)]``.

    The state are the camera and its landmarks. The poses are perturbed on the right, the newest first.
    """

    head: Array  # (12 + 6K, 12 + 6K + 3A + 3B + m), of camera and last poses with everything: a motion changes no more
    marks: Array  # (3A, 3A), of the state's landmarks
    cross: Array  # (3A, 3B + m), of these with what has left
    left: Array  # (3B, 3B + m), of landmarks that have left
    known: Array  # (C, 3, 3), of each landmark that is independent of all else
    rig: int = 0  # m

    @classmethod
    def of_camera(cls, P: Array) -> Covariance:
        """Of the camera alone (12, 12)."""
        none = np.zeros((0, 0))
        return cls(P, none, none, none, np.zeros((0, 3, 3)))

    def considering(self, by_rig: Array) -> Covariance:
        """With errors of the rig, by derivatives (12, m) of the camera's error, of which all else is made later."""
        m, head = by_rig.shape[1], np.concatenate([self.head, by_rig], axis=1)
        return replace(self, head=head, cross=np.zeros((0, m)), left=np.zeros((0, m)), rig=m)

    @property
    def count(self) -> int:
        """A: the first landmarks of the table."""
        return len(self.marks) // 3

    @property
    def correlated(self) -> int:
        """A + B: the landmarks after these are known from elsewhere."""
        return self.count + len(self.left) // 3

    @property
    def camera(self) -> Array:
        """Of the camera (12, 12)."""
        return self.head[:CAMERA, :CAMERA]

    @property
    def pose(self) -> Array:
        """Of its [r, φ] (6, 6)."""
        return self.head[:POSE, :POSE]

    def marginals(self, rows: IndexArray) -> tuple[Array, Array]:
        """Covariances (M, 3, 3) of landmarks, and theirs (M, 3, 6) with the camera's [r, φ]; by rows of the table."""
        a, b, h = self.count, self.correlated, len(self.head)
        blocks, state, left, known = np.empty((len(rows), 3, 3)), rows < a, (rows >= a) & (rows < b), rows >= b
        for part, P, first in ((state, self.marks, 0), (left, self.left, a)):
            each = 3 * (rows[part, None] - first) + np.arange(3)
            blocks[part] = P[each[:, :, None], each[:, None, :]]
        blocks[known] = self.known[rows[known] - b]
        with_pose = self.head[:POSE, h + self._numbers(rows)].T.reshape(len(rows), 3, POSE)
        with_pose[known] = 0.0
        return blocks, with_pose

    def by_rig(self, rows: IndexArray) -> tuple[Array, Array]:
        """Derivatives of the camera's error (12, m), and of some landmarks (M, 3, m), by errors of the rig."""
        landmarks = self._part(rows, rows[:0], self.rig)
        return self.head[:CAMERA, len(self.head.T) - self.rig :], landmarks.reshape(len(rows), 3, self.rig)

    def displaced(self, rows: IndexArray, change: Array) -> Covariance:
        """After a change (M, 3) of some landmarks' coordinates that is none of their error: the last of the rig's."""
        if not self.rig:
            return self
        numbers, cross, left = self._numbers(rows), self.cross.copy(), self.left.copy()
        for table, first in ((cross, 0), (left, len(cross))):
            here = (numbers >= first) & (numbers < first + len(table))
            table[numbers[here] - first, -1] -= change.reshape(-1)[here]
        return replace(self, cross=cross, left=left)

    def joint_poses(self, J: Array, n: int) -> Array:
        """Joint covariance (6n, 6n) of the last poses, the present one, J (6, 6) times [r, φ], last."""
        k = CAMERA + POSE * (n - 1)
        with_past = J @ self.head[:POSE, CAMERA:k]
        P = np.block([[J @ self.pose @ J.T, with_past], [with_past.T, self.head[CAMERA:k, CAMERA:k]]])
        order = np.arange(POSE * n).reshape(n, POSE)[::-1].reshape(-1)
        return np.asarray(P[order[:, None], order])

    # --- the camera moves ---

    def with_pose(self, J: Array, most: int) -> Covariance:
        """With the present pose, J (6, 6) times [r, φ], the first of the last ones; at most so many are kept."""
        k = min(len(self.head), CAMERA + POSE * (most - 1))
        stay = np.concatenate([np.arange(k), np.arange(len(self.head), self.head.shape[1])])
        head, new = self.head[:k, stay], J @ self.head[:POSE, stay]
        own = np.concatenate([new[:, :CAMERA], J @ self.pose @ J.T, new[:, CAMERA:]], axis=1)
        rows = np.concatenate([head[:, :CAMERA], new[:, :k].T, head[:, CAMERA:]], axis=1)
        return replace(self, head=np.concatenate([rows[:CAMERA], own, rows[CAMERA:]]))

    def camera_moved(self, J: Array, noise: Array) -> Covariance:
        """The camera's error (12,) becomes J times what it was, plus noise (12, 12)."""
        head = self.head.copy()
        head[:CAMERA] = J @ head[:CAMERA]
        own = head[:CAMERA, :CAMERA] @ J.T + noise
        head[:CAMERA, :CAMERA] = 0.5 * (own + own.T)
        head[CAMERA:, :CAMERA] = head[:CAMERA, CAMERA : len(head)].T
        return replace(self, head=head)

    # --- landmarks join and leave ---

    def appended(self, J: Array, noise: Array, by_rig: Array) -> Covariance:
        """With landmarks ``Y = g(r, φ) + noise`` (paper A, Eq. 10), by derivatives (M, 3, 6) and covariances (M, 3, 3).

        They are the last ones of the state. With the pose known, errors of the rig move them by `by_rig` (M, 3, m).
        """
        by_pose, n, h = J.reshape(-1, POSE), len(self.marks), len(self.head)
        rows, each = by_pose @ self.head[:POSE], np.arange(len(J))
        own = rows[:, :POSE] @ by_pose.T
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        marks, old = np.empty((n + len(rows), n + len(rows))), rows[:, h : h + n]
        marks[:n, :n], marks[n:, :n], marks[:n, n:] = self.marks, old, old.T
        marks[n:, n:] = positive(0.5 * (own + own.T), own.diagonal(), POSE)
        head = np.concatenate([self.head[:, : h + n], rows[:, :h].T, self.head[:, h + n :]], axis=1)
        rows[:, len(self.head.T) - self.rig :] += by_rig.reshape(len(rows), self.rig)
        return replace(self, head=head, marks=marks, cross=np.concatenate([self.cross, rows[:, h + n :]]))

    def rearranged(self, dense: IndexArray, left: IndexArray, known: IndexArray) -> Covariance:
        """With other landmarks in each of its parts, or fewer; by their rows of the table of landmarks."""
        h, first_known, new = len(self.head), self.correlated, np.flatnonzero(dense >= self.correlated)
        columns = np.concatenate([np.arange(h), h + self._numbers(dense), h + self._numbers(left)])
        head = np.concatenate([self.head[:, columns], self.head[:, len(self.head.T) - self.rig :]], axis=1)
        marks, rows = self._part(dense, dense, 0), 3 * new[:, None] + np.arange(3)
        head[:, h + rows.reshape(-1)] = 0.0
        marks[rows[:, :, None], rows[:, None, :]] = self.known[dense[new] - first_known]
        cross, own = self._part(dense, left, self.rig), self._part(left, left, self.rig)
        return Covariance(head, marks, cross, own, self.known[known - first_known], self.rig)

    def _numbers(self, rows: IndexArray) -> IndexArray:
        """Of landmarks' coordinates (3M,) in ``[A, B, rig]``; −1 for those that are known."""
        numbers = 3 * rows[:, None] + np.arange(3)
        numbers[rows >= self.correlated] = -1
        return numbers.reshape(-1)

    def _part(self, rows: IndexArray, columns: IndexArray, rig: int) -> Array:
        """Of landmarks' coordinates with others', and with so many errors of the rig."""
        return np.asarray(kernels.gather(self.marks, self.cross, self.left, rows, columns, rig))

    # --- an update ---

    def corrected(self, V: tuple[Array, Array, Array], J: Array, shift: Array) -> Covariance:
        """After an update, in the coordinates of the corrected state: ``P − K S Kᵀ = P − V Vᵀ`` (paper A, Eq. 11).

        Args:
            V: ``P Hᵀ L⁻ᵀ`` of camera and last poses, of the state's landmarks, in Fortran's order, of what has left.
            J: the camera's error becomes J (12, 12) times what it was,
            shift: and then to those of the landmarks this (A, 3, 6) times that of the pose is added.
        """
        V_head, V_marks, V_left = V
        h, n, terms = len(self.head), len(self.head) + len(self.marks), len(V_marks.T)
        head, shift = self.head.copy(), np.asfortranarray(shift.reshape(-1, POSE))
        lost = np.concatenate([V_head, V_left]) @ V_marks.T
        head[:, h:n] -= lost[:h]
        head[:CAMERA, :h] -= V_head[:CAMERA] @ V_head.T
        head[:CAMERA, n:] -= V_head[:CAMERA] @ V_left.T
        head[:CAMERA] = J @ head[:CAMERA]
        moved = head[:CAMERA, :CAMERA] @ J.T
        own = positive(0.5 * (moved + moved.T), self.camera.diagonal(), terms)
        head[:CAMERA, :CAMERA], head[CAMERA:, :CAMERA] = own, head[:CAMERA, CAMERA:h].T
        marks = self.marks
        if len(marks):
            marks = dsyrk(-1.0, V_marks, beta=1.0, c=marks.T, lower=1)  # a copy, of which the lower triangle counts
            half = head[:POSE, h:n].T + 0.5 * shift @ own[:POSE, :POSE]
            marks = dsyr2k(1.0, shift, half, beta=1.0, c=marks, lower=1, overwrite_c=1).T
            kernels.mirror(marks)
            positive(marks, self.marks.diagonal() + ((shift @ own[:POSE, :POSE]) * shift).sum(axis=1), terms)
        cross = self.cross - lost[h:].T + shift @ head[:POSE, n:]
        head[:, h:n] += head[:, :POSE] @ shift.T
        return replace(self, head=head, marks=marks, cross=cross)


def positive(P: Array, summands: Array, terms: int) -> Array:
    """P (..., N, N), a sum or difference of so many terms, with what rounding may have taken from its variances.

    The summands (..., N) are the variances of which these were made. Large ones may cancel: without this, a landmark
    that is hardly known in one direction loses its variance in another one.
    """
    each = np.arange(P.shape[-1])
    P[..., each, each] += terms * np.finfo(float).eps * summands
    return P
