"""The chi-square gate on innovations, and what follows where most of them contradict the prediction."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc, comb, gammainc

from slam.chi_square import chi_square_limit
from slam.geometry import kernels
from slam.geometry.se3 import Array

MIN_OBSERVATIONS = 6  #: fewest observations whose agreement is tested
ONE_AGREES_IN = 3  #: a prediction holds if at least one in so many observations agrees with it
MIN_CONSENSUS = 5  #: fewest observations that agree on a pose by more than chance; three determine it
INFLATION = (3.0, 10.0)  #: factors on the process noise's standard deviation tried if observations disagree


def by_chance(rejected: Array, agree: int, count: int, limit: float, probability: float, fitted: int = 0) -> bool:
    """Whether as many of `count` wrong observations may pass a gate as agree, at the gate's own level.

    The gate has a `limit` for squared distances, χ² with three degrees of freedom, and a `probability`. Those of the
    observations that it `rejected` (R,) show how widely wrong ones scatter about their predictions; without any: True.
    `fitted` observations agree with the pose that was made to fit them, whatever they are, and it may have been made to
    fit any so many: the number of others that agree is tested for all such choices together (an a contrario test, as in
    Moisan & Stival, IJCV 2004).
    """
    if not len(rejected) or agree <= fitted:
        return True
    spread = float(np.median(rejected)) / chi_square_limit(3, 0.5)  # in units of the innovation covariances
    share = gammainc(1.5, limit / spread / 2)
    others = bdtrc(agree - fitted - 1, count - fitted, share)
    return bool(comb(count, fitted) * others > 1 - probability)


def squared_distances(residuals: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances ``νᵀ S⁻¹ ν`` (M,) of residuals ν (M, 3) = (uL, vL, uR) [px].

    Where uR is NaN the left pixel alone is tested. Of the covariances S (M, 3, 3) [px²] lower triangles count. A row
    that cannot be tested (left residual not finite, S not finite or not positive definite) has distance ∞.
    """
    distance = kernels.squared_distances(np.ascontiguousarray(residuals), np.ascontiguousarray(covariances))
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf))
