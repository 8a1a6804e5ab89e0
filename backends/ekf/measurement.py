"""What the filter expects to measure, and how that depends on its state (paper A, Eqs. 5-10; paper B, Eqs. 1-5)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from backends.ekf.angles import attitude
from backends.ekf.landmarks import Coordinates
from slam.data import BoolArray
from slam.euler import body_rate_matrix
from slam.rig import StereoRig
from slam.se3 import Array

#: ``(a × b)_k = Σ a_i b_j CROSS[3 i + j, k]``
_CROSS = np.array([[np.cross(a, b) for b in np.eye(3)] for a in np.eye(3)]).reshape(9, 3)


@dataclass(frozen=True)
class Linearisation:
    """Predicted measurements and their derivatives, K pixel components a landmark.

    Attributes:
        z: predicted components (M, K) [px]; NaN behind a camera.
        by_relative: derivatives (M, K, 6) by [Y − r, φ]: the landmark less the camera's position, and the angles.
        by_landmark: derivatives (M, K, 3) by the landmark's own coordinates where these are not Y; else None.
    """

    z: Array
    by_relative: Array
    by_landmark: Array | None = None

    @property
    def by_point(self) -> Array:
        """Derivatives (M, K, 3) by the landmark Y, and with opposite sign by the camera's position r."""
        return self.by_relative[..., :3]

    @property
    def by_angles(self) -> Array:
        """Derivatives (M, K, 3) by the angles φ."""
        return self.by_relative[..., 3:]


class Measurement(Protocol):
    """Measurements as a function of ``x = [r, φ, each landmark]`` (6 + 3M,), whatever these refer to."""

    def predict(self, x: Array) -> Array:
        """Predicted components (M, 3) [px]; NaN behind a camera."""
        ...

    def linearise(self, x: Array) -> Linearisation:
        """The same with derivatives."""
        ...


@dataclass(frozen=True)
class StereoMeasurement:
    """(uL, vL, uR) of landmarks, as a function of ``x = [r, φ, coordinates of each landmark]`` (6 + 3M,).

    Attributes:
        rig: the cameras.
        R_world_angles: the angles' world (3, 3), see `backends.ekf.angles`.
        coordinates: what the landmarks' numbers mean.
        charts: the landmarks' charts (M, 3, 4).
    """

    rig: StereoRig
    R_world_angles: Array
    coordinates: Coordinates
    charts: Array

    def predict(self, x: Array) -> Array:
        """Predicted components (M, 3) [px]; NaN behind a camera."""
        return self.rig.project_stereo(self._local(x)[0], jacobian=False)[0]

    def linearise(self, x: Array) -> Linearisation:
        """The same with derivatives."""
        h, R = self._local(x)
        line = chained(*self.rig.project_stereo(h), h, R, x[3:6])
        D = self.coordinates.jacobian(self.charts, x[6:].reshape(-1, 3))
        return replace(line, by_landmark=line.by_point @ D)

    def _local(self, x: Array) -> tuple[Array, Array]:
        """Landmarks ``h = Rᵀ (Y − r)`` (M, 3) in camera coordinates (paper B, Eqs. 3-5), and R (3, 3)."""
        R = attitude(self.R_world_angles, x[3:6])
        return (self.coordinates.points(self.charts, x[6:].reshape(-1, 3)) - x[:3]) @ R, R


def chained(z: Array, J: Array, h: Array, R: Array, phi: Array) -> Linearisation:
    """Predicted components z (M, K) with derivatives J (M, K, 3) by the points h (M, 3) in camera coordinates."""
    out = np.empty((J.size // 3, 6))
    out[:, :3] = J.reshape(-1, 3) @ R.T
    # Turning the camera by δθ = E(φ) δφ about its own axes moves h by h × δθ, so z by (J × h) E δφ.
    products = J[..., :, None] * h[:, None, None, :]
    out[:, 3:] = products.reshape(-1, 9) @ (_CROSS @ body_rate_matrix(phi))
    return Linearisation(z, out.reshape(*J.shape[:2], 6))


def innovation_covariances(J: Array, pose: Array, cross: Array, blocks: Array, sigma: float) -> Array:
    """Covariances (M, K, K) [px²] of each landmark's innovation by itself, measurement noise included.

    Args:
        J: derivatives (M, K, 6) of the measurements by [Y − r, φ].
        pose: covariance (6, 6) of [r, φ].
        cross: covariances (M, 3, 6) of the landmarks with it.
        blocks: covariances (M, 3, 3) of the landmarks.
        sigma: pixel noise [px].
    """
    relative = np.empty((len(blocks), 6, 6))  # covariance of [Y − r, φ]: all that a measurement depends on
    by_r = cross[:, :, :3]
    relative[:, :3, :3] = blocks - by_r - by_r.transpose(0, 2, 1) + pose[:3, :3]
    relative[:, :3, 3:] = cross[:, :, 3:] - pose[:3, 3:]
    relative[:, 3:, :3] = relative[:, :3, 3:].transpose(0, 2, 1)
    relative[:, 3:, 3:] = pose[3:, 3:]
    return J @ relative @ J.transpose(0, 2, 1) + sigma**2 * np.eye(J.shape[1])


def stacked(line: Linearisation, rows: BoolArray) -> Array:
    """The dense Jacobian (3M, 6 + 3M) by [r, φ, landmarks]; zero where a row is not measured (mask (M, 3))."""
    m = len(line.z)
    J = line.by_relative
    own = line.by_point if line.by_landmark is None else line.by_landmark
    if not rows.all():
        J, own = np.where(rows[:, :, None], J, 0.0), np.where(rows[:, :, None], own, 0.0)
    H = np.zeros((m, 3, 2 + m, 3))
    H[:, :, 0], H[:, :, 1] = -J[..., :3], J[..., 3:]
    landmark = np.arange(m)
    H[landmark, :, 2 + landmark] = own
    return H.reshape(3 * m, 6 + 3 * m)
