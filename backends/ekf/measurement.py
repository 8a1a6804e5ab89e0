"""What the filter expects to measure, and how that depends on its state (paper A, Eqs. 5-10; paper B, Eqs. 1-5)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from backends.ekf import kernels
from backends.ekf.angles import attitude
from backends.ekf.landmarks import Coordinates
from slam.data import BoolArray, IndexArray
from slam.geometry.euler import body_rate_matrix
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, hat

#: ``hat(h) = Σ h_k _HAT[k]``
_HAT = hat(np.eye(3))


@dataclass(frozen=True, eq=False)
class Displacement:
    """What an update does not measure: a displacement ξ (6,) of camera and landmarks together.

    Attributes:
        change: U (6 + 3M, 6); ξ changes g = [r, φ, measured landmarks] by ``U ξ``.
        share: L (6, 6 + 3M); a change c of g displaces the world by ``ξ = L c``.
        g: where these stand in the state (6 + 3M,).
    """

    change: Array
    share: Array
    g: IndexArray


@dataclass(frozen=True, eq=False)
class Jacobian:
    """H (3M, n) by the state, as products with it; ``H − H U L`` where it is taken without a displacement of the world.

    Attributes:
        by_pose: derivatives (M, 3, 6) by [r, φ].
        own: derivatives (M, 3, 3) of each landmark's measurement by the landmark's own coordinates.
        first: where these begin in the state (M,).
        displacement: U and L, or None.
        by_displacement: ``H U`` (3M, 6) with the plain H, if there is one.
    """

    by_pose: Array
    own: Array
    first: IndexArray
    displacement: Displacement | None = None
    by_displacement: Array = field(default_factory=lambda: np.zeros((0, 6)))

    def without(self, displacement: Displacement) -> Jacobian:
        """Without a displacement of the world."""
        U, m = displacement.change, len(self.own)
        moved = self.own @ U[6:].reshape(m, 3, 6) + self.by_pose @ U[:6]
        return replace(self, displacement=displacement, by_displacement=moved.reshape(3 * m, 6))

    def only(self, rows: BoolArray) -> Jacobian:
        """With zero where a row is not measured (mask (M, 3))."""
        each, by_displacement = rows[:, :, None], self.by_displacement
        if self.displacement is not None:
            by_displacement = np.where(rows.reshape(-1, 1), by_displacement, 0.0)
        by_pose, own = np.where(each, self.by_pose, 0.0), np.where(each, self.own, 0.0)
        return replace(self, by_pose=by_pose, own=own, by_displacement=by_displacement)

    def times(self, X: Array) -> Array:
        """``H X`` (3M, N) for X (n, N)."""
        out = np.empty((3 * len(self.own), X.shape[1]))
        kernels.times(self.by_pose, self.own, self.first, X, out)
        if self.displacement is not None:
            out -= self.by_displacement @ (self.displacement.share @ X[self.displacement.g])
        return out

    def covariance(self, HP: Array, variance: float) -> Array:
        """``H (H P)ᵀ + variance 1`` (3M, 3M): its lower triangle, and zero."""
        S = np.zeros((len(HP), len(HP)))
        kernels.innovation_covariance(self.by_pose, self.own, self.first, HP, variance, S)
        if self.displacement is not None:
            S -= (HP[:, self.displacement.g] @ self.displacement.share.T) @ self.by_displacement.T
        return S

    def own_covariances(self, pose: Array, cross: Array, blocks: Array) -> Array:
        """Covariances (M, 3, 3) [px²] of each landmark's innovation by itself, without the measurement's noise.

        Args:
            pose: covariance (6, 6) of [r, φ].
            cross: covariances (M, 3, 6) of the landmarks' own coordinates with it.
            blocks: covariances (M, 3, 3) of these coordinates.
        """
        A, B = self.by_pose, self.own
        S = (A @ pose + 2 * (B @ cross)) @ A.transpose(0, 2, 1)
        return np.asarray(0.5 * (S + S.transpose(0, 2, 1)) + B @ blocks @ B.transpose(0, 2, 1))

    def transposed_times(self, y: Array) -> Array:
        """``Hᵀ y`` (6 + 3M,) of g, for y (3M,); it is zero elsewhere."""
        m = len(self.own)
        landmarks = (y.reshape(m, 1, 3) @ self.own).reshape(3 * m)
        out = np.concatenate([y @ self.by_pose.reshape(3 * m, 6), landmarks])
        if self.displacement is not None:
            out -= (y @ self.by_displacement) @ self.displacement.share
        return out


@dataclass(frozen=True, eq=False)
class Measurement:
    """(uL, vL, uR) of landmarks, as a function of the camera's [r, φ] and the landmarks' coordinates.

    Attributes:
        rig: the cameras.
        R_world_angles: the angles' world (3, 3), see `backends.ekf.angles`.
        coordinates: what the landmarks' numbers mean.
        anchors: the landmarks' anchors (M, 3, 4).
    """

    rig: StereoRig
    R_world_angles: Array
    coordinates: Coordinates
    anchors: Array

    def predict(self, pose: Array, c: Array) -> Array:
        """Predicted components (M, 3) [px] at [r, φ] (6,) and coordinates c (M, 3); NaN behind a camera."""
        return self.rig.project_stereo(self._local(pose, c)[0], jacobian=False)[0]

    def linearise(self, pose: Array, c: Array, first: IndexArray) -> tuple[Array, Jacobian]:
        """The same with derivatives by a state in which landmarks' coordinates begin at `first` (M,)."""
        h, R = self._local(pose, c)
        z, J = self.rig.project_stereo(h)
        by_point = J @ R.T
        # Turning the camera by δθ = E(φ) δφ about its own axes moves h by h × δθ.
        turned = h @ (_HAT @ body_rate_matrix(pose[3:])).reshape(3, 9)
        by_pose = np.concatenate([-by_point, J @ turned.reshape(-1, 3, 3)], axis=2)
        return z, Jacobian(by_pose, by_point @ self.coordinates.jacobian(self.anchors, c), first)

    def _local(self, pose: Array, c: Array) -> tuple[Array, Array]:
        """Landmarks ``h = Rᵀ (Y − r)`` (M, 3) in camera coordinates (paper B, Eqs. 3-5), and R (3, 3)."""
        R = attitude(self.R_world_angles, pose[3:])
        return (self.coordinates.points(self.anchors, c) - pose[:3]) @ R, R
