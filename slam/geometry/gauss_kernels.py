"""Compiled loops over many small Gaussians."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import squared_distance, trace, whitener
from slam.runtime.compilation import kernel


@kernel
def squared_distances(gaps, covariances):
    """``gᵀ C⁻¹ g`` (N,) of gaps (N, 3) with covariances (N, 3, 3), by Cholesky; NaN where one is not positive definite.

    Only the lower triangle is read. Where the third entry of a gap is NaN, the first two count alone.
    """
    out = np.empty(len(gaps))
    for i in range(len(gaps)):
        out[i] = squared_distance(gaps[i], covariances[i])
    return out


@kernel
def whiteners(covariances):
    """Inverses (N, 3, 3) of the Cholesky factors of covariances (N, 3, 3); NaN where one is not positive definite."""
    out = np.empty(covariances.shape)
    for i in range(len(covariances)):
        whitener(covariances[i], out[i])
    return out


@kernel
def near_pairs(limit, first, covariances, second, others):
    """Which of some Gaussians (N, 3) are nearer to which others (M, 3) than a limit of χ² (N, M)."""
    near = np.zeros((len(first), len(second)), np.bool_)
    gap, C = np.empty(3), np.empty((3, 3))
    for n in range(len(first)):
        P = covariances[n]
        own = trace(P)
        for m in range(len(second)):
            Q = others[m]
            square = 0.0
            for i in range(3):
                gap[i] = first[n, i] - second[m, i]
                square += gap[i] * gap[i]
            # No variance is larger than the trace: most pairs are too far apart, whatever their covariances are.
            if square < limit * (own + trace(Q)):
                for i in range(3):
                    for j in range(i + 1):
                        C[i, j] = P[i, j] + Q[i, j]
                near[n, m] = squared_distance(gap, C) < limit
    return near
