"""SURF descriptors of 64 dimensions, and paper A's of 16, from the integral image.

A square of 20 s (s = 1.2 size / 9) is averaged into 21x21 cells; differences of neighbouring cells are Haar wavelet
responses of side 2 s. Their sums ``(Σdx, Σdy, Σ|dx|, Σ|dy|)``, weighted by a Gaussian, over 4x4 sub-areas make the
regular descriptor. The 16-D one (paper A, III.B) takes the central 2x2 sub-areas and samples their square alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frontends.surf.kernels import helper, kernel, vector_helper

_SIGMA = 3.3  # of the Gaussian weight, in cells
_SUB = 5  # wavelets along a sub-area's side
_BOX = 1.6  # side of the boxes of turned squares, in cells
_LANES = 8  # rows of working arrays are padded to whole vector registers


def gaussian_weights(areas: int) -> NDArray[np.float32]:
    """Weights (5 areas, 5 areas) of the wavelets in the central `areas` x `areas` sub-areas, rows padded with zeros."""
    n = _SUB * areas
    line = np.exp(-((np.arange(n) - 0.5 * (n - 1)) ** 2) / (2 * _SIGMA**2))
    weights = np.zeros((n, -(-n // _LANES) * _LANES), np.float32)
    weights[:, :n] = np.outer(line, line)
    return weights


@helper
def _edges(axis, start, width, count, last, at, fraction):
    """Whole and fractional parts of the positions ``start + k width``, whole parts kept in 0..last."""
    for k in range(count):
        position = start + k * width
        whole = min(max(int(np.floor(position)), 0), last)
        at[axis, k] = whole
        fraction[axis, k] = position - whole


@helper
def _gather(integral, n, at, rows, gathered):
    """Collect the integral image at all columns ``at[0]`` (and one further right) of the rows that edges lie between.

    ``gathered[r]`` is the r-th of those rows; ``rows[k]`` is the one above edge k, the next is the one below it.
    """
    last, count = -1, 0
    for k in range(n + 1):
        i = int(at[1, k])
        for row in range(max(i, last + 1), i + 2):
            for m in range(n + 1):
                j = at[0, m]
                gathered[count, 0, m] = integral[row, j]
                gathered[count, 1, m] = integral[row, np.uint32(j + np.uint32(1))]
            count += 1
        last = i + 1
        rows[k] = count - 2
    return count


@vector_helper
def _strips(gathered, count, fraction, strips):
    """Sums between neighbouring sub-pixel columns of the pixels above each gathered row, from the first one on.

    Linear between pixel corners and, as fractions may lie outside 0..1 there, beyond the image's edge: the edge
    pixels are continued.
    """
    for r in range(count):
        for k in range(strips.shape[1]):
            here, there = (
                np.int32(gathered[r, 0, k] - gathered[0, 0, k]),
                np.int32(gathered[r, 0, k + 1] - gathered[0, 0, k + 1]),
            )
            left = np.int32(np.int32(gathered[r, 1, k] - gathered[0, 1, k]) - here)
            right = np.int32(np.int32(gathered[r, 1, k + 1] - gathered[0, 1, k + 1]) - there)
            whole = np.float32(np.int32(there - here))
            strips[r, k] = whole + fraction[0, k + 1] * np.float32(right) - fraction[0, k] * np.float32(left)


@vector_helper
def _upright_cells(integral, x, y, width, n, at, fraction, rows, gathered, strips, cells):
    """Cell sums of an upright square about (x, y), exact with sub-pixel edges; rows of cells run along y."""
    for axis in range(2):
        centre, last = (x, integral.shape[1] - 2) if axis == 0 else (y, integral.shape[0] - 2)
        _edges(axis, centre + 0.5 - 0.5 * n * width, width, n + 1, last, at, fraction)
    count = _gather(integral, n, at, rows, gathered)
    _strips(gathered, count, fraction, strips)
    for k in range(n):
        a, b, f, g = rows[k], rows[k + 1], fraction[1, k], fraction[1, k + 1]
        for m in range(strips.shape[1]):
            upper = strips[a, m] + f * (strips[a + 1, m] - strips[a, m])
            cells[k, m] = strips[b, m] + g * (strips[b + 1, m] - strips[b, m]) - upper


@vector_helper
def _place_boxes(px, py, cosine, sine, extent, least, last_x, last_y, stride, place, weight):
    """Where the boxes of a row of turned cells lie in the flat integral image, from (px, py) on.

    ``place`` (3, lanes) takes top left corners, widths, and heights in rows of the image; ``weight`` one over areas.
    """
    zero, narrow, wide = np.float32(0.0), np.float32(1.0) / np.float32(least), np.float32(1.0) / np.float32(least + 1)
    for j in range(weight.size):
        left = min(max(px + np.float32(j) * cosine, zero), last_x)
        top = min(max(py + np.float32(j) * sine, zero), last_y)
        x0, y0 = np.int32(left), np.int32(top)
        x1, y1 = np.int32(left + extent), np.int32(top + extent)
        width, height = np.int32(x1 - x0), np.int32(y1 - y0)
        place[0, j] = np.int32(np.int32(y0 * stride) + x0)
        place[1, j] = width
        place[2, j] = np.int32(height * stride)
        weight[j] = (narrow if width == least else wide) * (narrow if height == least else wide)


@vector_helper
def _turned_cells(integral, x, y, width, angle, n, place, weight, cells):
    """Cell means of a turned square about (x, y): axis-aligned boxes of whole pixels about the turned cell centres.

    Boxes are wider than cells, which makes descriptors steadier; each edge is rounded by itself. Boxes that would
    leave the image are pushed back to its edge.
    """
    cosine, sine = np.float32(width * np.cos(angle)), np.float32(width * np.sin(angle))
    extent = _BOX * width
    least = np.int32(extent)  # rounding makes boxes this wide, or a pixel wider
    pixels, stride = integral.reshape(-1), np.int32(integral.shape[1])
    last_x, last_y = np.float32(integral.shape[1] - 2 - least), np.float32(integral.shape[0] - 2 - least)
    x0, y0 = x + 1.0 - 0.5 * extent, y + 1.0 - 0.5 * extent
    for i in range(n):
        u, v = -0.5 * (n - 1), i - 0.5 * (n - 1)
        px, py = np.float32(x0 + u * cosine - v * sine), np.float32(y0 + u * sine + v * cosine)
        _place_boxes(px, py, cosine, sine, np.float32(extent), least, last_x, last_y, stride, place, weight)
        for j in range(n):
            a = np.uint64(place[0, j])
            b, right = a + np.uint64(place[2, j]), np.uint64(place[1, j])
            upper, lower = np.int32(pixels[a + right] - pixels[a]), np.int32(pixels[b + right] - pixels[b])
            cells[i, j] = np.float32(np.int32(lower - upper)) * weight[j]


@vector_helper
def _sum_areas(cells, weights, upright, sums, descriptors, row):
    """Wavelet sums of the sub-areas, scaled to a unit vector; zero where the square has no texture.

    Upright cells are in image axes; OpenCV's layout for them is that of the square turned by 270 degrees.
    """
    areas = weights.shape[0] // 5
    total = np.float32(0.0)
    for p in range(areas):
        for j in range(weights.shape[1]):
            sx, sy, tx, ty = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(5):
                i = 5 * p + k
                falling, rising = cells[i + 1, j + 1] - cells[i, j], cells[i, j + 1] - cells[i + 1, j]
                dx, dy = (falling + rising) * weights[i, j], (falling - rising) * weights[i, j]
                sx, sy, tx, ty = sx + dx, sy + dy, tx + abs(dx), ty + abs(dy)
            sums[0, j], sums[1, j], sums[2, j], sums[3, j] = sx, sy, tx, ty
        for q in range(areas):
            sx, sy, tx, ty = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for j in range(5 * q, 5 * q + 5):
                sx, sy, tx, ty = sx + sums[0, j], sy + sums[1, j], tx + sums[2, j], ty + sums[3, j]
            total += sx * sx + sy * sy + tx * tx + ty * ty
            k = 4 * (areas * q + areas - 1 - p) if upright else 4 * (areas * p + q)
            descriptors[row, k], descriptors[row, k + 1] = (-sy, sx) if upright else (sx, sy)
            descriptors[row, k + 2], descriptors[row, k + 3] = (ty, tx) if upright else (tx, ty)
    if total > 0:
        scale = np.float32(1.0) / np.sqrt(total)
        for k in range(descriptors.shape[1]):
            descriptors[row, k] *= scale


def describe(
    integral: NDArray[np.int32],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    size: NDArray[np.float64],
    angle: NDArray[np.float64] | None,
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Descriptors (N, 16 or 64) of features.

    Args:
        integral: see `integral_image`.
        x: columns of the features (N,) [px].
        y: their rows (N,) [px].
        size: their sizes (N,) [px].
        angle: of the features [rad], y down; None takes squares along the image axes.
        weights: see `gaussian_weights`.
    """
    out = np.zeros((len(x), 4 * (len(weights) // _SUB) ** 2), np.float32)
    if angle is None:
        _describe_upright(integral, x, y, size, weights, out)
    else:
        _describe_turned(integral, x, y, size, angle, weights, out)
    return out


@kernel
def _describe_upright(integral, x, y, size, weights, out):
    """Descriptors of upright squares into `out`."""
    n, lanes = weights.shape[0] + 1, weights.shape[1]
    cells, sums = np.zeros((n, lanes + 8), np.float32), np.empty((4, lanes), np.float32)
    at, fraction = np.zeros((2, lanes + 8), np.uint32), np.zeros((2, lanes + 8), np.float32)
    rows, gathered = np.zeros(n + 1, np.int64), np.zeros((2 * n + 2, 2, lanes + 8), np.int32)
    strips = np.zeros((2 * n + 2, lanes), np.float32)
    for k in range(x.size):
        width = size[k] * (1.2 / 9.0)
        _upright_cells(integral, x[k], y[k], width, n, at, fraction, rows, gathered, strips, cells)
        _sum_areas(cells, weights, True, sums, out, k)


@kernel
def _describe_turned(integral, x, y, size, angle, weights, out):
    """Descriptors of turned squares into `out`."""
    n, lanes = weights.shape[0] + 1, weights.shape[1]
    cells, sums = np.zeros((n, lanes + 8), np.float32), np.empty((4, lanes), np.float32)
    place, weight = np.empty((3, lanes), np.int32), np.empty(lanes, np.float32)
    for k in range(x.size):
        _turned_cells(integral, x[k], y[k], size[k] * (1.2 / 9.0), angle[k], n, place, weight, cells)
        _sum_areas(cells, weights, False, sums, out, k)
