"""Search along epipolar lines of rectified images by normalised correlation, at half resolution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import helper, kernel, vector_helper

_HALF = 4  # fixed: half width of the compared patches [half-resolution px]; the kernel's inner loop is written for it
_SIDE = 2 * _HALF + 1
_FLAT = 2.0  # least standard deviation of a patch [grey levels of 8-bit images]
_LANES = 16  # cost: columns are searched in whole vector registers, in which a row of a patch is kept too
_CONTENDER = 0.7  # cost: a column no more alike than this share of what a rival needs has none beside it
_NEIGHBOURS = _HALF // 2  # columns about the best place that are no rivals: patches there overlap it by three quarters
#: 1 at a patch's columns, 0 in the rest of a register. As an argument its length is not known when compiling: the loops
#: over it would be unrolled instead of running on vector registers.
ROW = np.float32(np.arange(_LANES) < _SIDE)


class _Space(NamedTuple):
    """Work space of the search."""

    row: NDArray[np.float32]  # `ROW`
    patch: NDArray[np.float32]  # what is looked for by rows, each padded with zeros, its mean removed
    scores: NDArray[np.float32]  # correlations with the places along a row
    folded: NDArray[np.float32]  # see `_fold`


class HalfImage(NamedTuple):
    """An image at half resolution, ready for correlation: flat arrays, with a vector register of zeros behind."""

    shape: tuple[int, int]  # rows and columns
    pixels: NDArray[np.float32]  # grey values on the scale of 8-bit images
    weight: NDArray[np.float32]  # 1 / √(Σ squared deviations of the patch about it); 0 where flat or beyond the image
    between: NDArray[np.float32]  # grey values half a column further to the right


@vector_helper
def _halve(grey, scale, y, columns, pixels, pairs, half, between):
    """Two rows of a flat image as float32 pixels and, brought to 0..255, as row y at half resolution."""
    width, to, quarter = pairs.size - 1, np.uint64(y * columns), np.float32(0.25) * scale
    upper, lower, one, two = np.uint64(2 * y * width), np.uint64((2 * y + 1) * width), np.uint64(1), np.uint64(2)
    for x in range(width):
        k = np.uint64(x)
        a, b = np.float32(grey[upper + k]), np.float32(grey[lower + k])
        pixels[upper + k], pixels[lower + k] = a, b
        pairs[k] = a + b
    pairs[width] = pairs[width - 1]
    for x in range(columns):
        k = two * np.uint64(x)
        half[to + np.uint64(x)] = quarter * (pairs[k] + pairs[k + one])
        between[to + np.uint64(x)] = quarter * (pairs[k + one] + pairs[k + two])


@vector_helper
def _column_sums(pixels, y, columns, sums, squares):
    """Sums of pixels and of their squares over the patch rows about row y, less a middle grey to keep digits."""
    grey = np.float32(128.0)
    for x in range(columns):
        s, q = np.float32(0.0), np.float32(0.0)
        for r in range(_SIDE):
            v = pixels[np.uint64((y - _HALF + r) * columns) + np.uint64(x)] - grey
            s += v
            q += v * v
        sums[x], squares[x] = s, q


@vector_helper
def _row_weights(sums, squares, y, columns, weight):
    area, zero = np.float32(_SIDE * _SIDE), np.float32(0.0)
    least, to = np.float32(_FLAT * _FLAT) * area, np.uint64(y * columns + _HALF)
    for x in range(columns - 2 * _HALF):
        s, q = zero, zero
        for c in range(_SIDE):
            s += sums[x + c]
            q += squares[x + c]
        spread = q - s * s / area
        weight[to + np.uint64(x)] = np.float32(1.0) / np.sqrt(spread) if spread > least else zero


@kernel
def float_images(grey, scale):
    """A grey image (H, W) in float32, and the parts of a `HalfImage` of it, brought to 0..255 by `scale`.

    An odd last row or column is left out there.
    """
    rows, columns = grey.shape[0] // 2, grey.shape[1] // 2
    pixels, size = np.empty(grey.size, np.float32), rows * columns + _LANES
    half, weight, between = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
    sums, squares = np.empty(columns, np.float32), np.empty(columns, np.float32)
    flat, pairs = grey.reshape(-1), np.empty(grey.shape[1] + 1, np.float32)
    for y in range(rows):
        _halve(flat, scale, y, columns, pixels, pairs, half, between)
    for k in range(2 * rows * grey.shape[1], grey.size):
        pixels[k] = np.float32(flat[k])
    for y in range(_HALF, rows - _HALF):
        _column_sums(half, y, columns, sums, squares)
        _row_weights(sums, squares, y, columns, weight)
    return pixels.reshape(grey.shape), (rows, columns), half, weight, between


@vector_helper
def _take_patch(pixels, stride, x, y, space):
    """Look for the patch about a pixel of a flat image, its mean removed."""
    row, patch, total = space.row, space.patch, np.float32(0.0)
    at = np.uint64((y - _HALF) * stride + x - _HALF)
    for c in range(len(row)):
        k = np.uint64(c)
        for r in range(_SIDE):
            total += row[k] * pixels[at + np.uint64(r * stride) + k]
    mean = total / np.float32(_SIDE * _SIDE)
    for c in range(len(row)):
        k = np.uint64(c)
        for r in range(_SIDE):
            patch[np.uint64(r * _LANES) + k] = row[k] * (pixels[at + np.uint64(r * stride) + k] - mean)


@vector_helper
def _correlate(image, stride, y, first, count, own, space):
    """Normalised correlation of a patch with `count` places of row y, and to the end of a vector register."""
    pixels, weights, patch, scores = image.pixels, image.weight, space.patch, space.scores
    count = (count + _LANES - 1) & -_LANES
    for j in range(count):
        scores[j] = np.float32(0.0)
    for r in range(_SIDE):
        start = np.uint64((y - _HALF + r) * stride + first - _HALF)
        n = r * _LANES
        w0, w1, w2, w3, w4 = patch[n], patch[n + 1], patch[n + 2], patch[n + 3], patch[n + 4]
        w5, w6, w7, w8 = patch[n + 5], patch[n + 6], patch[n + 7], patch[n + 8]
        for j in range(count):
            k = start + np.uint64(j)
            scores[j] += (
                w0 * pixels[k] + w1 * pixels[k + np.uint64(1)] + w2 * pixels[k + np.uint64(2)]
                + w3 * pixels[k + np.uint64(3)] + w4 * pixels[k + np.uint64(4)] + w5 * pixels[k + np.uint64(5)]
                + w6 * pixels[k + np.uint64(6)] + w7 * pixels[k + np.uint64(7)] + w8 * pixels[k + np.uint64(8)]
            )  # fmt: skip
    at = np.uint64(y * stride + first)
    for j in range(count):
        scores[j] *= own * weights[at + np.uint64(j)]


@vector_helper
def _fold(scores, count, folded):
    """Of each four scores that are a quarter of the row apart the largest: to look at each score would take longer.

    Returns how many there are, the largest of all, and its column. Scores behind the row are overwritten.
    """
    quarter = (count + 3) // 4
    for j in range(count, 4 * quarter):
        scores[j] = np.float32(-1.0)
    for j in range(quarter):
        k, step = np.uint64(j), np.uint64(quarter)
        a, b, c, d = scores[k], scores[k + step], scores[k + step + step], scores[k + step + step + step]
        folded[k] = max(max(a, b), max(c, d))
    largest, column = folded[0], 0
    for j in range(1, quarter):
        largest = max(largest, folded[j])
    while folded[column] != largest:
        column += 1
    while scores[column] != largest:
        column += quarter
    return quarter, largest, column


@vector_helper
def _height(image, stride, y, x, own, score, side, space):
    """Best correlation of the patch with the places from column x, where it is `score`, to half a column to a side.

    Linear interpolation between two patches, that correlate by `alike` with each other and by s and n with a third,
    correlates with that by the root of ``(s² - 2 alike s n + n²) / (1 - alike²)`` at best, if that lies between them.
    """
    zero, one, area = np.float32(0.0), np.float32(1.0), np.float32(_SIDE * _SIDE)
    row, patch = space.row, space.patch
    at = np.uint64((y - _HALF) * stride + x - _HALF)
    beside = at - np.uint64(1) if side < 0 else at
    sa, sb, bb, ab, product = zero, zero, zero, zero, zero
    for c in range(len(row)):
        k = np.uint64(c)
        for r in range(_SIDE):
            below = np.uint64(r * stride) + k
            a, b = image.pixels[at + below], image.between[beside + below]
            inside = row[k] * b
            sa += row[k] * a
            sb += inside
            bb += inside * b
            ab += inside * a
            product += patch[np.uint64(r * _LANES) + k] * b
    spread = bb - sb * sb / area
    if not spread > area * np.float32(_FLAT * _FLAT):
        return score
    weight = one / np.sqrt(spread)
    n, alike = product * own * weight, (ab - sa * sb / area) * weight * image.weight[np.uint64(y * stride + x)]
    largest = max(score, n)
    if min(score, n) > alike * largest and alike * alike < one:
        largest = np.sqrt((score * score - np.float32(2.0) * alike * score * n + n * n) / (one - alike * alike))
    return min(largest, one)


@vector_helper
def _unresolved(image, stride, x, y, space):
    """How much too low a height may be by noise, and by linear interpolation between places half a column apart.

    An eighth of the share of the variance about (x, y) that interpolation between whole columns leaves unexplained.
    """
    row, (s, ss, ee) = space.row, (np.float32(0.0), np.float32(0.0), np.float32(0.0))
    at = np.uint64((y - _HALF) * stride + x - _HALF)
    for c in range(len(row) - 1):
        k = np.uint64(c)
        for r in range(_SIDE):
            j = at + np.uint64(r * stride) + k
            v = row[k + np.uint64(1)] * image.between[j]
            e = v - row[k + np.uint64(1)] * np.float32(0.5) * (image.pixels[j] + image.pixels[j + np.uint64(1)])
            s += v
            ss += v * v
            ee += e * e
    spread = ss - s * s / np.float32(_SIDE * (_SIDE - 1))
    return ee / np.float32(8.0) / max(spread, np.float32(1e-3))


@helper
def _search(image, shape, band, y, first, last, own, limits, space):
    """The place of the patch in columns first..last of the rows within `band` of y: x, y; -1 where there is none.

    It correlates with at least the first of `limits`, and clearly better than any rival: ``(1 - height) / (1 - rival)``
    is at most the second, with the third taken from the rival's side as what noise may do. Heights are correlations
    between columns, of which there may be one between any two: a wrong place of a repeated pattern on a whole column
    looks better than the true one between two.
    """
    scores, folded, (rows, stride) = space.scores, space.folded, shape
    min_correlation, uniqueness, unresolved = limits
    count, one = last - first + 1, np.float32(1.0)
    found, row, score, height, rival = -1, -1, np.float32(-1.0), np.float32(-1.0), np.float32(-1.0)
    for v in range(max(y - band, _HALF), min(y + band, rows - 1 - _HALF) + 1):
        _correlate(image, stride, v, first, count, own, space)
        quarter, largest, best = _fold(scores, count, folded)
        better = largest > score
        if better:
            if abs(first + best - found) > _NEIGHBOURS:
                rival = max(rival, height)
            found, row, score = first + best, v, largest
        if score < min_correlation:
            continue
        harmless = one - unresolved - (one - score) / uniqueness  # a rival up to this height is none
        least, own_place = np.float32(_CONTENDER) * harmless, best if better else -1
        for f in range(quarter):
            for j in range(f, count if folded[f] >= least else 0, quarter):
                s, itself = scores[j], j == own_place
                if not itself and (s < least or abs(first + j - found) <= _NEIGHBOURS):
                    continue
                before, after = scores[j - 1] if j > 0 else s, scores[j + 1] if j < count - 1 else s
                side = -1 if s >= before > after and first + j > _HALF else 1
                top = _height(image, stride, v, first + j, own, s, side, space)
                if itself:
                    height = top
                else:
                    rival = max(rival, top)
    if score < min_correlation or one - height > uniqueness * (one - rival - unresolved):
        return -1, -1
    return found, row


@kernel
def search_rows(left, right, uv, low, high, band, min_correlation, uniqueness, row):
    """Right positions (N, 2) of left features to a pixel or two, by correlation along rows; NaN where there is none.

    A place counts where it correlates with at least `min_correlation`, clearly better than any rival (ratio ``(1 -
    best) / (1 - rival)`` up to `uniqueness`), and where the search back from it, in the left image, does so too and
    ends within a pixel of where it began. The rectified images have half resolution, with `band` rows searched above
    and below the feature's own; pixels `uv` (N, 2) and disparities from `low` to `high` are those of full resolution.
    """
    out = np.full((len(uv), 2), np.nan)
    low, high = 0.5 * low, 0.5 * high
    height, width = left.shape
    least, most = np.float32(min_correlation), np.float32(uniqueness)
    scores, folded = np.empty(width + _LANES, np.float32), np.empty(width, np.float32)
    space = _Space(row, np.empty(_SIDE * _LANES, np.float32), scores, folded)
    for i in range(len(uv)):
        px, py = 0.5 * (uv[i, 0] - 0.5), 0.5 * (uv[i, 1] - 0.5)
        x, y = int(np.rint(px)), int(np.rint(py))
        if not (_HALF <= x < width - _HALF and _HALF <= y < height - _HALF) or left.weight[y * width + x] == 0.0:
            continue
        found, row = x, y
        for back in range(2):  # to the right image, and from there to the left one again
            if back:
                here, there = right, left
                from_, to = np.floor(found + low), np.ceil(found + high)
            else:
                here, there = left, right
                from_, to = np.floor(found - high), np.ceil(found - low)
            first, last = max(_HALF, int(from_)), min(width - 1 - _HALF, int(to))
            if last <= first and not back:
                break
            limits = least, most, _unresolved(here, width, found, row, space)
            _take_patch(here.pixels, width, found, row, space)
            own = here.weight[row * width + found]
            place, line = _search(there, (height, width), band, row, first, last, own, limits, space)
            if place < 0:
                break
            if not back:
                found, row = place, line
            elif abs(place - x) <= 1:
                out[i, 0], out[i, 1] = 2.0 * (found + px - x) + 0.5, 2.0 * (row + py - y) + 0.5
    return out
