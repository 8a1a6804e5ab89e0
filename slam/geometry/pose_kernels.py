"""Compiled loops over one pose and known points: residuals, and Gauss-Newton on them.

Arrays that all take: `camera` (7,), of the rectified rig, see `slam.kernels.stereo`; `R_left` (3, 3), from left-camera
to rectified axes; `points` (M, 3) in world coordinates; `z` (M, 3) = (uL, vL, uR), NaN where missing.
"""

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
    """Measured less predicted (M, 3), NaN where missing or behind, and the prediction's Jacobians (M, 3, 6) by T."""
    r, J = np.empty((len(points), 3)), np.empty((len(points), 3, 6))
    local, by_local = np.empty(3), np.empty((3, 3))
    for m in range(len(points)):
        _residual(camera, R_left, points[m], z[m], T, local, by_local, r[m], J[m])
    return r, J


@kernel
def errors(camera, R_left, points, z, poses):
    """Largest error of uL, vL, uR (H, M) [px] under each pose (H, 4, 4); NaN behind the camera."""
    out, local, r, J = np.empty((len(poses), len(points))), np.empty(3), np.empty(3), np.empty((3, 3))
    for h in range(len(poses)):
        for m in range(len(points)):
            transform_back(poses[h], points[m], local)
            residual(camera, R_left, local, z[m], r, J)
            largest = abs(r[0])
            for i in range(1, 3):
                if abs(r[i]) > largest or (i == 1 and np.isnan(r[i])):
                    largest = abs(r[i])
            out[h, m] = largest
    return out


@helper
def _residual(camera, R_left, point, z, T, local, by_local, r, J):
    """Measured less predicted r (3,) and derivatives J (3, 6) of the prediction by T; zero where it is behind."""
    transform_back(T, point, local)
    residual(camera, R_left, local, z, r, by_local)
    for i in range(3):
        by_pose(by_local[i], local, J[i])


@kernel
def gauss_newton(camera, R_left, points, z, whitener, rows, information, prior, poses, huber, steps, enough):
    """Poses (H, 4, 4), in place, by at most `steps` steps of Gauss-Newton.

    Lightly damped, so that a degenerate set yields a bad pose and no error.

    `whitener` is of the residuals (M, 3, 3), or one for all (1, 3, 3); `rows` (H, K) are the measurements that count
    for each pose; `information` (6, 6) and the start beside the mean, `prior` (6,), are of the prior. A whitened
    residual beyond `huber` pulls no more than one there; a step smaller than `enough` [rad, m] is the last.
    """
    off, r, J, white, G = np.empty(6), np.empty(3), np.empty((3, 6)), np.empty(3), np.empty((3, 6))
    local, by_local = np.empty(3), np.empty((3, 3))
    H, step = np.empty((6, 6)), np.empty(6)
    for h in range(len(poses)):
        for i in range(6):  # a slice would take longer to compile
            off[i] = prior[i]
        for _ in range(steps):
            for i in range(6):
                step[i] = 0.0
                for j in range(6):
                    H[i, j] = information[i, j]
                    step[i] -= information[i, j] * off[j]
            for k in range(rows.shape[1]):
                m = rows[h, k]
                _residual(camera, R_left, points[m], z[m], poses[h], local, by_local, r, J)
                _whiten(whitener[m if len(whitener) > 1 else 0], r, J, white, G)
                size = np.sqrt(white[0] * white[0] + white[1] * white[1] + white[2] * white[2])
                weight = 1.0 if size <= huber else huber / size
                for i in range(6):
                    step[i] += weight * (G[0, i] * white[0] + G[1, i] * white[1] + G[2, i] * white[2])
                    for j in range(i + 1):
                        H[i, j] += weight * (G[0, i] * G[0, j] + G[1, i] * G[1, j] + G[2, i] * G[2, j])
            for i in range(6):
                H[i, i] += 1e-12 + 1e-9 * H[i, i]
            factorise(H, 6)
            solve_factorised(H, 6, step)
            move(poses[h], step)
            largest = 0.0
            for i in range(6):
                off[i] += step[i]  # exact to first order: enough for a prior that only keeps few rows in bounds
                largest = max(largest, abs(step[i]))
            if largest < enough:
                break


@helper
def _whiten(W, r, J, white, G):
    """Residual and derivatives of a measurement times its whitener; components that are missing count for nothing."""
    for i in range(3):
        white[i] = 0.0
        for j in range(6):
            G[i, j] = 0.0
        for k in range(3):
            if not np.isnan(r[k]):
                white[i] += W[i, k] * r[k]
                for j in range(6):
                    G[i, j] += W[i, k] * J[k, j]
