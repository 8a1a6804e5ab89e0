"""Compiled loops of `slam.calibration.model`. Columns are its parameters, `LENS` twice and `POSE`, and a turn."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel


@kernel
def polynomials(at, beyond, first, second, scales):
    """Products (K, N) of Legendre polynomials of degrees `first` in x and `second` in y (K,), times `scales` (K,).

    Points `at` (2, N) are in half sizes from the image's centre; farther than `beyond` the polynomials are constant.
    """
    out, P = np.empty((len(first), at.shape[1])), np.ones((2, max(np.max(first), np.max(second)) + 1))
    for p in range(at.shape[1]):
        for axis in range(2):
            P[axis, 1] = v = min(max(at[axis, p], -beyond), beyond)
            for i in range(2, P.shape[1]):
                P[axis, i] = (P[axis, i - 1] * v * (2 * i - 1) - P[axis, i - 2] * (i - 1)) / i
        for k in range(len(first)):
            out[k, p] = scales[k] * P[0, first[k]] * P[1, second[k]]
    return out


@helper
def _field_at(x, y, d, focal, out):
    """Change [px] of a point ``(x, y, d)`` and of its vertical disparity [focal lengths]: `out` (4, n + 3)."""
    right = x - d
    for side in range(2):
        u, sign = (right, -focal) if side else (x, focal)
        r2, both = u * u + y * y, 2 * u * y
        along = 1.0, 0.0, u, 0.0, u * r2, u * r2 * r2, both, r2 + 2 * u * u
        across = 0.0, 1.0, y, y, y * r2, y * r2 * r2, r2 + 2 * y * y, both
        for i in range(8):
            out[2, 8 * side + i], out[3, 8 * side + i] = sign * along[i], -sign * across[i]
            if side == 0:
                out[0, i], out[1, i] = focal * along[i], focal * across[i]
    d_by_pose = right * y, -1 - right * right, y, 0.0, d * right
    vertical_by_pose = -1 - y * y, right * y, right, d, -d * y
    for i in range(5):
        out[2, 16 + i], out[3, 16 + i] = focal * d_by_pose[i], focal * vertical_by_pose[i]
    turn = (-x * y, 1 + x * x, -y), (-1 - y * y, x * y, x), (-d * y, d * x, 0.0)
    for i in range(3):
        for j in range(3):
            out[i, 21 + j] = focal * turn[i][j]


@kernel
def field(points, focal):
    """Change (N, 4, n + 3) [px] of points ``(x, y, d)`` (N, 3) [px] and of their vertical disparities."""
    out = np.zeros((len(points), 4, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, out[p])
    return out


@kernel
def shift(points, focal, parameters):
    """`field` times parameters and turn (n + 3,): (N, 4)."""
    out, rows = np.zeros((len(points), 4)), np.zeros((4, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, rows)
        for i in range(4):
            for column in range(24):
                out[p, i] += rows[i, column] * parameters[column]
    return out
