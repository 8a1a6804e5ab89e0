"""Compiled loops of the filter: over its covariance."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import kernel


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
