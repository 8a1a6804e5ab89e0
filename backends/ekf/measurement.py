"""What the filter expects to measure, and how that depends on its state (paper A, Eqs. 5-10; paper B, Eqs. 1-5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.ekf import kernels
from backends.ekf.landmarks import Coordinates
from slam.data import BoolArray, IndexArray
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class Measurement:
    """(uL, vL, uR) of landmarks, as a function of the camera's pose and the landmarks' coordinates.

    Attributes:
        rig: the cameras.
        coordinates: what the landmarks' numbers mean.
        anchors: the landmarks' anchors (M, 3, 4).
    """

    rig: StereoRig
    coordinates: Coordinates
    anchors: Array

    def predict(self, T: Array, c: Array) -> Array:
        """Predicted components (M, 3) [px] at a pose T (4, 4) and coordinates c (M, 3); NaN behind a camera."""
        return self.rig.project_stereo(self._local(T, c), jacobian=False)[0]

    def linearise(self, T: Array, c: Array) -> tuple[Array, Array]:
        """The same with derivatives (M, 3, 3) by the coordinates."""
        z, J = self.rig.project_stereo(self._local(T, c))
        return z, J @ (T[:3, :3].T @ self.coordinates.jacobian(self.anchors, c))

    def _local(self, T: Array, c: Array) -> Array:
        """Landmarks ``h = Rᵀ (Y − r)`` (M, 3) in camera coordinates (paper B, Eqs. 3-5)."""
        return np.asarray((self.coordinates.points(self.anchors, c) - T[:3, 3]) @ T[:3, :3])


@dataclass(frozen=True, eq=False)
class Jacobian:
    """H (3M, n) of the measurements by the state's error, as products with it.

    A landmark's measurement depends on where it is as seen from the camera alone. An error x of the camera's pose moves
    it there by ``−lever x`` in its own coordinates, so that ``H = own [−lever, 1]`` has columns for the pose and
    the landmark: a displacement of both together is no row's business, wherever H is taken.

    Attributes:
        own: derivatives (M, 3, 3) of each landmark's measurement by the landmark's own coordinates.
        by_pose: derivatives (M, 3, 6) by the pose's error.
        first: where the landmarks' coordinates begin in the state (M,).
    """

    own: Array
    by_pose: Array
    first: IndexArray

    @classmethod
    def of(cls, own: Array, lever: Array, first: IndexArray, rows: BoolArray | None = None) -> Jacobian:
        """With zero where a row is not measured (mask (M, 3))."""
        own = own if rows is None or rows.all() else np.where(rows[:, :, None], own, 0.0)
        return cls(own, -own @ lever, first)

    def times(self, X: Array) -> Array:
        """``H X`` (3M, N) for X (n, N)."""
        out = np.empty((3 * len(self.own), X.shape[1]))
        kernels.times(self.by_pose, self.own, self.first, X, out)
        return out

    def covariance(self, HP: Array, variance: float) -> Array:
        """``H (H P)ᵀ + variance 1`` (3M, 3M): its lower triangle, and zero."""
        S = np.zeros((len(HP), len(HP)))
        kernels.innovation_covariance(self.by_pose, self.own, self.first, HP, variance, S)
        return S

    def own_covariances(self, pose: Array, cross: Array, blocks: Array) -> Array:
        """Covariances (M, 3, 3) [px²] of each landmark's innovation by itself, without the measurement's noise.

        Args:
            pose: covariance (6, 6) of the pose's error.
            cross: covariances (M, 3, 6) of the landmarks' own coordinates with it.
            blocks: covariances (M, 3, 3) of these coordinates.
        """
        A, B = self.by_pose, self.own
        S = (A @ pose + 2 * (B @ cross)) @ A.transpose(0, 2, 1)
        return np.asarray(0.5 * (S + S.transpose(0, 2, 1)) + B @ blocks @ B.transpose(0, 2, 1))

    def transposed_times(self, y: Array) -> Array:
        """``Hᵀ y`` (6 + 3M,) of [pose, measured landmarks], for y (3M,); it is zero elsewhere."""
        m = len(self.own)
        return np.concatenate([y @ self.by_pose.reshape(3 * m, 6), (y.reshape(m, 1, 3) @ self.own).reshape(3 * m)])
