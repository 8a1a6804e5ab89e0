"""The chi-square gate on innovations, and what follows where most of them contradict the prediction."""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc

from slam.chi_square import chi_square_limit
from slam.geometry.se3 import Array

MIN_OBSERVATIONS = 6  #: fewest observations whose agreement is tested
ONE_AGREES_IN = 3  #: a prediction holds if at least one in so many observations agrees with it
MIN_CONSENSUS = 5  #: fewest observations that agree on a pose by more than chance; three determine it
INFLATION = (3.0, 10.0)  #: factors on the process noise's standard deviation tried if observations disagree


def share_by_chance(rejected: Array, limit: float) -> float:
    """The share of wrong observations that pass a gate by chance.

    The rejected observations show how widely wrong ones scatter about their predictions.

    Args:
        rejected: squared Mahalanobis distances (R,) of the rejected observations, χ² with three degrees of freedom.
        limit: the gate.
    """
    median = chi_square_limit(3, 0.5)
    spread = float(np.median(rejected)) / median  # in units of the innovation covariances
    return float(gammainc(1.5, limit / spread / 2))


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
