"""Which feature continues which track: windows around predicted pixels first, then a wide search for what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.se3 import Array
from slam.objects.pixel_kernels import best_of_products

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class ByLine:
    """A frame's features by ascending line of the left image, to be looked at in many windows.

    Attributes:
        features: of the frame.
        order: their rows (N,), by ascending v.
        pixels, descriptors, laplacian: of the left image, in that order, and
        right: columns of the right image (N,), NaN where there is none.
    """

    features: StereoFeatures
    order: NDArray[np.intp]
    pixels: Array
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    right: Array

    @classmethod
    def of(cls, features: StereoFeatures) -> ByLine:
        """A frame's features, sorted."""
        f, order = features, np.argsort(features.uv_left[:, 1], kind="stable")
        return cls(f, order, f.uv_left[order], f.descriptors[order], f.laplacian[order], f.uv_right[order, 0])


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
