"""The filter's covariance: of what is in the state, and of what has left it.

A landmark that has left is parked: it is corrected no more, but its error's covariance with the state goes on, as in
the filter of Schmidt, whose covariance is exact for what it does. With the gain of such a landmark zero, ``P_AA``
changes as ever, ``P_Ab ← (1 − K H) P_Ab`` and ``P_bb`` not at all. When it is measured again it joins the state with
its covariances.
The camera's last poses, as they were believed in their time, are kept in the same way (stochastic clones).
What is known of a landmark from elsewhere is independent of all else until it is measured: nothing need be carried.

Errors of the rig (`slam.interfaces.ConsideringBackend`) are considered, too, but not estimated. What is kept are the
derivatives of all errors by them, which the same gain moves: a landmark's measurement is off by ``H x − F δ``, with a
field F. Their own covariance is not needed here.
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
    """Of ``[camera (12), last poses (6K), B landmarks that left the state (3B), A that are in it (3A)]``.

    The state are the camera and its landmarks. The poses are perturbed on the right, the newest first. Rows of the
    table of landmarks are in this order; behind them are those that are known from elsewhere.
    """

    head: Array  # (12 + 6K, 12 + 6K + 3B + 3A), of camera and last poses with everything: a motion changes no more
    marks: Array  # (3B + 3A, 3B + 3A), of landmarks
    by_rig: Array  # derivatives (12 + 6K + 3B + 3A, m) of all errors by those of the rig
    known: Array  # (C, 3, 3), of each landmark that is independent of all else
    parked: int = 0  # B

    @classmethod
    def of_camera(cls, P: Array, by_rig: Array | None = None) -> Covariance:
        """Of the camera alone (12, 12), with derivatives (12, m) of its error by errors of the rig."""
        return cls(P, np.zeros((0, 0)), np.zeros((CAMERA, 0)) if by_rig is None else by_rig, np.zeros((0, 3, 3)))

    @property
    def correlated(self) -> int:
        """B + A: the landmarks after these are known from elsewhere."""
        return len(self.marks) // 3

    @property
    def poses(self) -> int:
        """1 + K: the present pose and those before it that are kept."""
        return 1 + (len(self.head) - CAMERA) // POSE

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
        blocks, with_pose, known = np.empty((len(rows), 3, 3)), np.zeros((len(rows), 3, POSE)), rows >= self.correlated
        each = numbers_of(rows[~known]).reshape(-1, 3)
        blocks[~known] = self.marks[each[:, :, None], each[:, None, :]]
        blocks[known] = self.known[rows[known] - self.correlated]
        with_pose[~known] = self.head[:POSE, len(self.head) + each].transpose(1, 2, 0)
        return blocks, with_pose

    def landmarks_by_rig(self, rows: IndexArray) -> Array:
        """Derivatives (M, 3, m) of some landmarks by errors of the rig."""
        out, there = np.zeros((len(rows), 3, self.by_rig.shape[1])), rows < self.correlated
        out[there] = self.by_rig[len(self.head) + numbers_of(rows[there])].reshape(-1, *out.shape[1:])
        return out

    def joint_poses(self, J: Array, n: int) -> Array:
        """Joint covariance (6n, 6n) of the last poses, the present one, J (6, 6) times [r, φ], last."""
        k = CAMERA + POSE * (n - 1)
        with_past = J @ self.head[:POSE, CAMERA:k]
        P = np.block([[J @ self.pose @ J.T, with_past], [with_past.T, self.head[CAMERA:k, CAMERA:k]]])
        order = np.arange(POSE * n).reshape(n, POSE)[::-1].reshape(-1)
        P = P[order[:, None], order]
        return np.asarray(0.5 * (P + P.T))

    # --- the camera moves ---

    def with_pose(self, J: Array, most: int) -> Covariance:
        """With the present pose, J (6, 6) times [r, φ], the first of the last ones; at most so many are kept."""
        k = min(len(self.head), CAMERA + POSE * (most - 1))
        stay = np.concatenate([np.arange(k), np.arange(len(self.head), self.head.shape[1])])
        head, rig = self.head[:k, stay], self.by_rig[stay]
        new = J @ head[:POSE]
        own = np.concatenate([new[:, :CAMERA], J @ self.pose @ J.T, new[:, CAMERA:]], axis=1)
        rows = np.concatenate([head[:, :CAMERA], new[:, :k].T, head[:, CAMERA:]], axis=1)
        return replace(
            self, head=np.concatenate([rows[:CAMERA], own, rows[CAMERA:]]),
            by_rig=np.concatenate([rig[:CAMERA], J @ rig[:POSE], rig[CAMERA:]]),
        )  # fmt: skip

    def camera_moved(self, J: Array, noise: Array) -> Covariance:
        """The camera's error (12,) becomes J times what it was, plus noise (12, 12)."""
        head, by_rig = self.head.copy(), self.by_rig.copy()
        head[:CAMERA], by_rig[:CAMERA] = J @ head[:CAMERA], J @ by_rig[:CAMERA]
        own = head[:CAMERA, :CAMERA] @ J.T + noise
        head[:CAMERA, :CAMERA] = 0.5 * (own + own.T)
        head[CAMERA:, :CAMERA] = head[:CAMERA, CAMERA : len(head)].T
        return replace(self, head=head, by_rig=by_rig)

    # --- landmarks join and leave ---

    def appended(self, J: Array, noise: Array, by_rig: Array) -> Covariance:
        """With landmarks ``Y = g(r, φ) + noise`` (paper A, Eq. 10), by derivatives (M, 3, 6) and covariances (M, 3, 3).

        They are the last ones of the state. With the pose known, errors of the rig move them by `by_rig` (M, 3, m).
        """
        by_pose, n, h, each = J.reshape(-1, POSE), len(self.marks), len(self.head), np.arange(len(J))
        rows = by_pose @ self.head[:POSE]
        own = rows[:, :POSE] @ by_pose.T
        own.reshape(len(J), 3, len(J), 3)[each, :, each] += noise
        marks = np.empty((n + len(rows), n + len(rows)))
        marks[:n, :n], marks[n:, :n], marks[:n, n:] = self.marks, rows[:, h:], rows[:, h:].T
        marks[n:, n:] = positive(0.5 * (own + own.T), own.diagonal(), POSE)
        head = np.concatenate([self.head, rows[:, :h].T], axis=1)
        rig = by_pose @ self.by_rig[:POSE] + by_rig.reshape(len(rows), self.by_rig.shape[1])
        return replace(self, head=head, marks=marks, by_rig=np.concatenate([self.by_rig, rig]))

    def rearranged(self, parked: IndexArray, state: IndexArray, known: IndexArray) -> Covariance:
        """With other landmarks in each of its parts, or fewer; by their rows of the table of landmarks."""
        h, order, first = len(self.head), np.concatenate([parked, state]), self.correlated
        numbers = np.where(np.repeat(order, 3) < first, numbers_of(order), -1)
        marks, new = kernels.gather(self.marks, numbers, numbers), np.flatnonzero(order >= first)
        each = numbers_of(new).reshape(-1, 3)
        marks[each[:, :, None], each[:, None, :]] = self.known[order[new] - first]
        head = kernels.gather(self.head, np.arange(h), np.where(numbers < 0, -1, h + numbers))
        by_rig = kernels.gather(self.by_rig[h:], numbers, np.arange(self.by_rig.shape[1]))
        return Covariance(
            np.concatenate([self.head[:, :h], head], axis=1), marks, np.concatenate([self.by_rig[:h], by_rig]),
            self.known[known - first], len(parked),
        )  # fmt: skip

    # --- an update ---

    def corrected(self, V: tuple[Array, Array, Array], lost_by_rig: Array, J: Array, shift: Array) -> Covariance:
        """After an update, in the coordinates of the corrected state: ``P − K S Kᵀ = P − V Vᵀ`` (paper A, Eq. 11).

        Args:
            V: ``P Hᵀ L⁻ᵀ`` of camera and last poses, of what has left, of the state's landmarks, in Fortran's order.
            lost_by_rig: L⁻¹ times derivatives (3M, m) of the innovation by errors of the rig.
            J: the camera's error becomes J (12, 12) times what it was,
            shift: and then to those of the landmarks this (A, 3, 6) times that of the pose is added.
        """
        V_head, V_parked, V_marks = V
        h, b, terms = len(self.head), 3 * self.parked, len(V_marks.T)
        head, by_rig, shift = self.head.copy(), self.by_rig.copy(), np.asfortranarray(shift.reshape(-1, POSE))
        head[:CAMERA, :h] -= V_head[:CAMERA] @ V_head.T
        head[:CAMERA, h : h + b] -= V_head[:CAMERA] @ V_parked.T
        head[:, h + b :] -= V_head @ V_marks.T
        by_rig[:CAMERA] -= V_head[:CAMERA] @ lost_by_rig
        head[:CAMERA], by_rig[:CAMERA] = J @ head[:CAMERA], J @ by_rig[:CAMERA]
        moved = head[:CAMERA, :CAMERA] @ J.T
        own = positive(0.5 * (moved + moved.T), self.camera.diagonal(), terms)
        head[:CAMERA, :CAMERA], head[CAMERA:, :CAMERA] = own, head[:CAMERA, CAMERA:h].T
        marks = self.marks[b:, b:]
        if len(marks):
            marks = dsyrk(-1.0, V_marks, beta=1.0, c=marks.T, lower=1)  # a copy, of which the lower triangle counts
            half = head[:POSE, h + b :].T + 0.5 * shift @ own[:POSE, :POSE]
            marks = dsyr2k(1.0, shift, half, beta=1.0, c=marks, lower=1, overwrite_c=1).T
            kernels.mirror(marks)
            summands = self.marks.diagonal()[b:] + ((shift @ own[:POSE, :POSE]) * shift).sum(axis=1)
            positive(marks, summands, terms)
        if b:
            state, marks = marks, self.marks.copy()
            cross = self.marks[b:, :b] - V_marks @ V_parked.T + shift @ head[:POSE, h : h + b]
            marks[b:, b:], marks[b:, :b], marks[:b, b:] = state, cross, cross.T
        by_rig[h + b :] += shift @ by_rig[:POSE] - V_marks @ lost_by_rig
        head[:, h + b :] += head[:, :POSE] @ shift.T
        return replace(self, head=head, marks=marks, by_rig=by_rig)

    def displaced(self, rows: IndexArray, change: Array, shift: Array) -> Covariance:
        """After a change (M, 3) of some landmarks' coordinates that is none of their error, with a shift as above.

        It is that of the last of the rig's errors, which is known to be 1 (`slam.interfaces.ConsideringBackend`).
        """
        by_rig, h, b = self.by_rig.copy(), len(self.head), 3 * self.parked
        by_rig[h + numbers_of(rows), -1:] -= change.reshape(-1, 1)
        V = np.zeros((h, 1)), np.zeros((b, 1)), np.zeros((len(self.marks) - b, 1), order="F")
        nothing = np.zeros((1, by_rig.shape[1]))
        return replace(self, by_rig=by_rig).corrected(V, nothing, np.eye(CAMERA), shift)


def numbers_of(rows: IndexArray) -> IndexArray:
    """Of landmarks' coordinates (3M,) among those of all."""
    return np.asarray((3 * rows[:, None] + np.arange(3)).reshape(-1))


def positive(P: Array, summands: Array, terms: int) -> Array:
    """P (..., N, N), a sum or difference of so many terms, with what rounding may have taken from its variances.

    The summands (..., N) are the variances of which these were made. Large ones may cancel: without this, a landmark
    that is hardly known in one direction loses its variance in another one.
    """
    each = np.arange(P.shape[-1])
    P[..., each, each] += terms * np.finfo(float).eps * summands
    return P
