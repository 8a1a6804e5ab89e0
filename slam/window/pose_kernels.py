"""Compiled loops of `slam.window.pose_only`: residuals of one pose, and Gauss-Newton on them."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised
from slam.kernels.se3 import move, transform_back
from slam.kernels.stereo import by_pose, residual
from slam.runtime.compilation import helper, kernel


@kernel
def moved(poses, steps):
    """Poses (n, 4, 4) changed on the right by tangent vectors (n, 6)."""
    out = poses.copy()
    for i in range(len(out)):
        move(out[i], steps[i])
    return out


@kernel
def residuals(camera, R_left, points, z, T):
    """Measured less predicted (M, 3), NaN where missing or behind, and the prediction's Jacobians (M, 3, 6) by T.

    Args:
        camera: of the rectified rig (7,), see `slam.kernels.stereo`.
        R_left: rotation (3, 3) from left-camera to rectified coordinates.
        points: in world coordinates (M, 3).
        z: measurements (M, 3).
        T: pose T_world_left (4, 4).
    """
    r, J = np.empty((len(points), 3)), np.empty((len(points), 3, 6))
    local, by_local = np.empty(3), np.empty((3, 3))
    for m in range(len(points)):
        _residual(camera, R_left, points[m], z[m], T, local, by_local, r[m], J[m])
    return r, J


@helper
def _residual(camera, R_left, point, z, T, local, by_local, r, J):
    """Measured less predicted r (3,) and derivatives J (3, 6) of the prediction by T; zero where it is behind."""
    transform_back(T, point, local)
    residual(camera, R_left, local, z, r, by_local)
    for i in range(3):
        by_pose(by_local[i], local, J[i])


@kernel
def gauss_newton(camera, R_left, points, z, whitener, used, information, prior, start, huber, steps, enough):
    """The pose (4, 4) by at most `steps` steps of Gauss-Newton from `start`.

    Args:
        camera: of the rectified rig (7,), see `slam.kernels.stereo`.
        R_left: rotation (3, 3) from left-camera to rectified coordinates.
        points: in world coordinates (M, 3).
        z: measurements (M, 3), NaN where missing.
        whitener: of the residuals (M, 3, 3).
        used: which measurements count (M,).
        information: of the prior (6, 6).
        prior: the start beside the prior's mean (6,).
        start: pose (4, 4).
        huber: whitened residual from which on a measurement's pull no longer grows; ∞ for least squares.
        steps: at most so many.
        enough: steps that are smaller are the last [rad, m].
    """
    T, off = start.copy(), prior.copy()
    r, J, white, G = np.empty(3), np.empty((3, 6)), np.empty(3), np.empty((3, 6))
    local, by_local = np.empty(3), np.empty((3, 3))
    H, step = np.empty((6, 6)), np.empty(6)
    for _ in range(steps):
        for i in range(6):
            step[i] = 0.0
            for j in range(6):
                H[i, j] = information[i, j]
                step[i] -= information[i, j] * off[j]
        for m in range(len(points)):
            if used[m]:
                _residual(camera, R_left, points[m], z[m], T, local, by_local, r, J)
                _whiten(whitener, m, r, J, white, G)
                size = np.sqrt(white[0] * white[0] + white[1] * white[1] + white[2] * white[2])
                weight = 1.0 if size <= huber else huber / size
                for i in range(6):
                    step[i] += weight * (G[0, i] * white[0] + G[1, i] * white[1] + G[2, i] * white[2])
                    for j in range(i + 1):
                        H[i, j] += weight * (G[0, i] * G[0, j] + G[1, i] * G[1, j] + G[2, i] * G[2, j])
        factorise(H, 6)
        solve_factorised(H, 6, step)
        move(T, step)
        largest = 0.0
        for i in range(6):
            off[i] += step[i]  # exact to first order: enough for a prior that only keeps few measurements in bounds
            largest = max(largest, abs(step[i]))
        if largest < enough:
            break
    return T


@helper
def _whiten(whitener, m, r, J, white, G):
    """Residual and derivatives of measurement m times its whitener; components that are missing count for nothing."""
    for i in range(3):
        white[i] = 0.0
        for j in range(6):
            G[i, j] = 0.0
        for k in range(3):
            if not np.isnan(r[k]):
                white[i] += whitener[m, i, k] * r[k]
                for j in range(6):
                    G[i, j] += whitener[m, i, k] * J[k, j]
