"""Compiled loops over many small Gaussians."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel


@kernel
def squared_distances(gaps, covariances):
    """``gᵀ C⁻¹ g`` (N,) of gaps (N, 3) with covariances (N, 3, 3), by Cholesky; NaN where one is not positive definite.

    Only the lower triangle is read.
    """
    out = np.empty(len(gaps))
    for i in range(len(gaps)):
        out[i] = _squared_distance(gaps[i], covariances[i])
    return out


@kernel
def near_pairs(limit, first, covariances, second, others):
    """Which of some Gaussians (N, 3) are nearer to which others (M, 3) than a limit of χ² (N, M)."""
    near = np.zeros((len(first), len(second)), np.bool_)
    gap, C = np.empty(3), np.empty((3, 3))
    for n in range(len(first)):
        P = covariances[n]
        own = P[0, 0] + P[1, 1] + P[2, 2]
        for m in range(len(second)):
            Q = others[m]
            square = 0.0
            for i in range(3):
                gap[i] = first[n, i] - second[m, i]
                square += gap[i] * gap[i]
            # No variance is larger than the trace: most pairs are too far apart, whatever their covariances are.
            if square < limit * (own + (Q[0, 0] + Q[1, 1] + Q[2, 2])):
                for i in range(3):
                    for j in range(i + 1):
                        C[i, j] = P[i, j] + Q[i, j]
                near[n, m] = _squared_distance(gap, C) < limit
    return near


@helper
def _squared_distance(g, C):
    """``gᵀ C⁻¹ g``, see `squared_distances`."""
    a = np.sqrt(C[0, 0])
    b, c = C[1, 0] / a, C[2, 0] / a
    d = np.sqrt(C[1, 1] - b * b)
    e = (C[2, 1] - b * c) / d
    f = np.sqrt(C[2, 2] - c * c - e * e)
    x = g[0] / a
    y = (g[1] - b * x) / d
    z = (g[2] - c * x - e * y) / f
    return x * x + y * y + z * z if f > 0.0 else np.nan
