"""Which feature continues which track: windows around predicted pixels first, then a wide search for what is left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.se3 import Array

_NEIGHBOURS = 8  # features looked at in a window: the nearest ones
_NONE = np.float32(np.inf)

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


def match_near(
    uv: Array,
    radius: Array,
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    features: StereoFeatures,
    d_match: float,
    ratio: float,
) -> Pairs:
    """Rows of tracks and of features that are each other's best inside windows.

    Args:
        uv: predicted left pixels (N, 2); NaN where there is none.
        radius: half sizes of the windows (N,) [px].
        descriptors: of the tracks (N, D).
        laplacian: of the tracks (N,).
        features: of the frame.
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best in the window.
    """
    from scipy.spatial import cKDTree

    usable = np.flatnonzero(np.isfinite(uv).all(axis=1))
    if not len(usable) or not len(features):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    count = min(_NEIGHBOURS, len(features))
    tree = cKDTree(features.uv_left)
    gap, near = tree.query(uv[usable], k=count, distance_upper_bound=float(radius[usable].max()))
    gap, near = gap.reshape(-1, count), near.reshape(-1, count)
    inside = gap <= radius[usable, None]
    candidate = np.where(inside, near, 0)
    inside &= laplacian[usable, None] == features.laplacian[candidate]
    rows, columns = np.nonzero(inside)
    distance = np.full(gap.shape, _NONE)
    pairs = descriptors[usable[rows]] - features.descriptors[candidate[rows, columns]]
    distance[rows, columns] = np.sqrt(np.einsum("ij,ij->i", pairs, pairs))
    best = distance.argmin(axis=1)
    nearest = distance[np.arange(len(usable)), best]
    good = nearest < d_match
    if count > 1:
        good &= nearest < ratio * np.partition(distance, 1, axis=1)[:, 1]
    return _each_once(usable[good], candidate[np.arange(len(usable)), best][good], nearest[good], len(features))


def match_far(
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    features: StereoFeatures,
    free: NDArray[np.intp],
    allowed: BoolArray,
    d_match: float,
    ratio: float,
) -> Pairs:
    """Rows of tracks (N) and of features that are each other's best where `allowed` (N, len(free))."""
    if not len(descriptors) or not len(free):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = np.sqrt(np.maximum(2 - 2 * (descriptors @ features.descriptors[free].T), 0))
    distance[laplacian[:, None] != features.laplacian[free][None]] = _NONE
    wanted = np.where(allowed, distance, _NONE)
    best = wanted.argmin(axis=1)
    nearest = wanted[np.arange(len(best)), best]
    good = (nearest < d_match) & (wanted.argmin(axis=0)[best] == np.arange(len(best)))
    if wanted.shape[1] > 1:
        good &= nearest < ratio * np.partition(wanted, 1, axis=1)[:, 1]
    return np.flatnonzero(good), free[best[good]]


def _each_once(rows: NDArray[np.intp], columns: NDArray[np.intp], distance: Array, size: int) -> Pairs:
    """Of all pairs with the same feature, the one with the least distance; rows ascending."""
    least = np.full(size, np.inf)
    np.minimum.at(least, columns, distance)
    keep = distance <= least[columns]
    rows, columns = rows[keep], columns[keep]
    _, first = np.unique(columns, return_index=True)
    first.sort()
    return rows[first], columns[first]
