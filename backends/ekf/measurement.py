"""What the filter expects to measure, and how that depends on its state (paper A, Eqs. 5-10; paper B, Eqs. 1-5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.ekf.angles import attitude
from slam.data import BoolArray
from slam.euler import body_rate_matrix
from slam.rig import StereoRig
from slam.se3 import Array


@dataclass(frozen=True)
class Linearisation:
    """Predicted measurements and their derivatives, K pixel components a landmark.

    Attributes:
        z: predicted components (M, K) [px]; NaN behind a camera.
        by_point: derivatives (M, K, 3) by the landmark Y, and with opposite sign by the camera's position r.
        by_angles: derivatives (M, K, 3) by the angles φ.
    """

    z: Array
    by_point: Array
    by_angles: Array


def linearise(rig: StereoRig, R_world_angles: Array, pose: Array, points: Array) -> Linearisation:
    """Predict (uL, vL, uR) of landmarks `points` (M, 3) [m] from the camera's ``pose = [r, φ]`` (6,)."""
    R = attitude(R_world_angles, pose[3:])
    h = (points - pose[:3]) @ R  # h = Rᵀ (Y − r), paper B, Eqs. (3)-(5)
    return chained(*rig.project_stereo(h), h, R, pose[3:])


def chained(z: Array, J: Array, h: Array, R: Array, phi: Array) -> Linearisation:
    """Predicted components z (M, K) with derivatives J (M, K, 3) by the points h (M, 3) in camera coordinates."""
    turned = np.empty_like(J)  # turning the camera by δθ about its own axes moves h by h × δθ
    hx, hy, hz = h[:, :1], h[:, 1:2], h[:, 2:]
    turned[..., 0] = J[..., 1] * hz - J[..., 2] * hy
    turned[..., 1] = J[..., 2] * hx - J[..., 0] * hz
    turned[..., 2] = J[..., 0] * hy - J[..., 1] * hx
    by_angles = (turned.reshape(-1, 3) @ body_rate_matrix(phi)).reshape(J.shape)  # δθ = E(φ) δφ
    return Linearisation(z, (J.reshape(-1, 3) @ R.T).reshape(J.shape), by_angles)


def innovation_covariances(line: Linearisation, pose: Array, cross: Array, blocks: Array, sigma: float) -> Array:
    """Covariances (M, K, K) [px²] of each landmark's innovation by itself, measurement noise included.

    Args:
        line: the predicted measurements.
        pose: covariance (6, 6) of [r, φ].
        cross: covariances (M, 3, 6) of the landmarks with it.
        blocks: covariances (M, 3, 3) of the landmarks.
        sigma: pixel noise [px].
    """
    relative = np.empty((len(blocks), 6, 6))  # covariance of [Y − r, φ]: all that a measurement depends on
    relative[:, :3, :3] = blocks - cross[:, :, :3] - np.swapaxes(cross[:, :, :3], 1, 2) + pose[:3, :3]
    relative[:, :3, 3:] = cross[:, :, 3:] - pose[:3, 3:]
    relative[:, 3:, :3] = np.swapaxes(relative[:, :3, 3:], 1, 2)
    relative[:, 3:, 3:] = pose[3:, 3:]
    J = np.concatenate([line.by_point, line.by_angles], axis=2)
    return J @ relative @ np.swapaxes(J, 1, 2) + sigma**2 * np.eye(J.shape[1])


def stacked(line: Linearisation, rows: BoolArray) -> Array:
    """The dense Jacobian (3M, 6 + 3M) by [r, φ, landmarks]; zero where a row is not measured (mask (M, 3))."""
    m = len(line.z)
    H = np.zeros((m, 3, 6 + 3 * m))
    by_point = np.where(rows[:, :, None], line.by_point, 0.0)
    H[:, :, :3] = -by_point
    H[:, :, 3:6] = np.where(rows[:, :, None], line.by_angles, 0.0)
    landmark, row, column = np.ogrid[:m, :3, :3]
    H[landmark, row, 6 + 3 * landmark + column] = by_point
    return H.reshape(3 * m, -1)
