"""Compiled loops of `slam.calibration.model`. Columns are its parameters: `LENS` twice, then `POSE`."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel


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


@kernel
def field(points, focal, out):
    """`slam.calibration.model.RigModel.field` without the rotation: into `out` (N, 3, n), at points (N, 3) [px]."""
    for p in range(len(points)):
        x, y, d = points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal
        right = x - d
        for column in range(out.shape[2]):
            out[p, 0, column] = out[p, 1, column] = out[p, 2, column] = 0.0
        for side in range(2):
            u, first = right if side else x, 8 * side
            r2, sign = u * u + y * y, -focal if side else focal
            r4, both = r2 * r2, 2 * u * y
            if side == 0:
                out[p, 1, 1], out[p, 1, 2], out[p, 1, 3] = focal, y * focal, y * focal
                out[p, 1, 4], out[p, 1, 5] = y * r2 * focal, y * r4 * focal
                out[p, 1, 6], out[p, 1, 7] = (r2 + 2 * y * y) * focal, both * focal
                out[p, 0, 0], out[p, 0, 2] = focal, x * focal
                out[p, 0, 4], out[p, 0, 5] = x * r2 * focal, x * r4 * focal
                out[p, 0, 6], out[p, 0, 7] = both * focal, (r2 + 2 * x * x) * focal
            out[p, 2, first], out[p, 2, first + 2] = sign, u * sign
            out[p, 2, first + 4], out[p, 2, first + 5] = u * r2 * sign, u * r4 * sign
            out[p, 2, first + 6], out[p, 2, first + 7] = both * sign, (r2 + 2 * u * u) * sign
        out[p, 2, 16], out[p, 2, 17] = right * y * focal, (-1 - right * right) * focal
        out[p, 2, 18], out[p, 2, 20] = y * focal, d * right * focal


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
