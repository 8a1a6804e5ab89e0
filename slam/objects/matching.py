"""Which feature continues which track, wherever that may be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.objects.pixel_kernels import best_of_products

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


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
