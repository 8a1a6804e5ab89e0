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
_CONTENDER = 0.5  # cost: correlation of a column below which the places beside it are no rivals
_NEIGHBOURS = 2  # columns about the best place that are no rivals of it


class HalfImage(NamedTuple):
    """An image at half resolution, ready for correlation.

    Attributes:
        pixels: grey values (H/2, W/2) float32 on the scale of 8-bit images.
        weight: one over the root of the sum of squared deviations of the patch about each pixel; 0 where it is flat
            or leaves the image.
        flat_pixels: these by rows in one line, and as many zeros behind them as `_correlate` reads.
        flat_weight: likewise.
        between: grey values by rows in one line, half a column further to the right.
    """

    pixels: NDArray[np.float32]
    weight: NDArray[np.float32]
    flat_pixels: NDArray[np.float32]
    flat_weight: NDArray[np.float32]
    between: NDArray[np.float32]


def half_image(image: NDArray, full_scale: float) -> HalfImage:
    """Halve a grey image (H, W) of pixels 0..full_scale for `search_rows`."""
    import cv2

    height, width = image.shape
    small = cv2.resize(image, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    flat_pixels, flat_weight = np.zeros((2, small.size + _LANES), np.float32)
    pixels, weight = flat_pixels[: small.size].reshape(small.shape), flat_weight[: small.size].reshape(small.shape)
    np.multiply(small, np.float32(255.0 / full_scale), out=pixels)
    _weigh(pixels, weight, np.empty(pixels.shape[1], np.float32), np.empty(pixels.shape[1], np.float32))
    between = cv2.resize(np.roll(image, -1, axis=1), small.shape[::-1], interpolation=cv2.INTER_AREA)
    between = between.reshape(-1) * np.float32(255.0 / full_scale)
    return HalfImage(pixels, weight, flat_pixels, flat_weight, between)


@kernel
def _weigh(pixels, weight, sums, squares):
    """Weights of the patches about all pixels of an image, with work space for a row."""
    for y in range(_HALF, pixels.shape[0] - _HALF):
        _column_sums(pixels, y, sums, squares)
        _row_weights(sums, squares, weight, y)


@vector_helper
def _row_weights(sums, squares, weight, y):
    """Weights of a row from the column sums of its patches."""
    area, zero = np.float32(_SIDE * _SIDE), np.float32(0.0)
    least = np.float32(_FLAT * _FLAT) * area
    for x in range(sums.size - 2 * _HALF):
        s, q = zero, zero
        for c in range(_SIDE):
            s += sums[x + c]
            q += squares[x + c]
        spread = q - s * s / area
        weight[y, x + _HALF] = np.float32(1.0) / np.sqrt(spread) if spread > least else zero


@vector_helper
def _column_sums(pixels, y, sums, squares):
    """Sums of pixels and of their squares over the patch rows about row y, less a middle grey to keep digits."""
    grey = np.float32(128.0)
    for x in range(sums.size):
        s, q = np.float32(0.0), np.float32(0.0)
        for r in range(_SIDE):
            v = pixels[y - _HALF + r, x] - grey
            s += v
            q += v * v
        sums[x], squares[x] = s, q


@vector_helper
def _zero_mean_patch(image, x, y, patch):
    """Patch about a pixel, its mean removed."""
    total = np.float32(0.0)
    for r in range(_SIDE):
        for c in range(_SIDE):
            patch[r, c] = image[y - _HALF + r, x - _HALF + c]
            total += patch[r, c]
    for r in range(_SIDE):
        for c in range(_SIDE):
            patch[r, c] -= total / np.float32(_SIDE * _SIDE)


@vector_helper
def _correlate(image, stride, y, first, count, patch, own, scores):
    """Normalised correlation of a patch with the places at columns first, first + 1, ... of row y, into `scores`.

    It goes on to the end of a vector register: `_LANES - 1` more scores and, in the images, pixels at most.
    """
    pixels, weights = image.flat_pixels, image.flat_weight
    count = (count + _LANES - 1) & -_LANES
    for j in range(count):
        scores[j] = np.float32(0.0)
    for r in range(_SIDE):
        start = np.uint64((y - _HALF + r) * stride + first - _HALF)
        w0, w1, w2, w3, w4 = patch[r, 0], patch[r, 1], patch[r, 2], patch[r, 3], patch[r, 4]
        w5, w6, w7, w8 = patch[r, 5], patch[r, 6], patch[r, 7], patch[r, 8]
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
def _largest(scores, first, last):
    """Largest score from `first` to before `last`; -1 where there is none."""
    a = b = c = d = np.float32(-1.0)
    for j in range(first, last - 3, 4):  # four chains: each step of one waits for the step before
        a, b = max(a, scores[j]), max(b, scores[j + 1])
        c, d = max(c, scores[j + 2]), max(d, scores[j + 3])
    for j in range(max(first, last - 3), last):
        a = max(a, scores[j])
    return max(max(a, b), max(c, d))


@helper
def _place_of(scores, value):
    """Column of the first score with a value that there is."""
    j = 0
    while scores[j] != value:
        j += 1
    return j


@vector_helper
def _height(image, stride, y, x, patch, own, score, side):
    """Best correlation of a patch with the places from column x, where it is `score`, to half a column to a side.

    Linear interpolation between two patches, that correlate by `alike` with each other and by s and n with a third,
    correlates with that by the root of ``(s² - 2 alike s n + n²) / (1 - alike²)`` at best, if that lies between them.
    """
    pixels, weights, between = image.flat_pixels, image.flat_weight, image.between
    zero, one, area = np.float32(0.0), np.float32(1.0), np.float32(_SIDE * _SIDE)
    sa, sb, bb, ab, product = zero, zero, zero, zero, zero
    for r in range(_SIDE):
        start = np.uint64((y - _HALF + r) * stride + x - _HALF)
        beside = np.uint64((y - _HALF + r) * stride + x - _HALF + (side - 1) // 2)
        for c in range(_SIDE):
            a, b = pixels[start + np.uint64(c)], between[beside + np.uint64(c)]
            sa += a
            sb += b
            bb += b * b
            ab += a * b
            product += patch[r, c] * b
    spread = bb - sb * sb / area
    if not spread > area * np.float32(_FLAT * _FLAT):
        return score
    weight = one / np.sqrt(spread)
    n, alike = product * own * weight, (ab - sa * sb / area) * weight * weights[np.uint64(y * stride + x)]
    largest = max(score, n)
    if min(score, n) > alike * largest and alike * alike < one:
        largest = np.sqrt((score * score - np.float32(2.0) * alike * score * n + n * n) / (one - alike * alike))
    return min(largest, one)


@vector_helper
def _unresolved(image, stride, x, y):
    """How much too low a height may be by noise, and by linear interpolation between places half a column apart.

    It is half of the share of the variance about (x, y) that interpolation between whole columns leaves unexplained,
    over 4: a share that falls with the fourth power of the distance in smooth images, and more slowly in coarse ones.
    """
    pixels, between = image.flat_pixels, image.between
    s, ss, ee = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for r in range(_SIDE):
        start = np.uint64((y - _HALF + r) * stride + x - _HALF)
        for c in range(_SIDE - 1):
            k = start + np.uint64(c)
            v = between[k]
            e = v - np.float32(0.5) * (pixels[k] + pixels[k + np.uint64(1)])
            s += v
            ss += v * v
            ee += e * e
    spread = ss - s * s / np.float32(_SIDE * (_SIDE - 1))
    return ee / np.float32(8.0) / max(spread, np.float32(1e-3))


@helper
def _search(image, shape, band, y, first, last, patch, own, scores):
    """Best place of a patch in columns first..last of the rows within `band` of y: x, y and correlation.

    And the heights of it and of its rival, the correlations with the best places between columns, by which they are
    compared: a wrong place of a repeated pattern that happens to lie on a whole column looks better than the true one
    that does not.
    """
    rows, stride = shape
    begin, count = np.int64(0), last - first + 1  # no literal number: Numba would compile a helper again for it
    found, row, score, height, rival = -1, -1, np.float32(-1.0), np.float32(-1.0), np.float32(-1.0)
    for v in range(max(y - band, _HALF), min(y + band, rows - 1 - _HALF) + 1):
        _correlate(image, stride, v, first, count, patch, own, scores)
        best, better = _largest(scores, begin, count), False
        if best > score:
            better = True
            place = first + _place_of(scores, best)
            if abs(place - found) > _NEIGHBOURS:
                rival = max(rival, height)
            found, row, score = place, v, best
        for j in range(count):
            s = scores[j]
            before, after = scores[j - 1] if j > 0 else s, scores[j + 1] if j < count - 1 else s
            apart, itself = abs(first + j - found) > _NEIGHBOURS, better and first + j == found
            if not itself and (not apart or s < _CONTENDER or s < before or s < after):
                continue
            side = 1 if after >= before or first + j == _HALF else -1
            top = _height(image, stride, v, first + j, patch, own, s, side)
            if itself:
                height = top
            else:
                rival = max(rival, top)
    return found, row, score, height, rival


def search_rows(
    left: HalfImage,
    right: HalfImage,
    uv: NDArray[np.float64],
    low: float,
    high: float,
    band: int,
    min_correlation: float,
    uniqueness: float,
) -> NDArray[np.float64]:
    """Right positions (N, 2) of left features to a pixel or two, by correlation along rows; NaN where there is none.

    A place counts where it correlates with at least `min_correlation`, clearly better than any rival, and where
    the search back from it, in the left image, does so too and ends within a pixel of where it began.

    Args:
        left: the rectified left image at half resolution.
        right: the right one.
        uv: left pixels (N, 2) at full resolution.
        low: least disparity [px, full resolution].
        high: largest disparity.
        band: rows searched above and below the feature's own [half-resolution px].
        min_correlation: least correlation.
        uniqueness: largest ratio ``(1 - best) / (1 - rival)``.
    """
    out = np.full((len(uv), 2), np.nan)
    patch, scores = np.empty((_SIDE, _SIDE), np.float32), np.empty(left.pixels.shape[1] + _LANES, np.float32)
    _search_rows(left, right, uv, 0.5 * low, 0.5 * high, band, min_correlation, uniqueness, patch, scores, out)
    return out


@kernel
def _search_rows(left, right, uv, low, high, band, min_correlation, uniqueness, patch, scores, out):
    """The same into `out`, at half resolution, with work space for a patch and the scores of a row."""
    height, width = left.pixels.shape
    for i in range(len(uv)):
        px, py = 0.5 * (uv[i, 0] - 0.5), 0.5 * (uv[i, 1] - 0.5)
        x, y = int(np.rint(px)), int(np.rint(py))
        if not (_HALF <= x < width - _HALF and _HALF <= y < height - _HALF) or left.weight[y, x] == 0.0:
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
            unresolved, own = _unresolved(here, width, found, row), here.weight[row, found]
            _zero_mean_patch(here.pixels, found, row, patch)
            place, line, score, best, rival = _search(
                there, here.pixels.shape, band, row, first, last, patch, own, scores
            )
            if score < min_correlation or 1.0 - best > uniqueness * (1.0 - rival - unresolved):
                break
            if not back:
                found, row = place, line
            elif abs(place - x) <= 1:
                out[i, 0], out[i, 1] = 2.0 * (found + px - x) + 0.5, 2.0 * (row + py - y) + 0.5
