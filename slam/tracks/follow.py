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
from slam.tracks.config import AssociationConfig

Descriptors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Matches(Table):
    """Pairs of a track and the feature that continues it."""

    tracks: NDArray[np.intp]  # rows of the tracks (K,)
    features: NDArray[np.intp]  # rows of the features (K,)


@dataclass(frozen=True, eq=False)
class Windows:
    """Search windows about expected pixels, the smallest first, and how alike descriptors must be in each."""

    sizes: tuple[float, ...]  # half sizes (L,): standard deviations of the innovation; of squares [px]
    d_match: tuple[float, ...]  # largest descriptor distance in each (L,)
    ratio: float  # largest ratio of the best to the second best distance
    most: float = 0.0  # half axes of the smallest ellipse are bounded by this [px]; 0 for squares
    least: float | Array = 0.0  # and from below by this, or by one number for each track (M,)

    @classmethod
    def of(cls, c: AssociationConfig) -> Windows:
        """The windows of landmarks."""
        if c.windows == "fixed":
            return cls(c.window_sizes, c.d_match, c.ratio)
        return cls(c.window_sigmas, c.d_match, c.ratio, c.window_max, c.window_min)


def follow(
    pixels: Array, innovation: Array, descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures,
    windows: Windows, taken: BoolArray | None = None,
) -> Matches:  # fmt: skip
    """Match tracks to features inside windows around where the tracks are expected.

    Tracks whose `pixels` (M, 2) are not finite are not matched. The windows are ellipses of the innovations'
    covariances (M, 2, 2) [px²]. Features that are `taken` (N,) are no candidates.
    """
    from slam.tracks import follow_kernels

    order = np.argsort(features.uv_left[:, 0], kind="stable")
    order = order if taken is None else order[~taken[order]]
    sizes, pairs = np.array(windows.sizes), np.empty((2, len(pixels)), np.intp)
    least = np.broadcast_to(windows.least, len(pixels)) / sizes[0]
    count = follow_kernels.follow(
        np.ascontiguousarray(pixels), np.ascontiguousarray(innovation), least, windows.most / sizes[0], sizes,
        np.array(windows.d_match, np.float32), np.float32(windows.ratio), np.ascontiguousarray(descriptors), laplacian,
        np.ascontiguousarray(features.uv_left), features.descriptors, features.laplacian, order, pairs,
    )  # fmt: skip
    return Matches(pairs[0, :count], pairs[1, :count])


def match_everywhere(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, d_match: float, ratio: float,
    allowed: BoolArray | None = None,
) -> Matches:  # fmt: skip
    """Recognise tracks (M, D) by descriptor alone, wherever they lie in the image, or in pairs `allowed` (M, N)."""
    from slam.tracks.follow_kernels import mutual_best

    best = np.empty(len(descriptors), np.intp)
    allowed = np.ones((0, 0), bool) if allowed is None else np.ascontiguousarray(allowed)
    mutual_best(
        descriptors @ features.descriptors.T, allowed, laplacian, features.laplacian, np.float32(d_match),
        np.float32(ratio), best,
    )  # fmt: skip
    rows = np.flatnonzero(best >= 0)
    return Matches(rows, best[rows])


def pairs_in_boxes(centres: Array, reach: Array, uv: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of rows of centres (M, 2) and of pixels (N, 2) within `reach` (M, 2) of them, by ascending centre.

    Pixels are sorted by column, so that few pairs have to be tested.
    """
    from slam.tracks import follow_kernels

    order = np.argsort(uv[:, 0], kind="stable")
    boxes = np.ascontiguousarray(centres), np.ascontiguousarray(reach), np.ascontiguousarray(uv), order
    rows, inside = np.empty((2, 8 * len(centres)), np.intp)  # 8: pairs a box for which there is room at once
    count = follow_kernels.pairs_in_boxes(*boxes, rows, inside)
    if count > len(rows):
        rows, inside = np.empty((2, count), np.intp)
        follow_kernels.pairs_in_boxes(*boxes, rows, inside)
    return rows[:count], inside[:count]


def crowded(uv: Array, neighbours: Array, radius: float) -> BoolArray:
    """Which pixels (N, 2) lie within `radius` [px] of any of the `neighbours` (M, 2)."""
    if not len(neighbours):
        return np.zeros(len(uv), bool)
    rows, columns = pairs_in_boxes(uv, np.full((len(uv), 2), radius), neighbours)
    gap = (uv[rows] - neighbours[columns]).astype(np.float32)
    out = np.zeros(len(uv), bool)
    out[rows[np.square(gap).sum(axis=1) < radius * radius]] = True
    return out
