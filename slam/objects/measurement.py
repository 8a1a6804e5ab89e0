"""What a frame's pixels say of points, in coordinates of the world or of a body: points with their information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray
from slam.rig import StereoRig
from slam.se3 import Array, hat, inverse, transform


@dataclass(frozen=True)
class View:
    """How the left camera stands in some frame of reference, and how well that is known.

    Attributes:
        T_frame_left: pose (4, 4) of the camera in the frame of reference.
        covariance: of the pose (6, 6), of a perturbation on the right, [rotation, translation].
    """

    T_frame_left: Array
    covariance: Array


@dataclass(frozen=True)
class Predicted:
    """Where points are expected in the images.

    Attributes:
        z: (N, 3) = (uL, vL, uR) [px]; NaN behind the camera.
        J: derivative by the point, in the axes of the frame of reference (N, 3, 3).
        S: covariance (N, 3, 3) [px²] of a measurement about z by pixel noise and camera pose, not by the point's own.
    """

    z: Array
    J: Array
    S: Array


def predict(rig: StereoRig, view: View, points: Array, sigma: float) -> Predicted:
    """Expected measurements of points (N, 3) in the view's frame of reference for pixel noise `sigma` [px]."""
    T_left_frame = inverse(view.T_frame_left)
    local = transform(T_left_frame, points)
    z, J_local = rig.project_stereo(local)
    J_pose = J_local @ _pose_jacobian(local)
    S = J_pose @ view.covariance @ np.swapaxes(J_pose, 1, 2) + sigma**2 * np.eye(3)
    return Predicted(z, J_local @ T_left_frame[:3, :3], S)


def measure(
    rig: StereoRig, T_frame_left: Array, points: Array, measured: Array, sigma: float
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Points (N, 3) that the pixels say, their information (N, 3, 3), and how many numbers each rests on (N,).

    Each is linearised on the measured ray, at the depth of the expected point: so the left pixel is met exactly, and
    the depth is linear in the disparity and therefore free of bias. Rows whose uR is NaN know nothing along the ray;
    rows that cannot be used have no information.

    Args:
        rig: the cameras.
        T_frame_left: pose (4, 4) of the left camera in the points' frame of reference.
        points: expected points (N, 3).
        measured: (N, 3) = (uL, vL, uR).
        sigma: pixel noise [px].
    """
    R = T_frame_left[:3, :3]
    depth = (points - T_frame_left[:3, 3]) @ R[:, 2]
    rays = np.column_stack([rig.left.normalise(measured[:, :2]), np.ones(len(points))])
    q = rays * depth[:, None]
    z, J = rig.project_stereo(q)
    mono = np.isnan(measured[:, 2])
    usable = np.isfinite(z).all(axis=1) & np.isfinite(J).all(axis=(1, 2)) & (depth > 0)
    J = np.where(usable[:, None, None], J, np.eye(3))
    along = np.linalg.inv(J)[:, :, 2]  # where the point goes for a pixel of uR
    step = np.where(usable & ~mono, measured[:, 2] - z[:, 2], 0.0)
    q = np.where(usable[:, None], q + along * step[:, None], 0.0)
    J = (J @ R.T) / sigma
    J[mono, 2] = 0.0
    J[~usable] = 0.0
    dof = np.where(usable, np.where(mono, 2, 3), 0).astype(np.int8)
    return transform(T_frame_left, q), np.swapaxes(J, 1, 2) @ J, dof


def pose_information(rig: StereoRig, local: Array, has_right: BoolArray, sigma: float) -> Array:
    """Information (6, 6) about the camera pose from points (N, 3) in left-camera coordinates seen with `sigma` [px]."""
    _, J_local = rig.project_stereo(local)
    J = J_local @ _pose_jacobian(local)
    J[~has_right, 2] = 0.0
    J = J[np.isfinite(J).all(axis=(1, 2))].reshape(-1, 6)
    return J.T @ J / sigma**2


def _pose_jacobian(local: Array) -> Array:
    """Derivative (N, 3, 6) of points in left-camera coordinates by the camera pose, perturbed on the right."""
    return np.concatenate([hat(local), np.broadcast_to(-np.eye(3), (len(local), 3, 3))], axis=2)
