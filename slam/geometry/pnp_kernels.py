"""Compiled loops of `slam.geometry.pnp`."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised
from slam.kernels.se3 import compose, exp, transform
from slam.kernels.stereo import offsets, residual
from slam.runtime.compilation import helper, kernel


@kernel
def gauss_newton_steps(local, error, J_point):
    """Steps (H, 6) that reduce reprojection errors, perturbing poses on the left of T_left_world.

    Lightly damped, so that a degenerate set yields a bad pose and no error.

    Args:
        local: points in camera coordinates (H, K, 3), a set for each pose.
        error: measured less predicted (H, K, 3); entries that are not finite are left out.
        J_point: derivatives (H, K, 3, 3) of the predictions by the points.
    """
    steps = np.zeros((len(local), 6))
    normal = np.empty((6, 6))
    for h in range(len(local)):
        normal[:] = 0.0
        for k in range(local.shape[1]):
            for i in range(3):
                _add_row(local[h, k], J_point[h, k, i], error[h, k, i], normal, steps[h])
        _damp_and_solve(normal, steps[h])
    return steps


@kernel
def refine_rectified(cameras, points, measured, rows, poses, most, converged):
    """Least-squares poses on reprojection errors in a rectified rig, in place, by `gauss_newton_steps`.

    Args:
        cameras: `slam.geometry.rig.StereoRig.rectified_parameters` (7,).
        points: in world coordinates (M, 3).
        measured: (M, 3) = (uL, vL, uR); entries that are not finite are left out.
        rows: which of them say each pose (H, K).
        poses: T_left_world (H, 4, 4).
        most: number of steps at most.
        converged: step [rad], [m] after which a pose is good.
    """
    normal, step, local = np.empty((6, 6)), np.empty(6), np.empty(3)
    unturned, error, J, change = np.eye(3), np.empty(3), np.empty((3, 3)), np.empty((3, 4))
    for h in range(len(poses)):
        for _ in range(most):
            step[:], normal[:] = 0.0, 0.0
            for k in range(rows.shape[1]):
                m = rows[h, k]
                transform(poses[h], points[m], local)
                if residual(cameras, unturned, local, measured[m], error, J):
                    for i in range(3):
                        _add_row(local, J[i], error[i], normal, step)
            _damp_and_solve(normal, step)
            exp(step, change)
            compose(change, poses[h].copy(), poses[h])
            largest = 0.0
            for i in range(6):
                largest = max(largest, abs(step[i]))
            if largest < converged:
                break


@kernel
def errors_rectified(cameras, points, measured, poses):
    """Largest error of uL, vL, uR (H, M) [px] of matches under poses in a rectified rig; NaN behind the camera.

    Args:
        cameras: `slam.geometry.rig.StereoRig.rectified_parameters` (7,).
        points: in world coordinates (M, 3).
        measured: (M, 3) = (uL, vL, uR); uR is NaN where there is none, and does not count.
        poses: T_left_world (H, 4, 4).
    """
    errors, local = np.empty((len(poses), len(points))), np.empty(3)
    for h in range(len(poses)):
        for m in range(len(points)):
            transform(poses[h], points[m], local)
            left, row, right, _ = offsets(cameras, local[0], local[1], local[2])
            error, down = abs(measured[m, 0] - (left + cameras[2])), abs(measured[m, 1] - (row + cameras[3]))
            right = abs(measured[m, 2] - (right + cameras[5]))
            if down > error or np.isnan(down):
                error = down
            errors[h, m] = right if right > error else error
    return errors


@helper
def _add_row(local, J, error, normal, right):
    """Take one number into the normal equations (lower triangle), unless it is missing; J (3,) is by the point."""
    if not np.isfinite(error):
        return
    (x, y, z), (a, b, c) = local, J
    g = (y * c - z * b, z * a - x * c, x * b - y * a, a, b, c)  # local × the derivative
    for m in range(6):
        right[m] += g[m] * error
        for n in range(m + 1):
            normal[m, n] += g[m] * g[n]


@helper
def _damp_and_solve(normal, right):
    """The step, into `right`, of normal equations whose lower triangle is given."""
    damping = 1e-12
    for m in range(6):
        damping += 1e-9 * normal[m, m]
    for m in range(6):
        normal[m, m] += damping
    factorise(normal, 6)
    solve_factorised(normal, 6, right)
