"""The fast Hessian detector (paper A, III.A): responses, non-maximum suppression and refinement in one pass.

Responses of a few rows live in a small rotating buffer; the first and the last layer of an octave, which only rival the
maxima of the others, are computed where such a maximum needs them. Box filters are on OpenCV's conventions.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from frontends.surf.localisation import bends, newton_step
from slam.runtime.compilation import helper, kernel, vector_helper


class Filters(NamedTuple):
    """The filters of one octave, a row per layer (L); the first and the last layer are searched for no maxima."""

    step: int  # distance of the octave's samples [px]
    sizes: NDArray[np.int64]  # of the filters (L,) [px]
    centre: NDArray[np.int64]  # grid steps from a filter's first pixel to its nominal centre (L,)
    corners: NDArray[np.uint64]  # of the boxes along each axis (L, 10) [px], k/9 of the size, rounded half to even
    weights: NDArray[np.float32]  # of DxxDyy and Dxy² (L, 2): box sums divided by their areas, pixels on 0..255
    offsets: NDArray[np.uint64]  # of the 32 box corners in the flat integral image, from the top left (L, 32)
    parts: NDArray[np.bool_]  # which column phases of the three vertical parts a layer reads (L, step, 3)
    columns: NDArray[np.uint64]  # ten columns (L, 10) read in the buffer (3, step, n) of these: see `_read_columns`


@lru_cache(maxsize=64)
def make_filters(octave: int, layers: int, scale: float, stride: int) -> Filters:
    """Filters of the `layers` of an octave (0-based) that are searched for maxima.

    `scale` brings pixel values to 0..255; places are those in an integral image of width `stride`.
    """
    sizes = layer_sizes(octave, layers)
    corners = np.rint(sizes[:, None] * np.arange(10) / 9.0).astype(np.int64)
    area = (corners[:, 3] - corners[:, 0]) * (corners[:, 7] - corners[:, 2])
    area_xy = (corners[:, 4] - corners[:, 1]) ** 2
    weights = np.stack([(scale / area) ** 2, 0.81 * (scale / area_xy) ** 2], axis=1).astype(np.float32)
    step = 1 << octave
    parts, columns = _read_columns(corners, step, -(-stride // step))
    top, bottom, left, right = (corners[:, [box[k] for box in BOXES]] for k in range(4))
    ends = [top * stride + left, top * stride + right, bottom * stride + left, bottom * stride + right]
    offsets = np.ascontiguousarray(np.stack(ends, axis=2).reshape(len(corners), -1)).astype(np.uint64)
    return Filters(step, sizes, sizes // 2 // step, corners.astype(np.uint64), weights, offsets, parts, columns)


def layer_sizes(octave: int, layers: int) -> NDArray[np.int64]:
    """Filter sizes [px] of one octave (0-based): the layers searched for maxima and one more on either side."""
    return np.array([(9 + 6 * layer) << octave for layer in range(layers + 2)], dtype=np.int64)


#: Boxes (top, bottom, left, right) by their numbered corners: Dxx whole and middle lobe, Dyy likewise, Dxy's four.
BOXES = (
    (2, 7, 0, 9), (2, 7, 3, 6), (0, 9, 2, 7), (3, 6, 2, 7),
    (1, 4, 1, 4), (5, 8, 5, 8), (1, 4, 5, 8), (5, 8, 1, 4),
)  # fmt: skip


def _read_columns(corners: NDArray[np.int64], step: int, n: int) -> tuple[NDArray[np.bool_], NDArray[np.uint64]]:
    """`Filters.parts` and `Filters.columns`: corners 0, 3, 6, 9 of Dxx, 2, 7 of Dyy, 1, 4, 5, 8 of Dxy."""
    part = np.array([0, 0, 0, 0, 1, 1, 2, 2, 2, 2])
    read = corners[:, [0, 3, 6, 9, 2, 7, 1, 4, 5, 8]]
    parts = np.zeros((len(corners), step, 3), np.bool_)
    parts[np.arange(len(corners))[:, None], read % step, part] = True
    return parts, ((part * step + read % step) * n + read // step).astype(np.uint64)


#: fixed: Columns of a candidate row: centre x, y [px], size [px], response, sign of the Laplacian, octave.
COLUMNS = 6

#: What the sum of each box, see `filters.BOXES`, counts in Dxx, Dyy and Dxy.
_SHARES = np.array([(1, -3, 0, 0, 0, 0, 0, 0), (0, 0, 1, -3, 0, 0, 0, 0), (0, 0, 0, 0, 1, 1, -1, -1)])
#: The nine places of a layer above or below, those first that most often rival a peak.
_CENTRE_FIRST = np.array([4, 1, 3, 5, 7, 0, 2, 6, 8])


@helper
def _response_at(pixels, at, offsets, weights, layer):
    """The determinant ``Dxx Dyy − 0.81 Dxy²`` and the sign of ``Dxx + Dyy`` of the filter with its top left at `at`."""
    dxx, dyy, dxy = 0, 0, 0
    for box in range(_SHARES.shape[1]):
        n = 4 * box
        a, b = pixels[at + offsets[layer, n]], pixels[at + offsets[layer, n + 1]]
        c, d = pixels[at + offsets[layer, n + 2]], pixels[at + offsets[layer, n + 3]]
        s = np.int32(np.int32(d - c) - np.int32(b - a))
        dxx, dyy, dxy = dxx + _SHARES[0, box] * s, dyy + _SHARES[1, box] * s, dxy + _SHARES[2, box] * s
    xx, yy, xy = np.float32(dxx), np.float32(dyy), np.float32(dxy)
    return xx * yy * weights[layer, 0] - xy * xy * weights[layer, 1], np.sign(dxx + dyy)


@vector_helper
def _vertical_parts(s, at, stride, c, need, n, out, to, between):
    """Vertical part of the filters for Dxx, Dyy and Dxy whose top row begins at `at`, n columns each, where needed."""
    if need[0]:
        a, b = at + c[2] * stride, at + c[7] * stride
        for x in range(n):
            k = np.uint64(x)
            out[to + k] = np.int32(s[b + k] - s[a + k])
    if need[1]:
        a, b, d, e = at, at + c[3] * stride, at + c[6] * stride, at + c[9] * stride
        for x in range(n):
            k = np.uint64(x)
            lobe = np.int32(s[d + k] - s[b + k])
            out[to + between + k] = np.int32(np.int32(s[e + k] - s[a + k]) - np.int32(3) * lobe)
    if need[2]:
        a, b, d, e = at + c[1] * stride, at + c[4] * stride, at + c[5] * stride, at + c[8] * stride
        for x in range(n):
            k = np.uint64(x)
            out[to + between + between + k] = np.int32(np.int32(s[b + k] - s[a + k]) - np.int32(s[e + k] - s[d + k]))


@vector_helper
def _determinants(m, c, weight, weight_xy, n, out, to):
    """Horizontal part of the filters and the determinants ``Dxx Dyy − 0.81 Dxy²`` of a row."""
    a0, a3, a6, a9, b2, b7, c1, c4, c5, c8 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9]
    for x in range(n):
        j = np.uint64(x)
        dxx = np.float32(np.int32(np.int32(m[a9 + j] - m[a0 + j]) - np.int32(3) * np.int32(m[a6 + j] - m[a3 + j])))
        dyy = np.float32(np.int32(m[b7 + j] - m[b2 + j]))
        dxy = np.float32(np.int32(np.int32(m[c4 + j] - m[c1 + j]) - np.int32(m[c8 + j] - m[c5 + j])))
        out[to + j] = dxx * dyy * weight - dxy * dxy * weight_xy


@helper
def _response_row(phases, shape, filters, layer, y0, buffer, count, out, to):
    """`count` determinants of one row of one layer, filters' top row `y0`, into the flat array `out` from `to` on."""
    step, rows, n = shape
    c = filters.corners[layer]
    for p in range(step):
        at = np.uint64((p * rows + y0) * n)
        need = filters.parts[layer, p]
        _vertical_parts(phases, at, np.uint64(n), c, need, n, buffer, np.uint64(p * n), np.uint64(step * n))
    _determinants(buffer, filters.columns[layer], filters.weights[layer, 0], filters.weights[layer, 1], count, out, to)


@vector_helper
def _mark_peaks(above, before, row, after, below, rival, threshold, mask):
    """Mark the columns that exceed the threshold, their four neighbours in the layer, and the one in another layer."""
    for j in range(mask.size):
        v = row[j]
        peak = (v > before[j]) & (v > after[j]) & (v > above[j]) & (v > below[j])
        mask[j] = (v > threshold) & (v > rival[j]) & peak


@helper
def _neighbourhood(space, j, pixels, stride, filters, layer, row):
    """Fill the 3x3x3 responses around a peak of a layer; False as soon as one of them is not below it."""
    _, ring, _, _, _, slots, cube, _, _ = space
    step = filters.step
    inner = ring.shape[0]
    v = ring[layer - 1, slots[1], j]
    for dl in range(-1, 2):
        if 1 <= layer + dl <= inner:
            for di in range(3):
                for dj in range(3):
                    r = ring[layer + dl - 1, slots[di], j + dj - 1]
                    if r >= v and (dl != 0 or di != 1 or dj != 1):
                        return False
                    cube[dl + 1, di, dj] = r
    for dl in range(-1, 2, 2):
        if not 1 <= layer + dl <= inner:
            centre = filters.centre[layer + dl]
            for k in _CENTRE_FIRST:
                di, dj = k // 3, k % 3
                at = step * (row - centre + di - 1) * stride + step * (j - centre + dj - 1)
                r, _ = _response_at(pixels, np.uint64(at), filters.offsets, filters.weights, layer + dl)
                if r >= v:
                    return False
                cube[dl + 1, di, dj] = r
    return True


@helper
def _collect(space, pixels, stride, filters, layer, row, out, found):
    """Candidates among the marked columns of a row, appended to `out`; returns how many `out` holds then."""
    _, _, _, words, mask, _, cube, curvature, offset = space
    step, size = filters.step, filters.sizes[layer]
    ds = size - filters.sizes[layer - 1]
    centre = filters.centre[layer]
    for word in range(words.size):
        if words[word] == 0:
            continue
        for j in range(8 * word, 8 * word + 8):
            if mask[j] == 0 or not _neighbourhood(space, j, pixels, stride, filters, layer, row):
                continue
            bends(cube, curvature)
            newton_step(cube, curvature, offset)
            x, y, up = offset[0], offset[1], offset[2]
            if not (abs(x) <= 1.0 and abs(y) <= 1.0 and abs(up) <= 1.0) or (x == 0.0 and y == 0.0 and up == 0.0):
                continue
            x0, y0 = step * (j - centre), step * (row - centre)
            out[found, 0] = x0 + 0.5 * (size - 1) + step * x
            out[found, 1] = y0 + 0.5 * (size - 1) + step * y
            out[found, 2] = np.rint(size + up * ds)
            out[found, 3] = cube[1, 1, 1]
            at = np.uint64(y0 * stride + x0)
            _, out[found, 4] = _response_at(pixels, at, filters.offsets, filters.weights, layer)
            found += 1
    return found


@helper
def _column_phases(pixels, stride, shape, first, last, out):
    """Columns of a flat integral image by their remainder, ``out[p, y, j] = integral[y, step * j + p]``, of some rows.

    A filter that moves in steps of `step` then reads neighbouring memory. `out`, flat too, is of shape (step, rows, n).
    """
    step, rows, n = shape
    for p in range(step):
        for y in range(first, last):
            for j in range((stride - p + step - 1) // step):
                out[np.uint64((p * rows + y) * n + j)] = pixels[np.uint64(y * stride + step * j + p)]


@kernel
def detect_octave(integral, filters, octave, threshold, first_row, last_row):
    """Candidates (N, COLUMNS) above a threshold in an octave, from a grid row to before another, in raster order."""
    step, height, width, stride = filters.step, integral.shape[0] - 1, integral.shape[1] - 1, integral.shape[1]
    rows, columns, inner = height // step, width // step, len(filters.sizes) - 2
    pixels = phases = integral.reshape(-1)
    shape = step, height + 1, -(-stride // step)
    if step > 1:
        phases = np.empty(shape[0] * shape[1] * shape[2], np.int32)
        reach = filters.centre[inner] + 1  # rows above and below that inner layers read
        first, last = max(first_row - reach, 0) * step, min((last_row + reach + 1) * step, height + 1)
        _column_phases(pixels, stride, shape, first, last, phases)
    ring = np.zeros((inner, 3, columns + 1), np.float32)  # three rows of each layer; row i lies in slot i % 3
    words = np.zeros((columns + 7) // 8, np.uint64)
    buffer, responses, mask = np.empty(3 * step * shape[2], np.int32), ring.reshape(-1), words.view(np.uint8)
    slots = np.empty(3, np.int64)
    space = buffer, ring, responses, words, mask, slots, np.empty((3, 3, 3)), np.empty((3, 3)), np.empty(3)
    # At most one strict maximum in each 2x2 block of a layer.
    out = np.empty((max(16, (last_row - first_row + 2) * (columns + 1) // 4 * inner), COLUMNS))
    found = np.int64(0)
    for i in range(max(0, first_row - 1), min(rows, last_row + 1)):
        for layer in range(1, inner + 1):
            size, start = filters.sizes[layer], filters.centre[layer]
            if start <= i <= start + (height - size) // step:
                to = np.uint64((3 * (layer - 1) + i % 3) * ring.shape[2] + start)
                count = 1 + (width - size) // step
                y0 = step * (i - start)
                _response_row(phases, shape, filters, layer, y0, buffer, count, responses, to)
        row = i - 1
        slots[0], slots[1], slots[2] = (row - 1) % 3, row % 3, i % 3
        for layer in range(1, inner + 1):
            margin = filters.centre[layer + 1] + 1
            if row < first_row or not margin <= row < rows - margin:
                continue
            a, b = margin, columns - margin
            here, rival = ring[layer - 1, slots[1]], ring[layer if layer < inner else layer - 2, slots[1], a:b]
            for j in range(a):  # a slice would take longer to compile
                mask[j] = 0
            for j in range(b, mask.size):
                mask[j] = 0
            _mark_peaks(
                ring[layer - 1, slots[0], a:b], here[a - 1 :], here[a:b], here[a + 1 :], ring[layer - 1, slots[2], a:b],
                rival, threshold, mask[a:b],
            )  # fmt: skip
            found = _collect(space, pixels, stride, filters, layer, row, out, found)
    for k in range(found):  # a slice would take longer to compile
        out[k, 5] = octave
    return out[:found].copy()
