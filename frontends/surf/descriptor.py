"""SURF descriptors of 64 dimensions, and paper A's of 16, from the integral image.

A square of 20 s (s = 1.2 size / 9) is averaged into 21x21 cells; differences of neighbouring cells are Haar wavelet
responses of side 2 s. Their sums ``(Σdx, Σdy, Σ|dx|, Σ|dy|)``, weighted by a Gaussian, over 4x4 sub-areas make the
regular descriptor. The 16-D one (paper A, III.B) takes the central 2x2 sub-areas and samples their square alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import kernel, vector_helper

#: How much wider boxes are than cells, in cells: such match better; turned cells gain more by it.
TURNED_EXCESS, UPRIGHT_EXCESS = 0.6, 0.3

_SIGMA = 3.3  # paper: of the Gaussian weight, in cells
_SUB = 5  # paper: wavelets along a sub-area's side
_LANES = 8  # cost: rows of working arrays are padded to whole vector registers


def gaussian_weights(areas: int) -> NDArray[np.float32]:
    """Weights (5 areas, 5 areas) of the wavelets in the central `areas` x `areas` sub-areas, rows padded with zeros."""
    n = _SUB * areas
    line = np.exp(-((np.arange(n) - 0.5 * (n - 1)) ** 2) / (2 * _SIGMA**2))
    weights = np.zeros((n, -(-n // _LANES) * _LANES), np.float32)
    weights[:, :n] = np.outer(line, line)
    return weights


@vector_helper
def _place_boxes(px, py, cosine, sine, extent, least, last_x, last_y, stride, place, weight):
    """Boxes of a row of turned cells in the flat integral image: corners, widths and heights; one over their areas."""
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
def _average_cells(pixels, shape, x, y, width, angle, extent, space):
    """Cell means of a turned square: boxes `extent` [px] wide about the cell centres, each edge rounded by itself."""
    place, weight, cells, _ = space
    n = cells.shape[0]
    cosine, sine = np.float32(width * np.cos(angle)), np.float32(width * np.sin(angle))
    least = np.int32(extent)  # rounding makes boxes this wide, or a pixel wider
    stride = np.int32(shape[1])
    last_x, last_y = np.float32(shape[1] - 2 - least), np.float32(shape[0] - 2 - least)
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
def _sum_areas(space, weights, descriptors, row):
    """Wavelet sums of the sub-areas, scaled to a unit vector; zero where the square has no texture."""
    cells, sums = space[2:]
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
            k = 4 * (areas * p + q)
            descriptors[row, k], descriptors[row, k + 1] = sx, sy
            descriptors[row, k + 2], descriptors[row, k + 3] = tx, ty
    if total > 0:
        scale = np.float32(1.0) / np.sqrt(total)
        for k in range(descriptors.shape[1]):
            descriptors[row, k] *= scale


@kernel
def describe(integral, uv, size, angle, excess, weights):
    """Descriptors (N, 16 or 64) float32 of features with pixels (N, 2), sizes (N,) [px], angles (N,) [rad], y down.

    `integral` is of `integral_image`, `excess` how much wider than cells the boxes are that are averaged, in cells
    (`TURNED_EXCESS` or `UPRIGHT_EXCESS`), `weights` are `gaussian_weights`. An angle that is NaN counts as 0.
    """
    rows, lanes = weights.shape
    out = np.zeros((len(uv), 4 * (rows // _SUB) ** 2), np.float32)
    space = (  # boxes, cells, and sums of sub-areas
        np.zeros((3, lanes), np.int32), np.zeros(lanes, np.float32), np.zeros((rows + 1, lanes + _LANES), np.float32),
        np.zeros((4, lanes), np.float32),
    )  # fmt: skip
    pixels = integral.reshape(-1)
    for k in range(len(uv)):
        width, turn = size[k] * (1.2 / 9.0), (0.0 if np.isnan(angle[k]) else angle[k])
        _average_cells(pixels, integral.shape, uv[k, 0], uv[k, 1], width, turn, (1.0 + excess) * width, space)
        _sum_areas(space, weights, out, k)
    return out
