"""Dominant orientation of features by Haar wavelets on the integral image (paper A, III; Bay et al.)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.kernels import helper, kernel, vector_helper

RADIUS = 6  # of the sampled disc, in units of the feature's scale s
_SIGMA = 2.5  # of the Gaussian weight, in the same units


def _disc() -> NDArray[np.float32]:
    """Samples of the disc (113, 3): numbers of their column and row, from 0, and their Gaussian weights."""
    weight = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * _SIGMA**2))
    weight /= weight.sum()
    span = range(-RADIUS, RADIUS + 1)
    inside = [(x, y) for x in span for y in span if x * x + y * y <= RADIUS**2]
    rows = [(x + RADIUS, y + RADIUS, weight[x + RADIUS] * weight[y + RADIUS]) for x, y in inside]
    return np.array(rows, np.float32)


DISC = _disc()


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
def _sample_gradients(pixels, rows, stride, x, y, s, disc, lefts, tops, gx, gy):
    """Weighted Haar wavelet responses (x right, y UP) of the samples inside the image; returns how many there are."""
    half = int(np.rint(2.0 * s))
    side = 2 * half
    for k in range(-RADIUS, RADIUS + 1):
        left, top = int(np.rint(x - 0.5 * (side - 1) + k * s)), int(np.rint(y - 0.5 * (side - 1) + k * s))
        lefts[k + RADIUS] = left if 0 <= left < stride - side else -1
        tops[k + RADIUS] = top * stride if 0 <= top < rows - side else -1
    h, e = np.uint64(half), np.uint64(side)
    centre, bottom = np.uint64(half * stride), np.uint64(side * stride)
    n = 0
    for k in range(disc.shape[0]):
        left, top = lefts[int(disc[k, 0])], tops[int(disc[k, 1])]
        if left < 0 or top < 0:
            continue
        a = np.uint64(top + left)
        g = a + bottom
        square = np.int32(np.int32(pixels[g + e] - pixels[g]) - np.int32(pixels[a + e] - pixels[a]))
        left_half = np.int32(np.int32(pixels[g + h] - pixels[g]) - np.int32(pixels[a + h] - pixels[a]))
        m = a + centre
        upper_half = np.int32(np.int32(pixels[m + e] - pixels[m]) - np.int32(pixels[a + e] - pixels[a]))
        weight = disc[k, 2]
        gx[n] = np.float32(np.int32(square - 2 * left_half)) * weight
        gy[n] = np.float32(np.int32(2 * upper_half - square)) * weight
        n += 1
    return n


@helper
def _strongest_window(gx, gy, degrees, n, sums):
    """Direction [rad] of the largest sum of gradients within a window of 60°, moved in steps of 5°; first one wins.

    A window holds the whole degrees less than 30 from its centre. Gradients are summed by fives of degrees first:
    bin 2k holds the degree 5k alone, bin 2k+1 the four degrees after it; a window is then 23 neighbouring bins, the
    difference of two running sums. Bins run on beyond 360 degrees by a window's width.
    """
    sums[:] = 0.0
    for i in range(n):
        d = degrees[i] if degrees[i] < 360 else degrees[i] - 360
        fifth = d // 5
        k = 2 * fifth + (1 if d > 5 * fifth else 0) + 1
        sums[k, 0] += gx[i]
        sums[k, 1] += gy[i]
    for k in range(1, 145):
        sums[k, 0] += sums[k - 1, 0]
        sums[k, 1] += sums[k - 1, 1]
    best, bx, by = 0.0, 0.0, 0.0
    for centre in range(0, 144, 2):
        first, after = centre - 11, centre + 12
        sx, sy = 0.0, 0.0
        if first < 0:
            sx, sy = sums[144, 0] - sums[first + 144, 0], sums[144, 1] - sums[first + 144, 1]
            first = 0
        elif after > 144:
            sx, sy = sums[after - 144, 0], sums[after - 144, 1]
            after = 144
        sx += sums[after, 0] - sums[first, 0]
        sy += sums[after, 1] - sums[first, 1]
        if sx * sx + sy * sy > best:
            best, bx, by = sx * sx + sy * sy, sx, sy
    angle = np.arctan2(-by, bx)
    return angle if angle >= 0 else angle + 2 * np.pi


@kernel
def orientations(integral, x, y, size, disc):
    """Angles (N,) [rad], y down, in 0..2π, of features; NaN where no wavelet fits into the image."""
    n = x.size
    out = np.empty(n)
    gx, gy = np.empty(disc.shape[0], np.float32), np.empty(disc.shape[0], np.float32)
    degrees = np.empty(disc.shape[0], np.int32)
    sums = np.empty((145, 2))
    lefts, tops = np.empty(2 * RADIUS + 1, np.int64), np.empty(2 * RADIUS + 1, np.int64)
    pixels, (rows, stride) = integral.reshape(-1), integral.shape
    for i in range(n):
        count = _sample_gradients(pixels, rows, stride, x[i], y[i], size[i] * (1.2 / 9.0), disc, lefts, tops, gx, gy)
        _degrees(gx, gy, degrees, count)
        out[i] = _strongest_window(gx, gy, degrees, count, sums) if count else np.nan
    return out
