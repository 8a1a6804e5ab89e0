"""Compiled loops of `slam.geometry.pnp`."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised
from slam.kernels.se3 import compose, exp, transform
from slam.kernels.stereo import offsets
from slam.runtime.compilation import helper, kernel


@kernel
def gauss_newton_steps(local, residual, J_point):
    """Steps (H, 6) that reduce reprojection errors, perturbing poses on the left of T_left_world.

    Lightly damped, so that a degenerate set yields a bad pose and no error.

    Args:
        local: points in camera coordinates (H, K, 3), a set for each pose.
        residual: measured less predicted (H, K, 3); entries that are not finite are left out.
        J_point: derivatives (H, K, 3, 3) of the predictions by the points.
    """
    steps = np.zeros((len(local), 6))
    normal = np.empty((6, 6))
    for h in range(len(local)):
        normal[:] = 0.0
        for k in range(local.shape[1]):
            for i in range(3):
                if np.isfinite(residual[h, k, i]):
                    J = J_point[h, k, i]
                    _add_row(local[h, k], J[0], J[1], J[2], residual[h, k, i], normal, steps[h])
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
    change, before = np.empty((3, 4)), np.empty((4, 4))
    for h in range(len(poses)):
        for _ in range(most):
            for i in range(6):  # slices take seconds to compile
                step[i] = 0.0
                for j in range(6):
                    normal[i, j] = 0.0
            for k in range(rows.shape[1]):
                m = rows[h, k]
                transform(poses[h], points[m], local)
                offset = offsets(cameras, local[0], local[1], local[2])
                inverse = offset[3]
                if np.isnan(inverse):
                    continue
                for i in range(3):
                    f, centre = (cameras[0], cameras[2]) if i == 0 else (cameras[1], cameras[3])
                    if i == 2:
                        f, centre = cameras[4], cameras[5]
                    error = measured[m, i] - (offset[i] + centre)
                    if np.isfinite(error):
                        across, down = (0.0, f * inverse) if i == 1 else (f * inverse, 0.0)
                        _add_row(local, across, down, -offset[i] * inverse, error, normal, step)
            _damp_and_solve(normal, step)
            exp(step, change)
            for i in range(4):
                for j in range(4):
                    before[i, j] = poses[h, i, j]
            compose(change, before, poses[h])
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
def _add_row(local, a, b, c, error, normal, right):
    """Take one number into the normal equations (lower triangle); (a, b, c) is its derivative by the point."""
    x, y, z = local[0], local[1], local[2]
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
