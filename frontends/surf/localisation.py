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

#: Where the filters' ten corners are on each axis, in units of the size from the centre, and padding.
_CORNERS = np.concatenate([np.arange(10) / 9.0 - 0.5, np.zeros(6)]).astype(np.float32)
#: Horizontal part of the filters: which of the three vertical parts is read at the ten columns of corners, and weights.
_PART = np.array([0, 2, 1, 0, 2, 2, 0, 1, 2, 0])
_WEIGHT = np.array([-1.0, -1.0, -1.0, 3.0, 1.0, 1.0, -3.0, 1.0, -1.0, 1.0], np.float32)


@vector_helper
def _place(centre, size, whole, rest, to):
    """Pixels of a filter's corners along one axis, and the fractions beyond them."""
    for k in range(_CORNERS.size):
        v, j = centre + size * _CORNERS[k], np.uint64(to + k)
        whole[j] = np.int32(v)
        rest[j] = v - np.float32(whole[j])


@vector_helper
def _beyond(p, at, stride, first):
    """Sum of a row of the image up to a pixel corner, without that up to the first of the columns."""
    return np.float32(np.int32(np.int32(p[at + stride] - p[at]) - first))


@disjoint_vector_helper
def _between_two(p, stride, a, b, f, g, n, out, to):
    """Vertical part of a filter on n columns: sums from a line, at a and a fraction f of a row, to another."""
    rows = np.int32(p[b] - p[a])
    above, below = np.int32(p[a + stride] - p[a]), np.int32(p[b + stride] - p[b])
    for j in range(n):
        k = np.uint64(j)
        between = np.float32(np.int32(np.int32(p[b + k] - p[a + k]) - rows))
        out[to + k] = between + (g * _beyond(p, b + k, stride, below) - f * _beyond(p, a + k, stride, above))


@disjoint_vector_helper
def _between_four(p, stride, a, b, c, d, f, g, h, i, weight, n, out, to):
    """The same: sums from the first line to the fourth, less those from the second to the third by their weight."""
    outer, inner = np.int32(p[d] - p[a]), np.int32(p[c] - p[b])
    first, second = np.int32(p[a + stride] - p[a]), np.int32(p[b + stride] - p[b])
    third, fourth = np.int32(p[c + stride] - p[c]), np.int32(p[d + stride] - p[d])
    for j in range(n):
        k = np.uint64(j)
        whole = np.float32(np.int32(np.int32(p[d + k] - p[a + k]) - outer))
        lobe = np.float32(np.int32(np.int32(p[c + k] - p[b + k]) - inner))
        whole += i * _beyond(p, d + k, stride, fourth) - f * _beyond(p, a + k, stride, first)
        lobe += h * _beyond(p, c + k, stride, third) - g * _beyond(p, b + k, stride, second)
        out[to + k] = whole - weight * lobe


@vector_helper
def _response(parts, lanes, whole, rest, to, size):
    """Determinant of the Hessian of the filter with its corners at columns of the vertical parts."""
    dxx, dyy, dxy = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(10):
        j = np.uint64(to + k)
        at = np.uint64(_PART[k] * lanes + whole[j])
        value = _WEIGHT[k] * (parts[at] + rest[j] * (parts[at + np.uint64(1)] - parts[at]))
        if _PART[k] == 0:
            dxx += value
        elif _PART[k] == 1:
            dyy += value
        else:
            dxy += value
    scale = 1.0 / (size * size)
    xx, yy, xy = dxx * (5.4 * scale), dyy * (5.4 * scale), dxy * (9.0 * scale)
    return xx * yy - 0.81 * xy * xy


@helper
def _responses(pixels, stride, x, y, size, step, wide, space, out):
    """Responses of a filter at (x, y) and, if `wide`, `step` to its left and right; it must lie inside the image.

    The vertical part of the filters is common to the three. Sums count from the first of the columns: none wraps
    around, and float32 holds them.
    """
    whole, rest, parts = space
    lanes, s, most = parts.size // 3, np.uint64(stride), _CORNERS.size
    half, reach = 0.5 * size, (step if wide else 0.0)
    left, top = np.int64(x + 0.5 - half - reach), np.int64(y + 0.5 - half)
    narrow = np.float32(size)
    _place(np.float32(y + 0.5 - top), narrow, whole, rest, 0)
    for j in range(0 if wide else 1, 3 if wide else 2):
        _place(np.float32(x + 0.5 - left + (j - 1) * step), narrow, whole, rest, (j + 1) * most)
    first, last = (most if wide else 2 * most), (3 * most if wide else 2 * most)
    at = top * stride + left
    # Dxx
    n = (whole[last + 9] + 1 + _LANES) & -_LANES
    a, b = np.uint64(at + whole[2] * stride), np.uint64(at + whole[7] * stride)
    _between_two(pixels, s, a, b, rest[2], rest[7], n, parts, np.uint64(0))
    # Dyy
    skip = np.int64(whole[first + 2])
    n = (whole[last + 7] - skip + 1 + _LANES) & -_LANES
    a, b = np.uint64(at + skip + whole[0] * stride), np.uint64(at + skip + whole[3] * stride)
    c, d = np.uint64(at + skip + whole[6] * stride), np.uint64(at + skip + whole[9] * stride)
    _between_four(
        pixels, s, a, b, c, d, rest[0], rest[3], rest[6], rest[9], np.float32(3.0), n, parts, np.uint64(lanes + skip)
    )
    # Dxy
    skip = np.int64(whole[first + 1])
    n = (whole[last + 8] - skip + 1 + _LANES) & -_LANES
    a, b = np.uint64(at + skip + whole[1] * stride), np.uint64(at + skip + whole[5] * stride)
    c, d = np.uint64(at + skip + whole[8] * stride), np.uint64(at + skip + whole[4] * stride)
    _between_four(
        pixels, s, a, b, c, d, rest[1], rest[5], rest[8], rest[4], np.float32(1.0), n, parts,
        np.uint64(2 * lanes + skip),
    )  # fmt: skip
    for j in range(0 if wide else 1, 3 if wide else 2):
        out[j] = _response(parts, lanes, whole, rest, (j + 1) * most, size)


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
    corners = 4 * _CORNERS.size  # of a filter: rows, and columns of three places
    space = np.empty(corners, np.int32), np.empty(corners, np.float32), np.empty(3 * lanes, np.float32)
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
