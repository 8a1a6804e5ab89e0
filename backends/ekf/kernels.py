"""Compiled loops of the filter. The Jacobian H of a measurement has nine columns: the camera's [r, φ], the landmark."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import squared_distance
from slam.runtime.compilation import kernel

_BLOCK = 64  # cost: rows and columns that are copied at a time


@kernel
def times(by_pose, own, marks, head, P, with_camera, with_marks):
    """``H`` times the covariance of camera and landmarks, into `with_camera` (3M, 12) and `with_marks` (3M, 3A).

    The landmarks `marks` (M,) are measured, with derivatives (M, 3, 6) by [r, φ] and (M, 3, 3) by their own
    coordinates; the covariance has the camera's rows `head`, in which the landmarks' columns follow those of the last
    poses, and P (3A, 3A).
    """
    size, h, n = with_camera.shape[1], len(head), len(P)
    p, q, r = head[0][h : h + n], head[1][h : h + n], head[2][h : h + n]
    s, t, u = head[3][h : h + n], head[4][h : h + n], head[5][h : h + n]
    for i in range(len(own)):
        x = 3 * marks[i]
        for j in range(3):
            out, row = with_marks[3 * i + j], with_camera[3 * i + j]
            a, b, c = own[i, j, 0], own[i, j, 1], own[i, j, 2]
            for k in range(size):
                row[k] = a * head[k, h + x] + b * head[k, h + x + 1] + c * head[k, h + x + 2]
            for k in range(n):
                out[k] = a * P[x, k] + b * P[x + 1, k] + c * P[x + 2, k]
            a, b, c = by_pose[i, j, 0], by_pose[i, j, 1], by_pose[i, j, 2]
            d, e, f = by_pose[i, j, 3], by_pose[i, j, 4], by_pose[i, j, 5]
            for k in range(size):
                row[k] += a * head[0, k] + b * head[1, k] + c * head[2, k]
                row[k] += d * head[3, k] + e * head[4, k] + f * head[5, k]
            for k in range(n):
                out[k] += a * p[k] + b * q[k] + c * r[k] + d * s[k] + e * t[k] + f * u[k]


@kernel
def innovation_covariance(by_pose, own, marks, with_camera, with_marks, variance, out):
    """``S = H (H P)ᵀ + variance 1``: its lower triangle into `out` (3M, 3M); arguments as of `times`."""
    for row in range(len(out)):
        for i in range(row // 3 + 1):
            x = 3 * marks[i]
            for j in range(3):
                value = own[i, j, 0] * with_marks[row, x] + own[i, j, 1] * with_marks[row, x + 1]
                value += own[i, j, 2] * with_marks[row, x + 2]
                for k in range(6):
                    value += by_pose[i, j, k] * with_camera[row, k]
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

    ``L⁻¹`` is `inverse` (3M, 3M), lower triangular; `lost` (K, 3M), y (3M,).
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
