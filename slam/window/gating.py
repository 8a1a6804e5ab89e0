"""The chi-square gate on innovations, and what follows where most of them contradict the prediction."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc, comb, gammainc, gammaincinv

from slam.chi_square import chi_square_limit
from slam.geometry import kernels
from slam.geometry.arrays import BoolArray
from slam.geometry.se3 import Array

ONE_AGREES_IN = 3  #: a prediction holds if at least one in so many observations agrees with it
MIN_CONSENSUS = 5  #: fewest observations that agree on a pose by more than chance; three determine it
MIN_OBSERVATIONS = MIN_CONSENSUS + 1  #: fewest observations whose agreement is tested: one may contradict the others
INFLATION = (3.0, 10.0)  #: factors on the process noise's standard deviation tried if observations disagree


def by_chance(z: Array, used: BoolArray, distances: Array, probability: float, fitted: int = 0) -> bool:
    """Whether as many wrong observations may pass a gate as agree with a prediction, at the gate's own level.

    Of the observations z (M, 3), NaN where a component is not measured, those `used` (M,) agree. The squared distances
    (M,) of those beyond the gate show how widely wrong ones scatter about their predictions; without any: True.
    `fitted` observations agree with the pose that was made to fit them, whatever they are, and it may have been made to
    fit any so many: the number of others that agree is tested for all such choices together (an a contrario test, as in
    Moisan & Stival, IJCV 2004).
    """
    dof, agree = int(np.isfinite(z).sum(axis=1).max()), int(used.sum())
    rejected = distances[~used & np.isfinite(distances) & (distances > chi_square_limit(dof, probability))]
    if not len(rejected) or agree <= fitted:
        return True
    share = _passing(rejected, dof, probability)
    others = bdtrc(agree - fitted - 1, len(z) - fitted, share)
    return bool(comb(len(z), fitted) * others > 1 - probability)


def _passing(rejected: Array, dof: int, probability: float) -> float:
    """Share of wrong observations that pass the gate, whose squared distances are a scaled χ², by those that do not.

    Their median is that of what lies beyond the limit: ``median = scale · quantile((1 + share) / 2)``.
    """
    limit, middle, share = chi_square_limit(dof, probability), float(np.median(rejected)), 0.0
    for _ in range(50):  # 50: steps of a fixed point that only rises
        scale = middle / (2 * gammaincinv(dof / 2, (1 + share) / 2))
        share = float(gammainc(dof / 2, limit / scale / 2))
    return share


def squared_distances(residuals: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances ``νᵀ S⁻¹ ν`` (M,) of residuals ν (M, 3) = (uL, vL, uR) [px].

    Where uR is NaN the left pixel alone is tested. Of the covariances S (M, 3, 3) [px²] lower triangles count. A row
    that cannot be tested (left residual not finite, S not finite or not positive definite) has distance ∞.
    """
    distance = kernels.squared_distances(np.ascontiguousarray(residuals), np.ascontiguousarray(covariances))
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf))
