"""Compiled loops of `slam.pose_solver`."""

from __future__ import annotations

import numpy as np

from slam.compilation import helper, kernel


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
    normal, g = np.empty((6, 6)), np.empty(6)
    for h in range(len(local)):
        normal[:] = 0.0
        for k in range(local.shape[1]):
            x, y, z = local[h, k, 0], local[h, k, 1], local[h, k, 2]
            for i in range(3):
                error = residual[h, k, i]
                if not np.isfinite(error):
                    continue
                a, b, c = J_point[h, k, i, 0], J_point[h, k, i, 1], J_point[h, k, i, 2]
                g[0], g[1], g[2] = y * c - z * b, z * a - x * c, x * b - y * a  # local × the row of J_point
                g[3], g[4], g[5] = a, b, c
                for m in range(6):
                    steps[h, m] += g[m] * error
                    for n in range(m + 1):
                        normal[m, n] += g[m] * g[n]
        damping = 1e-12
        for m in range(6):
            damping += 1e-9 * normal[m, m]
        for m in range(6):
            normal[m, m] += damping
        _solve(normal, steps[h])
    return steps


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
