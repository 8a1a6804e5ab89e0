"""Compiled loops of the filter's step over its covariance, beside what BLAS and LAPACK do."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel

_BLOCK = 32  # cost: rows and columns that are mirrored at once


@kernel
def mirror(P):
    """The lower triangle of P (n, n) also above its diagonal, in place."""
    n = len(P)
    for first in range(0, n, _BLOCK):
        for left in range(0, first + 1, _BLOCK):
            for i in range(first, min(first + _BLOCK, n)):
                for j in range(left, min(left + _BLOCK, i)):
                    P[j, i] = P[i, j]


@kernel
def rearranged(P, order):
    """P (n, n) with its rows and columns in an order (k,); those of a negative number are zero."""
    out = np.zeros((len(order), len(order)))
    for i in range(len(order)):
        for j in range(len(order) if order[i] >= 0 else 0):
            if order[j] >= 0:
                out[i, j] = P[order[i], order[j]]
    return out
