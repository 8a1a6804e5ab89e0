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
def gather(marks, cross, left, rows, columns, m):
    """Part (3R, 3C + m) of the landmarks' covariance, by rows of their table, and their columns of m errors of the rig.

    What is only known is independent of all else.
    """
    n, both = len(marks) // 3, (len(marks) + len(left)) // 3
    out, end, rig = np.empty((3 * len(rows), 3 * len(columns) + m)), 3 * len(columns), cross.shape[1] - m
    for i in range(3 * len(rows)):
        r, x = rows[i // 3], 3 * rows[i // 3] + i % 3
        if r >= both:
            out[i] = 0.0
            continue
        beyond = cross[x] if r < n else left[x - 3 * n]
        for j in range(len(columns)):
            c, y = columns[j], 3 * j
            if c < n and r < n:
                z = 3 * c
                out[i, y], out[i, y + 1], out[i, y + 2] = marks[x, z], marks[x, z + 1], marks[x, z + 2]
            elif c < n:
                z = x - 3 * n
                out[i, y], out[i, y + 1], out[i, y + 2] = cross[3 * c, z], cross[3 * c + 1, z], cross[3 * c + 2, z]
            elif c < both:
                z = 3 * (c - n)
                out[i, y], out[i, y + 1], out[i, y + 2] = beyond[z], beyond[z + 1], beyond[z + 2]
            else:
                out[i, y], out[i, y + 1], out[i, y + 2] = 0.0, 0.0, 0.0
        for k in range(m):
            out[i, end + k] = beyond[rig + k]
    return out
