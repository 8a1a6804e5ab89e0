"""Compiled loops of `slam.calibration.model`. Columns are its parameters: `LENS` twice, then `POSE`."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel


@kernel
def polynomials(x, y, centre, half, beyond, scales, first, second, out):
    """Products of Legendre polynomials of degrees `first` in x and `second` in y (K,), into `out` (K, N).

    Points x, y (N,) and the image's centre and half size (2,) are in focal lengths. The polynomial of each degree is
    multiplied by its scale, and held constant so many half sizes `beyond` the centre.
    """
    P = np.ones((2, len(scales)))
    for n in range(len(x)):
        for axis in range(2):
            v = ((y[n] if axis else x[n]) - centre[axis]) / half[axis]
            v = min(max(v, -beyond), beyond)
            P[axis, 1] = v
            for i in range(2, len(scales)):
                P[axis, i] = (P[axis, i - 1] * v * (2 * i - 1) - P[axis, i - 2] * (i - 1)) / i
        for k in range(len(first)):
            i, j = first[k], second[k]
            out[k, n] = (P[0, i] * scales[i]) * (P[1, j] * scales[j])


@helper
def _field_at(x, y, d, focal, out):
    """Change [px] of a point ``(x, y, d)`` [focal lengths] by the parameters and a turn of the rig: `out` (3, n + 3).

    What is zero for all points is not written.
    """
    right = x - d
    for side in range(2):
        u, first = right if side else x, 8 * side
        r2, sign = u * u + y * y, -focal if side else focal
        r4, both = r2 * r2, 2 * u * y
        if side == 0:
            out[1, 1], out[1, 2], out[1, 3] = focal, y * focal, y * focal
            out[1, 4], out[1, 5] = y * r2 * focal, y * r4 * focal
            out[1, 6], out[1, 7] = (r2 + 2 * y * y) * focal, both * focal
            out[0, 0], out[0, 2] = focal, x * focal
            out[0, 4], out[0, 5] = x * r2 * focal, x * r4 * focal
            out[0, 6], out[0, 7] = both * focal, (r2 + 2 * x * x) * focal
        out[2, first], out[2, first + 2] = sign, u * sign
        out[2, first + 4], out[2, first + 5] = u * r2 * sign, u * r4 * sign
        out[2, first + 6], out[2, first + 7] = both * sign, (r2 + 2 * u * u) * sign
    out[2, 16], out[2, 17] = right * y * focal, (-1 - right * right) * focal
    out[2, 18], out[2, 20] = y * focal, d * right * focal
    out[0, 21], out[0, 22], out[0, 23] = -x * y * focal, (1 + x * x) * focal, -y * focal
    out[1, 21], out[1, 22], out[1, 23] = (-1 - y * y) * focal, x * y * focal, x * focal
    out[2, 21], out[2, 22] = -d * y * focal, d * x * focal


@kernel
def field(points, focal):
    """Change (N, 3, n + 3) [px] of points (N, 3) [px], see `slam.calibration.model.RigModel.field`."""
    out = np.zeros((len(points), 3, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, out[p])
    return out


@kernel
def shift(points, focal, parameters):
    """`field` times parameters and turn (n + 3,): (N, 3)."""
    out, rows = np.empty((len(points), 3)), np.zeros((3, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, rows)
        for i in range(3):
            out[p, i] = 0.0
            for column in range(24):
                out[p, i] += rows[i, column] * parameters[column]
    return out


@kernel
def vertical(points, focal, out):
    """`slam.calibration.model.RigModel.vertical`: into `out` (N, n), at points (N, 3) [px]."""
    for p in range(len(points)):
        x, y, d = points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal
        right = x - d
        for side in range(2):
            u, first, sign = right if side else x, 8 * side, focal if side else -focal
            r2 = u * u + y * y
            out[p, first] = 0.0
            out[p, first + 1], out[p, first + 2], out[p, first + 3] = sign, y * sign, y * sign
            out[p, first + 4], out[p, first + 5] = y * r2 * sign, y * (r2 * r2) * sign
            out[p, first + 6], out[p, first + 7] = (r2 + 2 * y * y) * sign, 2 * u * y * sign
        out[p, 16], out[p, 17], out[p, 18] = (-1 - y * y) * focal, right * y * focal, right * focal
        out[p, 19], out[p, 20] = d * focal, -d * y * focal
