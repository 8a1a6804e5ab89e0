"""Weights of residuals that may be outliers."""

from __future__ import annotations

import numpy as np

from slam.chi_square import chi_square_limit
from slam.geometry.arrays import Array, median


def student_weights(squared: Array, dof: int, least: float) -> Array:
    """Weights (N,) of residuals by Student's t distribution, as factors on their information.

    Args:
        squared: squared residuals (N,), in units of a covariance of unknown scale.
        dof: dimension of a residual.
        least: least scale, as a standard deviation. The squared scale is the median of `squared` over that of χ².
    """
    if not len(squared):
        return squared
    scale = max(median(squared) / chi_square_limit(dof, 0.5), least**2)
    # 4.0: degrees of freedom of Student's t, with tails like those of matches, a few of which are wrong
    return np.asarray((4.0 + dof) / (4.0 + squared / scale) / scale)
