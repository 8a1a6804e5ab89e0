"""The measurement ``z = h(x)`` and its Jacobian H (paper A, Eqs. 5-10; paper B, Eqs. 1-5).

A component that is not measured (or gated) keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from backends.ekf import kernels
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import Coordinates
from slam.data import IndexArray
from slam.geometry.se3 import Array
from slam.window.stereo import RectifiedStereo


@dataclass(frozen=True, eq=False)
class Measurement:
    """(uL, vL, uR) of landmarks, by the camera's pose and their coordinates (paper A, Eqs. 5-10; B, Eqs. 1-5)."""

    stereo: RectifiedStereo
    coordinates: Coordinates
    anchors: Array  # of the landmarks (M, 3, 4)

    def at(self, T: Array, c: Array) -> tuple[Array, Array]:
        """Predicted (M, 3) [px] at a pose T (4, 4) and coordinates c (M, 3), NaN behind a camera.

        And derivatives (M, 3, 3) by the coordinates. A landmark is at ``h = Rᵀ (Y − r)`` (paper B, Eqs. 3-5).
        """
        z, J = self.seen(T, c)
        return z, J @ (T[:3, :3].T @ self.coordinates.jacobian(self.anchors, c))

    def seen(self, T: Array, c: Array) -> tuple[Array, Array]:
        """Predicted (M, 3) as `at`, and derivatives (M, 3, 3) by the points in the camera's axes."""
        return self.stereo.project((self.coordinates.points(self.anchors, c) - T[:3, 3]) @ T[:3, :3])


@dataclass(frozen=True, eq=False)
class Jacobian:
    """H (3M, n) of the measurements by the state's error, as products with it.

    A landmark's measurement depends on where it is as seen from the camera alone. An error x of the camera's pose moves
    it there by ``−lever x`` in its own coordinates, so that ``H = own [−lever, 1]`` has columns for the pose and
    the landmark: a displacement of both together is no row's business, wherever H is taken.
    """

    own: Array  # derivatives (M, 3, 3) of each landmark's measurement by its own coordinates
    lever: Array  # (M, 3, 6)
    marks: IndexArray  # which landmarks of the state these are (M,)

    @cached_property
    def by_pose(self) -> Array:
        """Derivatives (M, 3, 6) by the pose's error."""
        return np.asarray(-self.own @ self.lever)

    def times(self, P: Covariance) -> tuple[Array, Array]:
        """``H P``: with the camera (3M, 12), and with the landmarks of the state (3M, 3A)."""
        with_camera, with_marks = (np.empty((3 * len(self.own), n)) for n in (CAMERA, len(P.marks)))
        kernels.times(self.by_pose, self.own, self.marks, P.head, P.marks, with_camera, with_marks)
        return with_camera, with_marks

    def times_rest(self, P: Covariance) -> Array:
        """``H P``: with the last poses, and with what has left the state."""
        h, numbers = len(P.head), (3 * self.marks[:, None] + np.arange(3)).reshape(-1)
        with_pose = np.concatenate([P.head[:POSE, CAMERA:h], P.head[:POSE, h + len(P.marks) :]], axis=1)
        with_marks = np.concatenate([P.head[CAMERA:, h + numbers].T, P.cross[numbers]], axis=1)
        n = len(with_pose.T)
        shape = len(self.own), 3, n
        HP = self.own @ with_marks.reshape(shape) + self.by_pose @ with_pose
        return np.asarray(HP).reshape(3 * len(self.own), n)

    def covariance(self, with_camera: Array, with_marks: Array, variance: float) -> Array:
        """``H (H P)ᵀ + variance 1`` (3M, 3M), by the parts of H P: its lower triangle, and zero."""
        S = np.zeros((len(with_camera), len(with_camera)))
        kernels.innovation_covariance(self.by_pose, self.own, self.marks, with_camera, with_marks, variance, S)
        return S

    def own_covariances(self, pose: Array, cross: Array, blocks: Array) -> Array:
        """Covariances (M, 3, 3) [px²] of each landmark's innovation by itself, without the measurement's noise.

        By those of the pose's error (6, 6), of the landmarks' own coordinates with it (M, 3, 6), and of these.
        """
        A, B = self.by_pose, self.own
        S = (A @ pose + 2 * (B @ cross)) @ A.transpose(0, 2, 1)
        return np.asarray(0.5 * (S + S.transpose(0, 2, 1)) + B @ blocks @ B.transpose(0, 2, 1))

    def transposed_times(self, y: Array) -> Array:
        """``Hᵀ y`` (6 + 3M,) of [pose, measured landmarks], for y (3M,); it is zero elsewhere."""
        m = len(self.own)
        return np.concatenate([y @ self.by_pose.reshape(3 * m, 6), (y.reshape(m, 1, 3) @ self.own).reshape(3 * m)])
