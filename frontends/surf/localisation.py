"""Position and size of features in a continuous scale space.

The detector samples positions and sizes coarsely, so that its features wander by half a pixel when the image grows
by a tenth. Here the corners of the filters may lie anywhere (sums are linear between pixel corners), which makes the
response a continuous function of position and size; its maximum is found by Newton's method.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised
from slam.runtime.compilation import disjoint_vector_helper, helper, kernel, vector_helper

_STEP = 1.0 / 15.0  # of the finite differences in position, in units of the size
_SIZE_STEP = 0.3  # of those in size
_ITERATIONS = 10  # numerics: of the search for the continuous maximum at most
_FOLLOWERS = 10  # cost: features that repeated ones may lie apart, when sorted by x
_CONVERGED = 0.05  # numerics: in units of the steps
_LANES = 8  # cost: columns are read in whole vector registers
_WIDEST = 2.6  # cost: bound of the columns that the filters of a feature read, in units of its size

#: Horizontal part of the filters: which of the three vertical parts is read at the ten columns of corners, and weights.
_PART = np.array([0, 2, 1, 0, 2, 2, 0, 1, 2, 0])
_WEIGHT = np.array([-1.0, -1.0, -1.0, 3.0, 1.0, 1.0, -3.0, 1.0, -1.0, 1.0])


@vector_helper
def _sums(p, corners):
    """Vertical part of the filters for Dxx, Dyy and Dxy on whole rows: sums of all that is left of ten corners."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9 = corners
    whole, lobe = np.int32(p[a9] - p[a0]), np.int32(p[a6] - p[a3])
    xy = np.int32(np.int32(p[a4] - p[a1]) - np.int32(p[a8] - p[a5]))
    return np.int32(p[a7] - p[a2]), np.int32(whole - np.int32(3) * lobe), xy


@vector_helper
def _part(p, at, stride, part):
    """Part of a row of the image, summed up to a pixel corner."""
    return part * np.int32(p[at + stride] - p[at])


@disjoint_vector_helper
def _vertical_parts(p, s, a, f, n, out, lanes):
    """Vertical part of the filters for Dxx, Dyy and Dxy, from the lines at the ten rows of corners, on n columns.

    Whole rows count from the first of the columns, so that none of their sums wraps around.
    """
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9 = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9]
    f0, f1, f2, f3, f4, f5, f6, f7, f8, f9 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9]
    first_xx, first_yy, first_xy = _sums(p, (a0, a1, a2, a3, a4, a5, a6, a7, a8, a9))
    for j in range(n):
        k = np.uint64(j)
        xx, yy, xy = _sums(p, (a0 + k, a1 + k, a2 + k, a3 + k, a4 + k, a5 + k, a6 + k, a7 + k, a8 + k, a9 + k))
        whole, lobe = (
            _part(p, a9 + k, s, f9) - _part(p, a0 + k, s, f0),
            _part(p, a6 + k, s, f6) - _part(p, a3 + k, s, f3),
        )
        upper = _part(p, a4 + k, s, f4) - _part(p, a1 + k, s, f1)
        lower = _part(p, a8 + k, s, f8) - _part(p, a5 + k, s, f5)
        out[k] = np.int32(xx - first_xx) + (_part(p, a7 + k, s, f7) - _part(p, a2 + k, s, f2))
        out[lanes + k] = np.int32(yy - first_yy) + (whole - 3.0 * lobe)
        out[lanes + lanes + k] = np.int32(xy - first_xy) + (upper - lower)


@vector_helper
def _response(parts, lanes, x, size):
    """Determinant of the Hessian of the filter with its centre at a column of the vertical parts."""
    dxx, dyy, dxy = 0.0, 0.0, 0.0
    for k in range(10):
        u = x + size * (k / 9.0 - 0.5)
        column = np.int64(u)
        at = np.uint64(_PART[k] * lanes + column)
        value = _WEIGHT[k] * (parts[at] + (u - column) * (parts[at + np.uint64(1)] - parts[at]))
        if _PART[k] == 0:
            dxx += value
        elif _PART[k] == 1:
            dyy += value
        else:
            dxy += value
    area = size * size
    dxx, dyy, dxy = dxx * 5.4 / area, dyy * 5.4 / area, dxy * 9.0 / area
    return dxx * dyy - 0.81 * dxy * dxy


@helper
def _responses(pixels, stride, x, y, size, step, wide, space, out):
    """Responses of a filter at (x, y) and, if `wide`, `step` to its left and right; it must lie inside the image.

    The vertical part of the filters is common to the three.
    """
    corners, fractions, parts = space
    lanes = parts.size // 3
    half = 0.5 * size + (step if wide else 0.0)
    first = np.int64(x + 0.5 - half)
    n = (np.int64(x + 0.5 + half) + 1 + _LANES - first) & -_LANES
    for k in range(10):
        v = y + 0.5 + size * (k / 9.0 - 0.5)
        whole = np.int64(v)
        corners[k], fractions[k] = np.uint64(whole * stride + first), v - whole
    _vertical_parts(pixels, np.uint64(stride), corners, fractions, n, parts, np.uint64(lanes))
    for j in range(0 if wide else 1, 3 if wide else 2):
        out[j] = _response(parts, lanes, x + 0.5 - first + (j - 1) * step, size)


@helper
def _sample(pixels, stride, x, y, size, bend, space, cube):
    """Responses about (x, y, size), as cube[size, y, x]: those of the gradient and, if `bend`, of the curvature."""
    step = _STEP * size
    for layer in range(3):
        for row in range(3):
            sides = (layer == 1) + (row == 1)
            if bend or sides:
                wide = sides == 2 or (bend and sides == 1)
                v, scale = y + (row - 1) * step, size + (layer - 1) * _SIZE_STEP * size
                _responses(pixels, stride, x, v, scale, step, wide, space, cube[layer, row])


@helper
def bends(c, curvature):
    """Minus the Hessian (3, 3) of 3x3x3 responses, as cube[size, y, x], in units of their distances, factorised."""
    v = 2.0 * c[1, 1, 1]
    curvature[0, 0] = v - c[1, 1, 0] - c[1, 1, 2]
    curvature[1, 1] = v - c[1, 0, 1] - c[1, 2, 1]
    curvature[2, 2] = v - c[0, 1, 1] - c[2, 1, 1]
    curvature[1, 0] = 0.25 * (c[1, 0, 2] + c[1, 2, 0] - c[1, 2, 2] - c[1, 0, 0])
    curvature[2, 0] = 0.25 * (c[0, 1, 2] + c[2, 1, 0] - c[2, 1, 2] - c[0, 1, 0])
    curvature[2, 1] = 0.25 * (c[0, 2, 1] + c[2, 0, 1] - c[2, 2, 1] - c[0, 0, 1])
    factorise(curvature, 3)


@helper
def newton_step(c, curvature, step):
    """The way (3,) from the middle of 3x3x3 responses to their extremum, of what `bends` has made of their Hessian."""
    step[0], step[1], step[2] = c[1, 1, 2] - c[1, 1, 0], c[1, 2, 1] - c[1, 0, 1], c[2, 1, 1] - c[0, 1, 1]
    for k in range(3):
        step[k] *= 0.5
    solve_factorised(curvature, 3, step)


@kernel
def localise(integral, uv, size, reach):
    """Maximum of the response next to each feature with pixel (N, 2) and size (N,) [px], continuous in both.

    Returns (N, 4): x, y, size [px] and the response, for the image's own pixel values; NaN where there is no maximum in
    `reach` of the feature, in units of its size, or where the filter would leave the image of the `integral`, see
    `integral_image`.
    """
    out, largest = np.full((len(uv), 4), np.nan), 0.0
    for i in range(len(size)):
        largest = max(largest, size[i])
    lanes = int(_WIDEST * largest) + 2 * _LANES
    space = np.empty(10, np.uint64), np.empty(10), np.empty(3 * lanes)  # corners of a filter, and its vertical parts
    cube, curvature, step = np.empty((3, 3, 3)), np.empty((3, 3)), np.empty(3)
    pixels = integral.reshape(-1)
    rows, stride = integral.shape
    for i in range(len(uv)):
        u, v, s = uv[i, 0], uv[i, 1], size[i]
        for k in range(_ITERATIONS):
            room = (0.5 * (1.0 + _SIZE_STEP) + _STEP) * s + 1.0
            if not (room < u < stride - 2 - room and room < v < rows - 2 - room):
                break
            # The curvature changes little on the way: it is measured twice, at the start and after two steps.
            bend = k == 0 or k == 2
            _sample(pixels, stride, u, v, s, bend, space, cube)
            if bend:
                bends(cube, curvature)
            if not (curvature[0, 0] > 0.0 and curvature[1, 1] > 0.0 and curvature[2, 2] > 0.0):  # no maximum
                break
            newton_step(cube, curvature, step)
            largest = max(abs(step[0]), abs(step[1]), abs(step[2]))
            shrink = 1.0 if largest <= 1.0 else 1.0 / largest
            u += shrink * step[0] * _STEP * s
            v += shrink * step[1] * _STEP * s
            s *= 1.0 + shrink * step[2] * _SIZE_STEP
            if (u - uv[i, 0]) ** 2 + (v - uv[i, 1]) ** 2 > (reach * size[i]) ** 2 or not 0.6 < s / size[i] < 1.7:
                break
            if largest < _CONVERGED:
                out[i, 0], out[i, 1], out[i, 2], out[i, 3] = u, v, s, cube[1, 1, 1]
                break
    return out


@kernel
def first_of_each(order, uv, size):
    """Mark features (N,), strongest first, that no stronger one equals.

    Equal ones lie closer than a twentieth of the size, with sizes within a tenth; `order` is that of their columns.
    """
    keep = np.ones(len(order), np.bool_)
    for i in range(len(order)):
        a = order[i]
        for j in range(i + 1, min(i + 1 + _FOLLOWERS, len(order))):
            b = order[j]
            near = 0.05 * max(size[a], size[b])
            dx, dy = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
            if dx * dx + dy * dy < near * near and abs(size[b] - size[a]) < 2.0 * near:
                keep[max(a, b)] = False
    return keep
