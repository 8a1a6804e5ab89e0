"""What the filter expects to measure, and how that depends on its state (paper A, Eqs. 5-10; paper B, Eqs. 1-5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from backends.ekf.angles import attitude
from backends.ekf.landmarks import Coordinates
from slam.geometry.euler import body_rate_matrix
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, hat

#: ``hat(h) = Σ h_k _HAT[k]``
_HAT = hat(np.eye(3))

_BY_POSE = np.array([-1.0, -1, -1, 1, 1, 1])  # the camera's position counts with opposite sign


@dataclass(frozen=True, eq=False)
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
    def by_pose(self) -> Array:
        """Derivatives (M, K, 6) by the camera's [r, φ]."""
        return np.asarray(self.by_relative * _BY_POSE)

    @property
    def own(self) -> Array:
        """Derivatives (M, K, 3) by the landmark's own coordinates."""
        return self.by_point if self.by_landmark is None else self.by_landmark


class Measurement(Protocol):
    """Measurements as a function of ``x = [r, φ, each landmark]`` (6 + 3M,), whatever these refer to."""

    def predict(self, x: Array) -> Array:
        """Predicted components (M, 3) [px]; NaN behind a camera."""
        ...

    def linearise(self, x: Array) -> Linearisation:
        """The same with derivatives."""
        ...


@dataclass(frozen=True, eq=False)
class StereoMeasurement:
    """(uL, vL, uR) of landmarks, as a function of ``x = [r, φ, coordinates of each landmark]`` (6 + 3M,).

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

    def predict(self, x: Array) -> Array:
        """Predicted components (M, 3) [px]; NaN behind a camera."""
        return self.rig.project_stereo(self._local(x)[0], jacobian=False)[0]

    def linearise(self, x: Array) -> Linearisation:
        """The same with derivatives."""
        h, R = self._local(x)
        D = self.coordinates.jacobian(self.anchors, self._landmarks(x))
        return chained(*self.rig.project_stereo(h), h, R, x[3:6], D)

    def _local(self, x: Array) -> tuple[Array, Array]:
        """Landmarks ``h = Rᵀ (Y − r)`` (M, 3) in camera coordinates (paper B, Eqs. 3-5), and R (3, 3)."""
        R = attitude(self.R_world_angles, x[3:6])
        return (self.coordinates.points(self.anchors, self._landmarks(x)) - x[:3]) @ R, R

    def _landmarks(self, x: Array) -> Array:
        """The landmarks' coordinates (M, 3); a linear step may ask for a point beyond infinity: it is at infinity."""
        return self.coordinates.proper(x[6:].reshape(-1, 3))


def chained(z: Array, J: Array, h: Array, R: Array, phi: Array, D: Array) -> Linearisation:
    """Predicted components z (M, K) with derivatives J (M, K, 3) by the points h (M, 3) in camera coordinates.

    D (M, 3, 3) are derivatives of the landmarks' positions by their own coordinates.
    """
    out = np.empty((*J.shape[:2], 6))
    out[..., :3] = J @ R.T
    # Turning the camera by δθ = E(φ) δφ about its own axes moves h by h × δθ.
    turned = h @ (_HAT @ body_rate_matrix(phi)).reshape(3, 9)
    out[..., 3:] = J @ turned.reshape(-1, 3, 3)
    return Linearisation(z, out, out[..., :3] @ D)


def innovation_covariances(line: Linearisation, pose: Array, cross: Array, blocks: Array) -> Array:
    """Covariances (M, K, K) [px²] of each landmark's innovation by itself, without the measurement's noise.

    Args:
        line: derivatives of the measurements.
        pose: covariance (6, 6) of [r, φ].
        cross: covariances (M, 3, 6) of the landmarks' own coordinates with it.
        blocks: covariances (M, 3, 3) of these coordinates.
    """
    A, B = line.by_pose, line.own
    At = A.transpose(0, 2, 1)
    S = (A @ pose + 2 * (B @ cross)) @ At
    return np.asarray(0.5 * (S + S.transpose(0, 2, 1)) + B @ blocks @ B.transpose(0, 2, 1))
