"""Compiled loops of the filter: over its covariance."""

from __future__ import annotations

from slam.runtime.compilation import kernel

_BLOCK = 32  # cost: rows and columns that are gone through together, as half of the places are far apart in memory


@kernel
def lessen(P, begin, upper):
    """Subtract a symmetric matrix, given by its upper triangle, from P (n, n) in place, from row `begin` on."""
    n = len(upper)
    for first in range(0, n, _BLOCK):
        for start in range(first, n, _BLOCK):
            for i in range(first, min(first + _BLOCK, n)):
                for j in range(max(start, i), min(start + _BLOCK, n)):
                    P[begin + i, begin + j] -= upper[i, j]
                for j in range(max(start, i), min(start + _BLOCK, n)):
                    P[begin + j, begin + i] = P[begin + i, begin + j]
