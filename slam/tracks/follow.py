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
from slam.geometry.se3 import Array
from slam.table import Table
from slam.tracks.config import AssociationConfig

Descriptors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Matches(Table):
    """Pairs of a landmark and a feature."""

    landmarks: NDArray[np.intp]  # rows of the landmarks (K,)
    features: NDArray[np.intp]  # rows of the features (K,)


def follow(
    pixels: Array, innovation: Array, descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures,
    config: AssociationConfig, rows: NDArray[np.intp] | None = None,
) -> Matches:  # fmt: skip
    """Match tracks to features inside size-variable windows around where the tracks are expected.

    Args:
        pixels: where they are expected (M, 2); tracks whose pixels are not finite are not matched.
        innovation: covariances of these pixels' innovations (M, 2, 2) [px²], of which the windows are ellipses.
        descriptors: of the tracks (M, D), or of a longer list of which they are `rows`.
        laplacian: signs of the Laplacian, likewise.
        features: of the frame.
        config: the windows, and the largest descriptor distance in each.
        rows: the tracks' rows (M,) in `descriptors`, which the matches name; None if these are the tracks'.
    """
    square = config.windows == "fixed"
    sizes = np.array(config.window_sizes if square else config.window_sigmas)
    bounds = (0.0, 0.0) if square else (config.window_min / sizes[0], config.window_max / sizes[0])
    rows = np.arange(len(pixels)) if rows is None else rows
    every = np.arange(len(features))
    return _followed(
        pixels, innovation, bounds, sizes, config.d_match, config.ratio, descriptors, laplacian, rows, features, every
    )


def match_in_boxes(
    centres: Array, reach: float, descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures,
    rows: NDArray[np.intp], d_match: float, ratio: float,
) -> Matches:  # fmt: skip
    """`follow` tracks into square boxes of half size `reach` [px], to features `rows` (K,) of a frame only."""
    sizes, none, every = np.array([reach]), np.zeros((len(centres), 2, 2)), np.arange(len(centres))
    looks = descriptors, laplacian, every
    return _followed(centres, none, (0.0, 0.0), sizes, (d_match,), ratio, *looks, features, rows)


def _followed(
    pixels: Array, innovation: Array, bounds: tuple[float, float], sizes: Array, d_match: tuple[float, ...],
    ratio: float, descriptors: Descriptors, laplacian: NDArray[np.int8], rows: NDArray[np.intp],
    features: StereoFeatures, among: NDArray[np.intp],
) -> Matches:  # fmt: skip
    """The kernel's answer as pairs; features `among` (K,) may be matched."""
    from slam.tracks import follow_kernels

    order = among[np.argsort(features.uv_left[among, 0], kind="stable")]
    limits = np.array(d_match, np.float32)
    pairs = np.empty((2, len(pixels)), np.intp)
    count = follow_kernels.follow(
        np.ascontiguousarray(pixels), np.ascontiguousarray(innovation), bounds, sizes, limits, np.float32(ratio),
        np.ascontiguousarray(descriptors), laplacian, rows, np.ascontiguousarray(features.uv_left),
        features.descriptors, features.laplacian, order, pairs,
    )  # fmt: skip
    return Matches(rows[pairs[0, :count]], pairs[1, :count])


def match_everywhere(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, config: AssociationConfig
) -> Matches:
    """Recognise landmarks (M, D) by descriptor alone, wherever they lie in the image."""
    none = np.zeros(0, np.intp)
    if not len(descriptors) or not len(features):
        return Matches(none, none)
    from slam.tracks.follow_kernels import mutual_best

    limit = config.wide_d_match / config.wide_ratio  # farther features affect neither best nor ratio
    near = descriptors @ features.descriptors.T > np.float32(1 - 0.5 * limit * limit)
    near &= laplacian[:, None] == features.laplacian[None, :]
    rows, columns = np.nonzero(near)
    product = np.einsum("pd,pd->p", descriptors.take(rows, axis=0), features.descriptors.take(columns, axis=0))
    distance = np.sqrt(np.maximum(2 - 2 * product, 0))
    best = np.empty(len(rows), bool)
    mutual_best(
        rows, columns, distance, (len(descriptors), len(features)), np.float32(config.wide_d_match),
        np.float32(config.wide_ratio), best,
    )  # fmt: skip
    return Matches(rows[best], columns[best])


def pairs_in_boxes(centres: Array, reach: Array, uv: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of rows of centres (M, 2) and of pixels (N, 2) within `reach` (M, 2) of them, by ascending centre.

    Pixels are sorted by column, so that few pairs have to be tested.
    """
    from slam.tracks import follow_kernels

    order = np.argsort(uv[:, 0], kind="stable")
    x, y = uv[:, 0].take(order), uv[:, 1].take(order)
    boxes = np.ascontiguousarray(centres), np.ascontiguousarray(reach)
    rows, places = np.empty((2, 8 * len(centres)), np.intp)  # 8: pairs a box for which there is room at once
    count = follow_kernels.pairs_in_boxes(*boxes, x, y, rows, places)
    if count > len(rows):
        rows, places = np.empty((2, count), np.intp)
        follow_kernels.pairs_in_boxes(*boxes, x, y, rows, places)
    return rows[:count], order.take(places[:count])


def crowded(uv: Array, neighbours: Array, radius: float) -> BoolArray:
    """Which pixels (N, 2) lie within `radius` [px] of any of `others` (M, 2)."""
    if not len(neighbours):
        return np.zeros(len(uv), bool)
    rows, columns = pairs_in_boxes(uv, np.full((len(uv), 2), radius), neighbours)
    gap = (uv[rows] - neighbours[columns]).astype(np.float32)
    out = np.zeros(len(uv), bool)
    out[rows[np.square(gap).sum(axis=1) < radius * radius]] = True
    return out
