"""Position and size of features in a continuous scale space.

The detector samples positions and sizes coarsely, so that its features wander by half a pixel when the image grows
by a tenth. Here the corners of the filters may lie anywhere (sums are linear between pixel corners), which makes the
response a continuous function of position and size; its maximum is found by Newton's method.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import helper, kernel, vector_helper

_STEP = 1.0 / 15.0  # of the finite differences in position, in units of the size
_SIZE_STEP = 0.3  # of those in size
_ITERATIONS = 10  # numerics: of the search for the continuous maximum at most
_FOLLOWERS = 10  # cost: features that repeated ones may lie apart, when sorted by x
_CONVERGED = 0.05  # numerics: in units of the steps


#: Places of the finite differences (x, y, size): the seven of the gradient, then those of the mixed derivatives.
_PLACES = np.array(
    [
        (0, 0, 0), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1),
        (1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0),
        (1, 0, 1), (1, 0, -1), (-1, 0, 1), (-1, 0, -1),
        (0, 1, 1), (0, 1, -1), (0, -1, 1), (0, -1, -1),
    ],
    np.float64,
)  # fmt: skip


#: The corners' numbers, from an array because Numba compiles a helper again for each literal number it is called with.
_N = np.arange(10)


@vector_helper
def _corner(pixels, stride, y, fy, x, fx):
    """Integral image between pixel corners: a whole part, modulo 2**32, and the rest, exact."""
    k = np.uint64(y * stride + x)
    a = pixels[k]
    right = np.float64(np.int32(pixels[k + np.uint64(1)] - a))
    c = pixels[k + np.uint64(stride)]
    below = np.float64(np.int32(c - a))
    right_below = np.float64(np.int32(pixels[k + np.uint64(stride + 1)] - c))
    return a, fx * right + fy * (below + fx * (right_below - right))


@vector_helper
def _box(pixels, stride, whole, part, top, bottom, left, right):
    """Sum of a box between the numbered corner positions."""
    y0, y1, x0, x1 = whole[1, top], whole[1, bottom], whole[0, left], whole[0, right]
    fy0, fy1, fx0, fx1 = part[1, top], part[1, bottom], part[0, left], part[0, right]
    a, p = _corner(pixels, stride, y0, fy0, x0, fx0)
    b, q = _corner(pixels, stride, y0, fy0, x1, fx1)
    c, r = _corner(pixels, stride, y1, fy1, x0, fx0)
    d, s = _corner(pixels, stride, y1, fy1, x1, fx1)
    return np.float64(np.int32(np.int32(d - c) - np.int32(b - a))) + ((s - r) - (q - p))


@vector_helper
def _response(pixels, stride, x, y, size, whole, part):
    """Determinant of the Hessian at any position and size; the filter must lie inside the image."""
    n, w, f = _N, whole, part
    for k in range(10):
        u, v = x + 0.5 + size * (k / 9.0 - 0.5), y + 0.5 + size * (k / 9.0 - 0.5)
        w[0, k], w[1, k] = np.int64(u), np.int64(v)
        f[0, k], f[1, k] = u - w[0, k], v - w[1, k]
    dxx = _box(pixels, stride, w, f, n[2], n[7], n[0], n[9]) - 3.0 * _box(pixels, stride, w, f, n[2], n[7], n[3], n[6])
    dyy = _box(pixels, stride, w, f, n[0], n[9], n[2], n[7]) - 3.0 * _box(pixels, stride, w, f, n[3], n[6], n[2], n[7])
    dxy = _box(pixels, stride, w, f, n[1], n[4], n[1], n[4]) + _box(pixels, stride, w, f, n[5], n[8], n[5], n[8])
    dxy -= _box(pixels, stride, w, f, n[1], n[4], n[5], n[8]) + _box(pixels, stride, w, f, n[5], n[8], n[1], n[4])
    area = size * size
    dxx, dyy, dxy = dxx * 5.4 / area, dyy * 5.4 / area, dxy * 9.0 / area
    return dxx * dyy - 0.81 * dxy * dxy


@helper
def _responses(pixels, stride, x, y, size, first, last, whole, part, values):
    """Responses at a range of the places of the finite differences."""
    for k in range(first, last):
        u, v = x + _PLACES[k, 0] * _STEP * size, y + _PLACES[k, 1] * _STEP * size
        values[k] = _response(pixels, stride, u, v, size + _PLACES[k, 2] * _SIZE_STEP * size, whole, part)


@helper
def _inverse_curvature(v, inverse):
    """Inverse of the Hessian (3, 3) of the responses, in units of the finite differences; False unless a maximum."""
    xx, yy, ss = v[1] + v[2] - 2.0 * v[0], v[3] + v[4] - 2.0 * v[0], v[5] + v[6] - 2.0 * v[0]
    xy, xs = 0.25 * (v[7] - v[8] - v[9] + v[10]), 0.25 * (v[11] - v[12] - v[13] + v[14])
    ys = 0.25 * (v[15] - v[16] - v[17] + v[18])
    cxx, cxy, cxs = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    det = xx * cxx + xy * cxy + xs * cxs
    if not (xx < 0.0 and xx * yy - xy * xy > 0.0 and det < 0.0):
        return False
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = cxx / det, cxy / det, cxs / det
    inverse[1, 1], inverse[1, 2] = (xx * ss - xs * xs) / det, (xy * xs - xx * ys) / det
    inverse[2, 2] = (xx * yy - xy * xy) / det
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    return True


def localise(
    integral: NDArray[np.int32],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    size: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """Maximum of the response next to each feature, in continuous position and size.

    Args:
        integral: see `integral_image`.
        x: columns of the features (N,) [px].
        y: their rows (N,) [px].
        size: their sizes (N,) [px].
        reach: furthest that a feature may move, in units of its size.

    Returns:
        (N, 4): x, y, size [px] and the response (for the image's own pixel values) of each; NaN where there is no
        maximum in reach, or where the filter would leave the image.
    """
    out = np.full((len(x), 4), np.nan)
    _localise(
        integral.reshape(-1), integral.shape, x, y, size, reach, np.empty((2, 10), np.int64), np.empty((2, 10)),
        np.empty(len(_PLACES)), np.empty((3, 3)), np.empty(3), out,
    )  # fmt: skip
    return out


@kernel
def _localise(pixels, shape, x, y, size, reach, whole, part, values, inverse, step, out):
    """The same into `out`, on the flat integral image and with work space."""
    rows, stride = shape
    for i in range(x.size):
        u, v, s = x[i], y[i], size[i]
        for k in range(_ITERATIONS):
            room = (0.5 * (1.0 + _SIZE_STEP) + _STEP) * s + 1.0
            if not (room < u < stride - 2 - room and room < v < rows - 2 - room):
                break
            # The curvature changes little on the way: it is measured twice, at the start and after two steps.
            bend = k == 0 or k == 2
            _responses(pixels, stride, u, v, s, 0, len(_PLACES) if bend else 7, whole, part, values)
            if bend and not _inverse_curvature(values, inverse):
                break
            largest = 0.0
            for a in range(3):
                step[a] = 0.0
                for b in range(3):
                    step[a] -= inverse[a, b] * 0.5 * (values[2 * b + 2] - values[2 * b + 1])
                largest = max(largest, abs(step[a]))
            shrink = 1.0 if largest <= 1.0 else 1.0 / largest
            u += shrink * step[0] * _STEP * s
            v += shrink * step[1] * _STEP * s
            s *= 1.0 + shrink * step[2] * _SIZE_STEP
            if (u - x[i]) ** 2 + (v - y[i]) ** 2 > (reach * size[i]) ** 2 or not 0.6 < s / size[i] < 1.7:
                break
            if largest < _CONVERGED:
                out[i, 0], out[i, 1], out[i, 2], out[i, 3] = u, v, s, values[0]
                break


def first_of_each(x: NDArray, y: NDArray, size: NDArray) -> NDArray[np.bool_]:
    """Mark features (N,) that no earlier one equals: closer than a twentieth of the size, size within a tenth.

    Features are compared with those that follow them closely by x, where their equals are.
    """
    keep = np.ones(len(x), bool)
    order = np.argsort(x, kind="stable")
    for lag in range(1, min(_FOLLOWERS, len(x) - 1) + 1):
        i, j = order[:-lag], order[lag:]
        near = 0.05 * np.maximum(size[i], size[j])
        same = np.hypot(x[i] - x[j], y[i] - y[j]) < near
        same &= np.abs(size[i] - size[j]) < 2.0 * near
        keep[np.maximum(i, j)[same]] = False
    return keep
