"""Following: which feature of a frame continues which track (paper A, III and IV).

Tracks are searched for around their predicted pixels: in the smallest window first and, if nothing is found, in larger
windows with a stricter descriptor distance (paper A, Fig. 4 and Eq. 12). All tracks' best candidates are found before
any feature is assigned, so that no track takes the feature of another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array
from slam.runtime.compilation import helper, kernel, vector_helper

Descriptors = NDArray[np.float32]

ALIKE = 0.5, 0.8  #: largest descriptor distance of one feature in like light, and its largest ratio to the second best


@dataclass(frozen=True, eq=False)
class Matches(Table):
    """Pairs of a track and the feature that continues it."""

    tracks: NDArray[np.intp]  # rows of the tracks (K,)
    features: NDArray[np.intp]  # rows of the features (K,)


@dataclass(frozen=True, eq=False)
class Windows:
    """Search ellipses about expected pixels, the smallest first, and how alike descriptors must be in each."""

    sizes: tuple[float, ...]  # half sizes (L,), in standard deviations of the innovation
    d_match: tuple[float, ...]  # largest descriptor distance in each (L,)
    ratio: float  # largest ratio of the best to the second best distance
    most: float  # half axes of the smallest are bounded by this [px]
    least: float | Array  # and from below by this, or by one number for each track (M,)


def follow(
    pixels: Array, innovation: Array, descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures,
    windows: Windows, taken: BoolArray | None = None,
) -> Matches:  # fmt: skip
    """Match tracks to features inside windows around where the tracks are expected.

    Tracks whose `pixels` (M, 2) are not finite are not matched. The windows are ellipses of the innovations'
    covariances (M, 2, 2) [px²]. Features that are `taken` (N,) are no candidates.
    """
    order = features.by_column if taken is None else features.by_column[~taken[features.by_column]]
    sizes, pairs = np.array(windows.sizes), np.empty((2, len(pixels)), np.intp)
    least = np.full(len(pixels), windows.least) / sizes[0]
    count = _follow(
        np.ascontiguousarray(pixels), np.ascontiguousarray(innovation), least, windows.most / sizes[0], sizes,
        np.array(windows.d_match, np.float32), np.float32(windows.ratio), np.ascontiguousarray(descriptors), laplacian,
        np.ascontiguousarray(features.uv_left), features.descriptors, features.laplacian, order, pairs,
    )  # fmt: skip
    return Matches(pairs[0, :count], pairs[1, :count])


def match_everywhere(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, d_match: float, ratio: float
) -> Matches:
    """Recognise tracks (M, D) by descriptor alone, wherever they lie in the image.

    Only what has the same sign of the Laplacian is compared: half of the pairs.
    """
    best, limits = np.full(len(descriptors), -1), (np.float32(d_match), np.float32(ratio))
    for sign in (-1, 0, 1):
        rows, columns = (laplacian == sign).nonzero()[0], (features.laplacian == sign).nonzero()[0]
        if len(rows) and len(columns):
            found = mutual_best(descriptors[rows] @ features.descriptors[columns].T, *limits)
            best[rows] = np.where(found < 0, -1, columns[found])
    return _matches(best)


def match_near(
    descriptors: Descriptors, laplacian: NDArray[np.int8], places: Array, variances: Array, features: StereoFeatures,
    points: Array, noise: Array, reach: tuple[float, float], d_match: float, ratio: float,
) -> Matches:  # fmt: skip
    """Recognise tracks (M, D) by descriptor among the features whose points lie near their places.

    Places (M, 3) and points (N, 3) [m] have variances (M,) and `noise` (N,) [m²]. They are near if they are less than
    `reach` apart: so many metres, and so many standard deviations. A feature whose point is NaN is no candidate.
    """
    looks = np.ascontiguousarray(descriptors), laplacian, features.descriptors, features.laplacian
    return _matches(_near(*looks, places, variances, points, noise, *reach, np.float32(d_match), np.float32(ratio)))


def _matches(best: NDArray[np.intp]) -> Matches:
    """The features (M,) that tracks have, −1 for none, as pairs."""
    rows = np.flatnonzero(best >= 0)
    return Matches(rows, best[rows])


@helper
def first_column(uv, order, low):
    """First place in the `order` (N,) of columns whose pixel `uv` (N, 2) is not left of `low`."""
    place, end = 0, len(order)
    while place < end:
        middle = (place + end) // 2
        if uv[order[middle], 0] < low:
            place = middle + 1
        else:
            end = middle
    return place


@helper
def grown(array, room):
    """A copy with more room."""
    new = np.empty(room, array.dtype)
    for k in range(len(array)):
        new[k] = array[k]
    return new


@helper
def best_pairs(rows, columns, distance, allowed, count, size, d_match, ratio, good):
    """Mark in `good` which of the first `count` pairs of rows and columns belong together.

    A row's nearest column must be nearer than `d_match`, and than `ratio` times its second; among the rows that have
    the same one, the nearest gets it. There are `size` rows and columns; pairs that are not `allowed` do not count.
    """
    nearest, second = np.empty(size[0], np.float32), np.empty(size[0], np.float32)
    of_column, most = np.empty(size[1], np.float32), np.float32(np.inf)
    for row in range(size[0]):  # slices and fills take a second to compile
        nearest[row] = second[row] = most
    for column in range(size[1]):
        of_column[column] = most
    for p in range(count):
        if allowed[p]:
            row, column, d = rows[p], columns[p], distance[p]
            if d < nearest[row]:
                second[row], nearest[row] = nearest[row], d
            elif d < second[row]:  # also one that is as near as the first
                second[row] = d
    for p in range(count):
        row, column, d = rows[p], columns[p], distance[p]
        good[p] = allowed[p] and d == nearest[row] and d < d_match and d < ratio * second[row]
        if good[p] and d < of_column[column]:  # a row that would not take it has no claim to a column
            of_column[column] = d
    for p in range(count):
        good[p] = good[p] and distance[p] <= of_column[columns[p]]


@kernel
def mutual_best(products, d_match, ratio):
    """The features (N,) that belong to tracks as in `best_pairs`, −1 for none, wherever they lie.

    Given are the inner products of descriptors, tracks by features (N, M).
    """
    count, far = len(products), np.float32(-np.inf)
    best, most = np.full(count, -1, np.intp), np.empty((count, 2), np.float32)
    for n in range(count):
        first = second = far
        for m in range(products.shape[1]):
            p = products[n, m]
            if p > second:
                second = min(p, first)
                if p > first:
                    first, best[n] = p, m
        most[n, 0], most[n, 1] = first, second
    _keep_mutual(best, most, products.shape[1], d_match, ratio)
    return best


@kernel
def _near(looks, signs, feature_looks, feature_signs, places, variances, points, noise, metres, sigmas, d_match, ratio):
    """The features (M,) that belong to tracks as in `best_pairs`, −1 for none: see `match_near`."""
    count, far, size = len(looks), np.float32(-np.inf), 0
    best, most = np.full(count, -1, np.intp), np.empty((count, 2), np.float32)
    candidates, deviation = np.empty(len(points), np.intp), np.empty(len(points))
    for m in range(len(points)):
        if np.isfinite(points[m, 0]):
            candidates[size], deviation[size] = m, np.sqrt(noise[m])
            size += 1
    for n in range(count):
        first = second = far
        own = metres + sigmas * np.sqrt(variances[n])
        for c in range(size):
            m, largest = candidates[c], own + sigmas * deviation[c]  # at most: roots add up to more
            x, y, z = points[m, 0] - places[n, 0], points[m, 1] - places[n, 1], points[m, 2] - places[n, 2]
            square = x * x + y * y + z * z
            if not square < largest * largest or feature_signs[m] != signs[n]:
                continue
            if np.sqrt(square) < metres + sigmas * np.sqrt(variances[n] + noise[m]):
                p = product(looks[n], feature_looks[m])
                if p > second:
                    second = min(p, first)
                    if p > first:
                        first, best[n] = p, m
        most[n, 0], most[n, 1] = first, second
    _keep_mutual(best, most, len(points), d_match, ratio)
    return best


@helper
def _keep_mutual(best, most, columns, d_match, ratio):
    """Of each row's `best` column (N,), keep those as in `best_pairs`, −1 for others, in place.

    `most` (N, 2) are a row's two largest inner products.
    """
    distance, of_column = np.empty(len(best), np.float32), np.full(columns, np.inf, np.float32)
    for n in range(len(best)):
        distance[n] = np.sqrt(max(np.float32(2.0) - np.float32(2.0) * most[n, 0], np.float32(0.0)))
        other = np.sqrt(max(np.float32(2.0) - np.float32(2.0) * most[n, 1], np.float32(0.0)))
        if not (distance[n] < d_match and distance[n] < ratio * other):
            best[n] = -1
        elif distance[n] < of_column[best[n]]:  # a row that would not take it has no claim to a column
            of_column[best[n]] = distance[n]
    for n in range(len(best)):
        if best[n] >= 0 and distance[n] > of_column[best[n]]:
            best[n] = -1


@helper
def ellipse(S, low, high):
    """Shape (uu, uv, vv) of the ellipse of a covariance (2, 2), and its half sizes; squared half axes are bounded."""
    mean, half, cross = 0.5 * (S[0, 0] + S[1, 1]), 0.5 * (S[0, 0] - S[1, 1]), S[0, 1]
    radius = np.hypot(half, cross)
    safe = max(radius, 2.2250738585072014e-308)
    c2, cs = 0.5 + 0.5 * half / safe, 0.5 * cross / safe  # cos², cos · sin of the long axis' angle
    s2 = 1.0 - c2
    long, short = min(max(mean + radius, low), high), min(max(mean - radius, low), high)
    u, v = np.sqrt(c2 * long + s2 * short), np.sqrt(s2 * long + c2 * short)
    return c2 / long + s2 / short, cs / long - cs / short, s2 / long + c2 / short, u, v


@vector_helper
def product(a, b):
    """Inner product of two descriptors (D,)."""
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@helper
def in_windows(pixels, innovation, least, most, sizes, signs, uv, feature_signs, order):
    """Pairs of tracks and features (P,) in the largest window of each track, and the smallest window of each pair.

    For the arguments see `_follow`; returns three arrays with room for more, and the number of pairs.
    """
    levels, last = len(sizes), sizes[len(sizes) - 1]
    count, room = 0, 4 * len(pixels) + 64
    tracks, features, level = np.empty(room, np.intp), np.empty(room, np.intp), np.empty(room, np.intp)
    for row in range(len(pixels)):
        x, y = pixels[row, 0], pixels[row, 1]
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        uu, cross, vv, reach_u, reach_v = ellipse(innovation[row], least[row] ** 2, most**2)
        reach_u, reach_v = last * reach_u, last * reach_v
        place = first_column(uv, order, x - reach_u)
        while place < len(order) and uv[order[place], 0] <= x + reach_u:
            feature = order[place]
            place += 1
            if abs(uv[feature, 1] - y) > reach_v or feature_signs[feature] != signs[row]:
                continue
            du, dv = uv[feature, 0] - x, uv[feature, 1] - y
            off = uu * du * du + 2.0 * cross * du * dv + vv * dv * dv
            smallest = 0
            while smallest < levels and off > sizes[smallest] ** 2:
                smallest += 1
            if smallest == levels:
                continue
            if count == room:
                room *= 2
                tracks, features, level = grown(tracks, room), grown(features, room), grown(level, room)
            tracks[count], features[count], level[count] = row, feature, smallest
            count += 1
    return tracks, features, level, count


@kernel
def _follow(
    pixels, innovation, least, most, sizes, limits, ratio, looks, signs, uv, feature_looks, feature_signs, order, pairs
):
    """Pairs of tracks and of the features that continue them: those in the smallest window, then in larger ones.

    Tracks are expected at `pixels` (M, 2) with the `innovation` (M, 2, 2), which shapes the windows: their half axes
    are `sizes` (L,) times standard deviations from `least` (M,) to `most`. In each window, descriptors must be nearer
    than its limit (L,). Tracks have `looks` and `signs`; the features are at
    `uv`, in the `order` of their columns. `pairs` (2, M) are filled in; returns their number.
    """
    a, b, level, count = in_windows(pixels, innovation, least, most, sizes, signs, uv, feature_signs, order)
    matched = 0  # tracks that look alike to the bit may share a feature
    done, taken = np.zeros(len(pixels), np.bool_), np.zeros(len(uv), np.bool_)
    allowed, good = np.empty(count, np.bool_), np.empty(count, np.bool_)
    distance = np.empty(count, np.float32)
    for window in range(len(sizes)):
        for p in range(count):
            allowed[p] = level[p] <= window and not done[a[p]] and not taken[b[p]]
            if allowed[p] and level[p] == window:  # in a larger window, of tracks that are not found yet alone
                likeness = product(looks[a[p]], feature_looks[b[p]])
                distance[p] = np.sqrt(max(np.float32(2.0) - np.float32(2.0) * likeness, np.float32(0.0)))
        best_pairs(a, b, distance, allowed, count, (len(pixels), len(uv)), limits[window], ratio, good)
        for p in range(count):
            if good[p]:
                done[a[p]] = taken[b[p]] = True
                pairs[0, matched], pairs[1, matched] = a[p], b[p]
                matched += 1
    return matched
