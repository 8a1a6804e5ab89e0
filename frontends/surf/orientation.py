"""Dominant orientation of features by Haar wavelets on the integral image (paper A, III; Bay et al.)."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel, vector_helper

RADIUS = 6  # paper: of the sampled disc, in units of the feature's scale s
_SIGMA = 2.5  # paper: of the Gaussian weight, in the same units
_BINS = 144  # fixed: two for each five degrees: the degree 5k alone, and the four after it
_WINDOW = 23  # fixed: bins in 60 degrees, the ends left out


_LINE, _DEGREES = np.arange(-RADIUS, RADIUS + 1), np.arange(361) % 360
_PLACES = np.argwhere(_LINE[:, None] ** 2 + _LINE[None] ** 2 <= RADIUS**2).astype(np.uint64)  # samples: column, row
_WEIGHT = np.exp(-(_LINE**2) / (2 * _SIGMA**2))
_WEIGHTS = (_WEIGHT / _WEIGHT.sum())[_PLACES.astype(int)].prod(axis=1).astype(np.float32)  # of the samples (113,)
#: Bin of each degree, counted from the first window's first one.
_BIN = ((2 * (_DEGREES // 5) + (_DEGREES % 5 > 0) + _WINDOW // 2) % _BINS).astype(np.uint64)


@vector_helper
def _degrees(x, y, out, n):
    """Angles of vectors in whole degrees 0..360; a minimax polynomial for the arc tangent, good to 0.001 degrees."""
    for i in range(n):
        ax, ay = abs(x[i]), abs(y[i])
        small, large = min(ax, ay), max(ax, ay)
        t = small / (large + np.float32(1e-30))
        q = t * t
        a = np.float32(1.19433817)
        a = a * q - np.float32(4.87910180)
        a = a * q + np.float32(10.3223687)
        a = a * q - np.float32(18.9250705)
        a = (a * q + np.float32(57.2881208)) * t
        a = np.float32(90.0) - a if ay > ax else a
        a = np.float32(180.0) - a if x[i] < 0 else a
        a = np.float32(360.0) - a if y[i] < 0 else a
        out[i] = np.int32(np.rint(a))


@helper
def _sample_gradients(pixels, rows, stride, x, y, s, space):
    """Weighted Haar wavelet responses (x right, y UP) of the samples inside the image; returns how many there are."""
    lefts, tops, gx, gy = space[:4]
    half = int(np.rint(2.0 * s))
    side = 2 * half
    for k in range(-RADIUS, RADIUS + 1):
        left, top = int(np.rint(x - 0.5 * (side - 1) + k * s)), int(np.rint(y - 0.5 * (side - 1) + k * s))
        lefts[k + RADIUS] = left if 0 <= left < stride - side else -pixels.size
        tops[k + RADIUS] = top * stride if 0 <= top < rows - side else -pixels.size
    h, e = np.uint64(half), np.uint64(side)
    centre, bottom = np.uint64(half * stride), np.uint64(side * stride)
    n = np.uint64(0)
    for k in range(_WEIGHTS.size):
        first = lefts[_PLACES[k, 0]] + tops[_PLACES[k, 1]]
        if first < 0:
            continue
        a = np.uint64(first)
        g = a + bottom
        square = np.int32(np.int32(pixels[g + e] - pixels[g]) - np.int32(pixels[a + e] - pixels[a]))
        left_half = np.int32(np.int32(pixels[g + h] - pixels[g]) - np.int32(pixels[a + h] - pixels[a]))
        m = a + centre
        upper_half = np.int32(np.int32(pixels[m + e] - pixels[m]) - np.int32(pixels[a + e] - pixels[a]))
        weight = _WEIGHTS[k]
        gx[n] = np.float32(np.int32(square - 2 * left_half)) * weight
        gy[n] = np.float32(np.int32(2 * upper_half - square)) * weight
        n += np.uint64(1)
    return np.int64(n)


@helper
def _strongest_window(space, n):
    """Direction [rad] of the largest sum of gradients within a window of 60°, moved in steps of 5°; first one wins.

    A window is the difference of two running sums over bins, which go on beyond the full circle by its width.
    """
    gx, gy, degrees, sums = space[2:]
    for k in range(sums.shape[1]):  # a slice would take longer to compile
        sums[0, k] = sums[1, k] = 0.0
    for i in range(n):
        k = _BIN[degrees[i]] + np.uint64(1)
        sums[0, k] += gx[i]
        sums[1, k] += gy[i]
    for k in range(_WINDOW):
        sums[0, _BINS + 1 + k], sums[1, _BINS + 1 + k] = sums[0, 1 + k], sums[1, 1 + k]
    sx, sy = 0.0, 0.0
    for k in range(sums.shape[1]):
        sx, sy = sx + sums[0, k], sy + sums[1, k]
        sums[0, k], sums[1, k] = sx, sy
    best, bx, by = 0.0, 0.0, 0.0
    for k in range(0, _BINS, 2):
        sx, sy = sums[0, k + _WINDOW] - sums[0, k], sums[1, k + _WINDOW] - sums[1, k]
        if sx * sx + sy * sy > best:
            best, bx, by = sx * sx + sy * sy, sx, sy
    angle = np.arctan2(-by, bx)
    return angle if angle >= 0 else angle + 2 * np.pi


@kernel
def orientations(integral, uv, size):
    """Angles (N,) [rad], y down, in 0..2π, of features with pixels (N, 2) and sizes (N,) [px].

    They are NaN where no wavelet fits into the image; `integral` is of `integral_image`.
    """
    out, n = np.full(len(uv), np.nan), len(_WEIGHTS)
    space = (  # columns and rows of the samples, gradients, their angles, and sums
        np.empty(2 * RADIUS + 1, np.int64), np.empty(2 * RADIUS + 1, np.int64), np.empty(n, np.float32),
        np.empty(n, np.float32), np.empty(n, np.int32), np.empty((2, _BINS + _WINDOW + 1)),
    )  # fmt: skip
    pixels, rows, columns = integral.reshape(-1), integral.shape[0], integral.shape[1]
    for i in range(len(uv)):
        count = _sample_gradients(pixels, rows, columns, uv[i, 0], uv[i, 1], size[i] * (1.2 / 9.0), space)
        _degrees(space[2], space[3], space[4], count)
        if count > 0:
            out[i] = _strongest_window(space, count)
    return out
