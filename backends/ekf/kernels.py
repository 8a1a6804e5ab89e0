"""Compiled loops of the filter. The Jacobian H of a measurement has nine columns: the camera's [r, φ], the landmark."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import squared_distance
from slam.runtime.compilation import kernel

_BLOCK = 64  # cost: rows and columns that are copied at a time


@kernel
def times(by_pose, own, first, X, out):
    """``H X`` into `out` (3M, N).

    Args:
        by_pose: derivatives (M, 3, 6) of landmarks' measurements by [r, φ].
        own: derivatives (M, 3, 3) by the landmarks' own coordinates.
        first: rows (M,) of X with these coordinates begin here; [r, φ] are the first six.
        X: rows of the state (n, N).
        out: filled in.
    """
    for i in range(len(own)):
        x = first[i]
        for j in range(3):
            row = 3 * i + j
            a, b, c = own[i, j, 0], own[i, j, 1], own[i, j, 2]
            for k in range(X.shape[1]):
                out[row, k] = a * X[x, k] + b * X[x + 1, k] + c * X[x + 2, k]
            a, b, c = by_pose[i, j, 0], by_pose[i, j, 1], by_pose[i, j, 2]
            d, e, f = by_pose[i, j, 3], by_pose[i, j, 4], by_pose[i, j, 5]
            for k in range(X.shape[1]):
                out[row, k] += a * X[0, k] + b * X[1, k] + c * X[2, k] + d * X[3, k] + e * X[4, k] + f * X[5, k]


@kernel
def innovation_covariance(by_pose, own, first, HP, variance, out):
    """``S = H (H P)ᵀ + variance 1`` (3M, 3M): its lower triangle into `out`; arguments as of `times`."""
    for row in range(len(HP)):
        for i in range(row // 3 + 1):
            x = first[i]
            for j in range(3):
                value = own[i, j, 0] * HP[row, x] + own[i, j, 1] * HP[row, x + 1] + own[i, j, 2] * HP[row, x + 2]
                for k in range(6):
                    value += by_pose[i, j, k] * HP[row, k]
                out[row, 3 * i + j] = value
        out[row, row] += variance


@kernel
def own_distances(nu, S):
    """``ν_jᵀ S_jj⁻¹ ν_j`` (M,) of each landmark's innovation ν_j by itself; NaN where S_jj is not positive definite."""
    out, C = np.empty(len(nu) // 3), np.empty((3, 3))
    for m in range(len(out)):
        for i in range(3):
            for j in range(i + 1):
                C[i, j] = S[3 * m + i, 3 * m + j]
        out[m] = squared_distance(nu[3 * m : 3 * m + 3], C)
    return out


@kernel
def conditional_distances(inverse, lost, y):
    """``y_jᵀ Q_j⁻¹ y_j`` (M,) with the landmarks' blocks ``Q_j = (L⁻ᵀ L⁻¹ − lostᵀ lost)_jj``.

    Args:
        inverse: ``L⁻¹`` (3M, 3M), lower triangular.
        lost: (K, 3M).
        y: (3M,).
    """
    m = len(y) // 3
    out, Q = np.empty(m), np.zeros((m, 3, 3))
    for rows, sign in ((inverse, 1.0), (lost, -1.0)):
        for row in range(len(rows)):
            for i in range(row // 3 + 1 if sign > 0 else m):
                for a in range(3):
                    for b in range(a + 1):
                        Q[i, a, b] += sign * rows[row, 3 * i + a] * rows[row, 3 * i + b]
    for i in range(m):
        out[i] = squared_distance(y[3 * i : 3 * i + 3], Q[i])
    return out


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
def gather(dense, cross, left, rows, columns):
    """Part (R, C) of the matrix ``[[dense, cross, 0], [crossᵀ, left, 0], [0, 0, 0]]``; numbers of its rows and columns.

    A number −1 stands for the last part, what is independent of all else.
    """
    n, out = len(dense), np.empty((len(rows), len(columns)))
    for i in range(len(rows)):
        r = rows[i]
        for j in range(len(columns)):
            c = columns[j]
            if r < 0 or c < 0:
                out[i, j] = 0.0
            elif r < n:
                out[i, j] = dense[r, c] if c < n else cross[r, c - n]
            else:
                out[i, j] = cross[c, r - n] if c < n else left[r - n, c - n]
    return out
