"""Matching of descriptors: nearest neighbours under a distance (paper A, Eq. 12) and a ratio (paper B, 2.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.errors import MeasurementError
from slam.runtime.compilation import kernel, vector_helper


class Matches(NamedTuple):
    """Pairs of features, by rising row of the first set.

    Attributes:
        first, second: their rows (M,) in the two sets.
        distance: Euclidean distance of their descriptors (M,).
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    distance: NDArray[np.float32]


def match(
    descriptors: NDArray[np.float32],
    descriptors2: NDArray[np.float32],
    *,
    signs: tuple[NDArray[np.int8], NDArray[np.int8]] | None = None,
    places: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    window: float | NDArray[np.float64] = np.inf,
    d_match: float = np.inf,
    ratio: float = 0.7,
    mutual: bool = True,
) -> Matches:
    """Match each feature of the first set with its nearest neighbour in the second.

    Args:
        descriptors: unit vectors (N, D) float32 of the first set.
        descriptors2: those of the second (N2, D).
        signs: of the Laplacian, (N,) and (N2,); only features of the same sign match.
        places: pixels where the features of the first set are expected, (N, 2), and those of the second, (N2, 2).
        window: half width of the square windows about the expected places [px], one number or (N,); features outside
            are neither candidates nor rivals, and are not looked at.
        d_match: largest distance (paper A, Eq. 12).
        ratio: largest ratio of the two smallest distances (paper B, 2.2); 1 does without.
        mutual: the first feature must also be the second one's nearest neighbour.

    Raises:
        MeasurementError: the arrays' shapes do not fit together.
    """
    n, n2 = len(descriptors), len(descriptors2)
    if descriptors.ndim != 2 or descriptors.shape[1:] != descriptors2.shape[1:]:
        raise MeasurementError(f"matching: descriptors {descriptors.shape} and {descriptors2.shape} differ in length")
    if places is None:
        places, window = (np.zeros((n, 2)), np.zeros((n2, 2))), np.inf
    if signs is None:
        signs = np.zeros(n, np.int8), np.zeros(n2, np.int8)
    if len(places[0]) != n or len(places[1]) != n2 or len(signs[0]) != n or len(signs[1]) != n2:
        raise MeasurementError(f"matching: places or signs do not have {n} and {n2} rows")
    order = np.argsort(places[1][:, 1], kind="stable")
    best, distance = _nearest(
        *_contiguous(descriptors, places[0], signs[0]),
        *_contiguous(descriptors2[order], places[1][order], signs[1][order]),
        np.broadcast_to(np.asarray(window, float), (n,)).copy(),
        min(d_match, 1e9),
        ratio,
        mutual,
    )
    first = np.flatnonzero(best >= 0)
    return Matches(first, order[best[first]], distance[first])


def _contiguous(
    descriptors: NDArray, places: NDArray, signs: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.int8]]:
    """The arrays in the types and layout that the kernel is compiled for."""
    return (
        np.require(descriptors, np.float32, ["C", "W"]),
        np.require(places, np.float64, ["C", "W"]),
        np.require(signs, np.int8, ["C", "W"]),
    )


@vector_helper
def _squared_distance(a, i, b, j):
    """Squared Euclidean distance of two rows."""
    total = np.float32(0.0)
    for k in range(a.shape[1]):
        total += (a[i, k] - b[j, k]) * (a[i, k] - b[j, k])
    return total


@kernel
def _nearest(descriptors, places, signs, descriptors2, places2, signs2, window, d_match, ratio, mutual):
    """Matched row of the second set (N,), or -1, and the distance; the second set is sorted by its pixels' y."""
    n, n2 = len(descriptors), len(descriptors2)
    best, distance = np.full(n, -1, np.int64), np.full(n, np.inf, np.float32)
    rival = np.full(n, np.inf, np.float32)
    back, back_distance = np.full(n2, -1, np.int64), np.full(n2, np.inf, np.float32)
    rows = places2[:, 1].copy()
    for i in range(n):
        x, y, w = places[i, 0], places[i, 1], window[i]
        for j in range(np.searchsorted(rows, y - w), np.searchsorted(rows, y + w, side="right")):
            if abs(places2[j, 0] - x) > w or signs[i] != signs2[j]:
                continue
            d = _squared_distance(descriptors, i, descriptors2, j)
            if d < distance[i]:
                best[i], rival[i], distance[i] = j, distance[i], d
            elif d < rival[i]:
                rival[i] = d
            if d < back_distance[j]:
                back[j], back_distance[j] = i, d
    for i in range(n):
        d = np.sqrt(distance[i])
        far = d > d_match or d > ratio * np.sqrt(rival[i])
        if best[i] >= 0 and (far or (mutual and back[best[i]] != i)):
            best[i] = -1
        distance[i] = d
    return best, distance
