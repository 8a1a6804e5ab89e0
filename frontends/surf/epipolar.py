"""Search along epipolar lines of rectified images by normalised correlation, at half resolution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import helper, kernel, vector_helper

_HALF = 4  # fixed: half width of the compared patches [half-resolution px]; the kernel's inner loop is written for it
_SIDE = 2 * _HALF + 1
_FLAT = 2.0  # least standard deviation of a patch [grey levels of 8-bit images]
_LANES = 16  # cost: columns are searched in whole vector registers
_PADDED = (_SIDE * _SIDE + _LANES - 1) // _LANES * _LANES  # pixels of a patch by rows, padded with zeros
_CONTENDER = 0.7  # cost: a column no more alike than this share of what a rival needs has none beside it
_NEIGHBOURS = 2  # columns about the best place that are no rivals of it


class _Space(NamedTuple):
    """Work space of the search: for patches by rows, padded with zeros, and the places along a row."""

    patch: NDArray[np.float32]  # what is looked for, its mean removed
    pixels: NDArray[np.float32]  # the patch at a place
    between: NDArray[np.float32]  # and half a column beside it
    side: int  # of a patch; no constant here, or its loops would be unrolled instead of running on vector registers
    scores: NDArray[np.float32]  # correlations with the places


class HalfImage(NamedTuple):
    """An image at half resolution, ready for correlation: flat arrays, with a vector register of zeros behind."""

    shape: tuple[int, int]  # rows and columns
    pixels: NDArray[np.float32]  # grey values on the scale of 8-bit images
    weight: NDArray[np.float32]  # 1 / √(Σ squared deviations of the patch about it); 0 where flat or beyond the image
    between: NDArray[np.float32]  # grey values half a column further to the right


def half_image(image: NDArray[np.float32], scale: float) -> HalfImage:
    """Halve an image (H, W), brought to 0..255 by `scale`; an odd last row or column is left out."""
    rows, columns = max(image.shape[0] // 2, 1), max(image.shape[1] // 2, 1)
    planes = np.zeros((3, rows * columns + _LANES), np.float32)
    if min(rows, columns) >= _SIDE:
        _halve(image, np.float32(0.25 * scale), rows, columns, planes)
    return HalfImage((rows, columns), *planes)


@vector_helper
def _means(upper, lower, share, width, pixels, between, to):
    """Means of the 2x2 pixels of two rows, each times `share`, and of those half a column further to the right."""
    for x in range(width):
        j, k = np.uint64(2 * x), to + np.uint64(x)
        inner = upper[j + np.uint64(1)] + lower[j + np.uint64(1)]
        pixels[k] = share * (upper[j] + lower[j] + inner)
        between[k] = share * (inner + upper[j + np.uint64(2)] + lower[j + np.uint64(2)])


@vector_helper
def _column_sums(pixels, y, sums):
    """Sums of pixels and of their squares over the patch rows about row y, less a middle grey to keep digits."""
    grey = np.float32(128.0)
    for x in range(sums.shape[1]):
        s, q = np.float32(0.0), np.float32(0.0)
        for r in range(_SIDE):
            v = pixels[y - _HALF + r, x] - grey
            s += v
            q += v * v
        sums[0, x], sums[1, x] = s, q


@vector_helper
def _row_weights(sums, weight, y):
    area, zero = np.float32(_SIDE * _SIDE), np.float32(0.0)
    least = np.float32(_FLAT * _FLAT) * area
    for x in range(sums.shape[1] - 2 * _HALF):
        s, q = zero, zero
        for c in range(_SIDE):
            s += sums[0, x + c]
            q += sums[1, x + c]
        spread = q - s * s / area
        weight[y, x + _HALF] = np.float32(1.0) / np.sqrt(spread) if spread > least else zero


@kernel
def _halve(image, share, rows, columns, planes):
    """Fill in the planes of a `HalfImage` of so many rows and columns; `share` is a quarter of the scale."""
    pixels, weight, between = planes[0], planes[1], planes[2]
    size, sums = rows * columns, np.empty((2, columns), np.float32)
    for y in range(rows):
        upper, lower, last = image[2 * y], image[2 * y + 1], (y + 1) * columns - 1
        _means(upper, lower, share, columns - 1, pixels, between, np.uint64(y * columns))
        x, end = 2 * columns - 1, image.shape[1] - 1  # beyond an even width the last column counts again
        inner = upper[x] + lower[x]
        pixels[last] = share * (upper[x - 1] + lower[x - 1] + inner)
        between[last] = share * (inner + upper[end] + lower[end])
    pixels, weight = pixels[:size].reshape(rows, columns), weight[:size].reshape(rows, columns)
    for y in range(_HALF, rows - _HALF):
        _column_sums(pixels, y, sums)
        _row_weights(sums, weight, y)


@vector_helper
def _cut(pixels, stride, x, y, side, out):
    """The patch about a pixel of a flat image, by rows."""
    for r in range(_SIDE):
        start, to = np.uint64((y - _HALF + r) * stride + x - _HALF), np.uint64(r * _SIDE)
        for c in range(side):
            out[to + np.uint64(c)] = pixels[start + np.uint64(c)]


@vector_helper
def _take_patch(pixels, stride, x, y, space):
    """Look for the patch about a pixel of a flat image, its mean removed."""
    patch, n = space.patch, space.side * space.side
    _cut(pixels, stride, x, y, space.side, patch)
    total = np.float32(0.0)
    for k in range(n):
        total += patch[k]
    mean = total / np.float32(_SIDE * _SIDE)
    for k in range(n):
        patch[k] -= mean


@vector_helper
def _correlate(image, stride, y, first, count, own, space):
    """Normalised correlation of a patch with `count` places of row y, and to the end of a vector register."""
    pixels, weights, patch, scores = image.pixels, image.weight, space.patch, space.scores
    count = (count + _LANES - 1) & -_LANES
    for j in range(count):
        scores[j] = np.float32(0.0)
    for r in range(_SIDE):
        start = np.uint64((y - _HALF + r) * stride + first - _HALF)
        n = r * _SIDE
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
def _largest(scores, count):
    """Largest of the first scores, and the first column that has it."""
    a = b = c = d = scores[0]
    for j in range(0, count - 3, 4):  # four chains: each step of one waits for the step before
        a, b, c, d = max(a, scores[j]), max(b, scores[j + 1]), max(c, scores[j + 2]), max(d, scores[j + 3])
    for j in range(count - count % 4, count):
        a = max(a, scores[j])
    largest, column = max(max(a, b), max(c, d)), 0
    while scores[column] != largest:
        column += 1
    return largest, column


@vector_helper
def _height(image, stride, y, x, own, score, side, space):
    """Best correlation of the patch with the places from column x, where it is `score`, to half a column to a side.

    Linear interpolation between two patches, that correlate by `alike` with each other and by s and n with a third,
    correlates with that by the root of ``(s² - 2 alike s n + n²) / (1 - alike²)`` at best, if that lies between them.
    """
    zero, one, area = np.float32(0.0), np.float32(1.0), np.float32(_SIDE * _SIDE)
    patch, pixels, between = space.patch, space.pixels, space.between
    _cut(image.pixels, stride, x, y, space.side, pixels)
    _cut(image.between, stride, x + (side - 1) // 2, y, space.side, between)
    sa, sb, bb, ab, product = zero, zero, zero, zero, zero
    for k in range(patch.size):
        a, b = pixels[k], between[k]
        sa += a
        sb += b
        bb += b * b
        ab += a * b
        product += patch[k] * b
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
    pixels, between, inner = space.pixels, space.between, space.side - 1
    _cut(image.pixels, stride, x, y, space.side, pixels)
    _cut(image.between, stride, x, y, space.side, between)
    s, ss, ee = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for r in range(_SIDE):
        for c in range(inner):
            k = np.uint64(r * _SIDE) + np.uint64(c)
            v = between[k]
            e = v - np.float32(0.5) * (pixels[k] + pixels[k + np.uint64(1)])
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
    scores, (min_correlation, uniqueness, unresolved), (rows, stride) = space.scores, limits, shape
    count, one = last - first + 1, np.float32(1.0)
    found, row, score, height, rival = -1, -1, np.float32(-1.0), np.float32(-1.0), np.float32(-1.0)
    for v in range(max(y - band, _HALF), min(y + band, rows - 1 - _HALF) + 1):
        _correlate(image, stride, v, first, count, own, space)
        largest, best = _largest(scores, count)
        better = largest > score
        if better:
            if abs(first + best - found) > _NEIGHBOURS:
                rival = max(rival, height)
            found, row, score = first + best, v, largest
        if score < min_correlation:
            continue
        harmless = one - unresolved - (one - score) / uniqueness  # a rival up to this height is none
        least, own_place = np.float32(_CONTENDER) * harmless, best if better else -1
        for j in range(count):
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
def search_rows(left, right, uv, low, high, band, min_correlation, uniqueness):
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
    space = _Space(
        np.zeros(_PADDED, np.float32), np.zeros(_PADDED, np.float32), np.zeros(_PADDED, np.float32), _SIDE,
        np.empty(width + _LANES, np.float32),
    )  # fmt: skip
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
