"""Which feature continues which track: windows around predicted pixels first, then a wide search for what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.se3 import Array
from slam.objects.pixel_kernels import best_in_windows, best_of_products

_NEIGHBOURS = 8  # cost: features looked at in a window: the nearest ones

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class ByLine:
    """A frame's features by ascending line of the left image, to be looked at in many windows.

    Attributes:
        features: of the frame.
        order: their rows (N,), by ascending v.
        pixels, descriptors, laplacian: of the left image, in that order.
    """

    features: StereoFeatures
    order: NDArray[np.intp]
    pixels: Array
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]

    @classmethod
    def of(cls, features: StereoFeatures) -> ByLine:
        """A frame's features, sorted."""
        f, order = features, np.argsort(features.uv_left[:, 1], kind="stable")
        return cls(f, order, f.uv_left[order], f.descriptors[order], f.laplacian[order])


def match_near(
    uv: Array,
    radius: Array,
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    among: ByLine,
    d_match: float,
    ratio: float,
) -> Pairs:
    """Rows of tracks and of features that are each other's best inside windows.

    Args:
        uv: predicted left pixels (N, 2); NaN where there is none.
        radius: half sizes of the windows (N,) [px].
        descriptors: of the tracks (N, D).
        laplacian: of the tracks (N,).
        among: features of the frame.
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best in the window.
    """
    first = np.searchsorted(among.pixels[:, 1], uv[:, 1] - radius)
    best = best_in_windows(
        np.ascontiguousarray(uv), radius, first, descriptors, laplacian, among.pixels, among.descriptors,
        among.laplacian, _NEIGHBOURS, d_match, ratio,
    )  # fmt: skip
    rows = np.flatnonzero(best >= 0)
    return rows, among.order[best[rows]]


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
    products = descriptors @ features.descriptors[free].T
    signs = features.laplacian[free]
    best = best_of_products(products, np.ascontiguousarray(allowed), laplacian, signs, d_match, ratio)
    rows = np.flatnonzero(best >= 0)
    return rows, free[best[rows]]
