"""The chi-square gate on innovations, and what follows from its limits."""

from __future__ import annotations

import numpy as np

from slam.chi_square import chi_square_limits
from slam.data import BoolArray
from slam.geometry.se3 import Array

_MOST_CORRELATED = 1 - 1e-9  # numerics: largest correlation of two pixels


def squared_distances(residuals: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances ``νᵀ S⁻¹ ν`` (M,).

    Args:
        residuals: ν (M, 3) = (uL, vL, uR) [px]; where uR is NaN the left pixel alone is tested.
        covariances: S (M, 3, 3) [px²], lower triangles; the last row of a missing uR does not count.

    A row that cannot be tested (left residual not finite, S not finite or not positive definite) has distance ∞.
    """
    from slam.geometry import kernels

    distance = kernels.squared_distances(np.ascontiguousarray(residuals), np.ascontiguousarray(covariances))
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf))


def with_noise(covariances: Array, sigma: float) -> Array:
    """Covariances (M, 2, 2) [px²] of predicted pixels with the noise of a measurement [px] added, positive definite.

    After a long gap variances are so large that their digits do not hold the noise of a pixel: where rounding has left
    less than that, or a correlation beyond ±1, there is the least that is definite.
    """
    S = covariances + sigma**2 * np.eye(2)
    S[:, [0, 1], [0, 1]] = np.maximum(S[:, [0, 1], [0, 1]], sigma**2)
    most = _MOST_CORRELATED * np.sqrt(S[:, 0, 0] * S[:, 1, 1])
    S[:, 0, 1] = S[:, 1, 0] = np.clip(S[:, 0, 1], -most, most)
    return S


def whiteners(covariances: Array) -> Array:
    """``W = L⁻¹`` (M, 3, 3) with ``S = L Lᵀ``, so that ``W ν`` has covariance I where ν has S (M, 3, 3).

    Raises:
        numpy.linalg.LinAlgError: a covariance is not positive definite.
    """
    from slam.geometry import kernels

    W = np.asarray(kernels.whiteners(np.ascontiguousarray(covariances)))
    if not np.isfinite(W).all():
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return W


def chi_square_gate(residuals: Array, innovation_covariances: Array, probability: float) -> BoolArray:
    """Which observations (M,) lie inside the χ² quantile `probability` of their own innovation covariance.

    Args:
        residuals: measured less predicted (uL, vL, uR), (M, 3) [px]; uR NaN for a left pixel alone (two degrees of
            freedom).
        innovation_covariances: (M, 3, 3) [px²], measurement noise included.
        probability: share of correct measurements that pass if the covariances are right, in (0, 1).
    """
    dof = np.where(np.isnan(residuals[:, 2]), 2, 3)
    return np.asarray(squared_distances(residuals, innovation_covariances) <= chi_square_limits(dof, probability))
