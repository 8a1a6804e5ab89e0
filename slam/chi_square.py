"""Outlier limits of χ² and Gaussian numbers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

#: Standard deviations within which a Gaussian number lies (99.7 %); smaller differences are not significant.
SIGMAS = 3.0


def chi_square_limit(dof: int, probability: float) -> float:
    """The quantile of χ² at `probability` for `dof` degrees of freedom."""
    return float(_quantiles(dof, probability)[dof])


def chi_square_limits(dof: NDArray, probability: float) -> NDArray[np.float64]:
    """Quantiles (M,) of χ² at `probability` for integer degrees of freedom (M,)."""
    return np.asarray(_quantiles(int(np.max(dof, initial=0)), probability)[np.asarray(dof, int)])


@lru_cache(maxsize=256)
def _quantiles(most: int, probability: float) -> NDArray[np.float64]:
    """Quantiles (most + 1,) for 0 to `most` degrees of freedom."""
    return np.append(0.0, 2.0 * gammaincinv(np.arange(1, most + 1) / 2.0, probability))
