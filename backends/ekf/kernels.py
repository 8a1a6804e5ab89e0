"""Compiled loops of the filter: over its covariance."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel

_BLOCK = 64  # cost: rows and columns that are copied at a time


@kernel
def mirror(P):
    """Copy the upper triangle of P (n, n) to the lower, in place."""
    n = len(P)
    for top in range(0, n, _BLOCK):
        for left in range(top, n, _BLOCK):
            for i in range(top, min(top + _BLOCK, n)):
                for j in range(max(left, i + 1), min(left + _BLOCK, n)):
                    P[j, i] = P[i, j]


@kernel
def gather(P, rows, columns):
    """P (n, m) at some rows and columns, zero where they are −1."""
    out = np.zeros((len(rows), len(columns)))
    for i in range(len(rows)):
        if rows[i] >= 0:
            for j in range(len(columns)):
                if columns[j] >= 0:
                    out[i, j] = P[rows[i], columns[j]]
    return out
