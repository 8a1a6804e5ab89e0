"""Compiled loops over many small Gaussians."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel


@kernel
def squared_distances(gaps, covariances):
    """``gᵀ C⁻¹ g`` (N,) of gaps (N, 3) with covariances (N, 3, 3), by Cholesky; NaN where one is not positive definite.

    Only the lower triangle is read.
    """
    out = np.empty(len(gaps))
    for i in range(len(gaps)):
        C, g = covariances[i], gaps[i]
        a = np.sqrt(C[0, 0])
        b, c = C[1, 0] / a, C[2, 0] / a
        d = np.sqrt(C[1, 1] - b * b)
        e = (C[2, 1] - b * c) / d
        f = np.sqrt(C[2, 2] - c * c - e * e)
        x = g[0] / a
        y = (g[1] - b * x) / d
        z = (g[2] - c * x - e * y) / f
        out[i] = x * x + y * y + z * z if f > 0.0 else np.nan
    return out
