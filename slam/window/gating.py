"""The chi-square gate on innovations, one for all back ends."""

from __future__ import annotations

import numpy as np

from slam.chi_square import chi_square_limits
from slam.data import BoolArray
from slam.geometry.se3 import Array


def squared_distances(residuals: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances ``νᵀ S⁻¹ ν`` (M,).

    Args:
        residuals: ν (M, 3) = (uL, vL, uR) [px]; where uR is NaN the left pixel alone is tested.
        covariances: S (M, 3, 3) [px²], lower triangles; the last row of a missing uR does not count.

    A row that cannot be tested (left residual not finite, S not finite or not positive definite) has distance ∞.
    """
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN if S is not positive definite
        l00, l10, l11, l20, l21, l22 = _cholesky(covariances)
        y0 = residuals[:, 0] / l00
        y1 = (residuals[:, 1] - l10 * y0) / l11
        y2 = (residuals[:, 2] - l20 * y0 - l21 * y1) / l22
        left = y0 * y0 + y1 * y1
        distance = np.where(np.isnan(residuals[:, 2]), left, left + y2 * y2)
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf))


def _cholesky(S: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """The entries (M,) of L in ``S = L Lᵀ``, row by row; NaN where S (M, 3, 3) is not positive definite.

    Written out: for thousands of 3x3 matrices this is many times faster than LAPACK.
    """
    l00 = np.sqrt(S[:, 0, 0])
    l10, l20 = S[:, 1, 0] / l00, S[:, 2, 0] / l00
    l11 = np.sqrt(S[:, 1, 1] - l10 * l10)
    l21 = (S[:, 2, 1] - l20 * l10) / l11
    return l00, l10, l11, l20, l21, np.sqrt(S[:, 2, 2] - l20 * l20 - l21 * l21)


def whiteners(covariances: Array) -> Array:
    """``W = L⁻¹`` (M, 3, 3) with ``S = L Lᵀ``, so that ``W ν`` has covariance I where ν has S (M, 3, 3).

    Raises:
        numpy.linalg.LinAlgError: a covariance is not positive definite.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        l00, l10, l11, l20, l21, l22 = _cholesky(covariances)
        W = np.zeros_like(covariances)
        W[:, 0, 0], W[:, 1, 1], W[:, 2, 2] = 1 / l00, 1 / l11, 1 / l22
        W[:, 1, 0] = -l10 * W[:, 0, 0] / l11
        W[:, 2, 0] = -(l20 * W[:, 0, 0] + l21 * W[:, 1, 0]) / l22
        W[:, 2, 1] = -l21 * W[:, 1, 1] / l22
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
