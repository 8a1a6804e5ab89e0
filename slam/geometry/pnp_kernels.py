"""Compiled loops of `slam.geometry.pnp`."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel

_SMALL_SQUARE = 1e-4  # numerics: of an angle [rad²], below which series are exact to double precision


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
    fu, fv, u0, v0, right_fu, right_u0, shift = cameras
    normal, step, local = np.empty((6, 6)), np.empty(6), np.empty(3)
    for h in range(len(poses)):
        for _ in range(most):
            for i in range(6):  # slices take seconds to compile
                step[i] = 0.0
                for j in range(6):
                    normal[i, j] = 0.0
            for k in range(rows.shape[1]):
                m = rows[h, k]
                _transform(poses[h], points[m], local)
                if not local[2] > 1e-9:
                    continue
                inverse = 1.0 / local[2]
                x, y, right_x = local[0] * inverse, local[1] * inverse, (local[0] + shift) * inverse
                for i in range(3):
                    f, ray, centre = fu, x, u0
                    if i == 1:
                        f, ray, centre = fv, y, v0
                    elif i == 2:
                        f, ray, centre = right_fu, right_x, right_u0
                    error = measured[m, i] - (f * ray + centre)
                    if np.isfinite(error):
                        across, down = (0.0, f * inverse) if i == 1 else (f * inverse, 0.0)
                        _add_row(local, across, down, -f * ray * inverse, error, normal, step)
            _damp_and_solve(normal, step)
            _move(step, poses[h])
            if np.abs(step).max() < converged:
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
    fu, fv, u0, v0, right_fu, right_u0, shift = cameras
    errors, local = np.empty((len(poses), len(points))), np.empty(3)
    for h in range(len(poses)):
        for m in range(len(points)):
            _transform(poses[h], points[m], local)
            inverse = 1.0 / local[2] if local[2] > 1e-9 else np.nan
            error = abs(measured[m, 0] - (fu * local[0] * inverse + u0))
            down = abs(measured[m, 1] - (fv * local[1] * inverse + v0))
            right = abs(measured[m, 2] - (right_fu * (local[0] + shift) * inverse + right_u0))
            if down > error or np.isnan(down):
                error = down
            errors[h, m] = right if right > error else error
    return errors


@helper
def _transform(T, point, out):
    for i in range(3):
        out[i] = T[i, 0] * point[0] + T[i, 1] * point[1] + T[i, 2] * point[2] + T[i, 3]


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
    _solve(normal, right)


@helper
def _move(step, T):
    """``exp(step) T`` into T: see `slam.geometry.se3.exp`."""
    x, y, z = step[0], step[1], step[2]
    square = x * x + y * y + z * z
    if square < _SMALL_SQUARE:
        a = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
        b = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56))
        c = 1 / 6 - square / 120 * (1 - square / 42 * (1 - square / 72))
    else:
        angle = np.sqrt(square)
        a = np.sin(angle) / angle
        b = 2 * np.sin(0.5 * angle) ** 2 / square
        c = (1 - a) / square
    W, turn, before = np.zeros((3, 3)), np.empty((3, 3)), T.copy()
    W[0, 1], W[0, 2], W[1, 2] = -z, y, -x
    W[1, 0], W[2, 0], W[2, 1] = z, -y, x
    for i in range(3):
        T[i, 3] += step[3 + i]
        for j in range(3):
            twice = step[i] * step[j] - (square if i == j else 0.0)  # of W W
            turn[i, j] = a * W[i, j] + b * twice  # less the unit matrix
            T[i, 3] += (b * W[i, j] + c * twice) * step[3 + j]
    for i in range(3):
        for j in range(4):
            for k in range(3):
                T[i, j] += turn[i, k] * before[k, j]


@helper
def _solve(M, v):
    """``M⁻¹ v`` into v (6,) by M = L D Lᵀ, which overwrites the lower triangle of M (6, 6)."""
    for i in range(6):
        for j in range(i + 1):
            for h in range(j):
                M[i, j] -= M[i, h] * M[j, h] * M[h, h]
            if j < i:
                M[i, j] /= M[j, j]
                v[i] -= M[i, j] * v[j]
    for i in range(5, -1, -1):
        v[i] /= M[i, i]
        for h in range(i + 1, 6):
            v[i] -= M[h, i] * v[h]
