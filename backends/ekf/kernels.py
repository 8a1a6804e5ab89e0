"""The compiled parts of a step, in the papers' order: predict; measurement and H; ``H P`` and S; the corrected P.

Products of large matrices are left to BLAS, in `backends.ekf.innovation` and `backends.ekf.covariance`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import multiply, row_times, subtract
from slam.kernels.se3 import transform_back
from slam.kernels.stereo import by_point, residual
from slam.runtime.compilation import disjoint_vector_helper, kernel

_FARTHEST = 1e-6  # numerics: least inverse depth [1/m]
_LEFT = 0.1  # share of its inverse depth that a landmark keeps at least in an update
_ASIDE = 1e3  # guard: largest |x/z|, |y/z|; 89.9 degrees from the axis of the camera that saw it first
_BLOCK = 32  # cost: rows and columns that are mirrored at once


@kernel
def transformed(P, F):
    """``G P Gᵀ`` (n, n) of a symmetric P, where G is F (k, k), and leaves the numbers after those as they are."""
    n, k = len(P), len(F)
    out = np.empty((n, n))
    for i in range(k):
        for j in range(n):
            out[i, j] = 0.0
        for h in range(k):
            if F[i, h] != 0.0:
                subtract(out[i], -F[i, h], P[h])
    head = np.zeros((k, k))
    for i in range(k):
        for j in range(i + 1):
            for h in range(k):
                head[i, j] += out[i, h] * F[j, h]
    for i in range(k):
        for j in range(i + 1):
            out[i, j] = out[j, i] = head[i, j]
    for i in range(k, n):
        for j in range(k):
            out[i, j] = out[j, i]
        for j in range(k, n):
            out[i, j] = P[i, j]
    return out


@kernel
def charted(inverse, anchors, c, change):
    """Landmarks after a change (M, 3) of their coordinates c (M, 3), as `backends.ekf.landmarks` describes them.

    Coordinates are of inverse depth, or else Euclidean. Returns them; positions (M, 3); derivatives (M, 3, 3) of these
    by the coordinates; derivatives (M, 3, 6) of the coordinates by a displacement of the world.
    """
    out, points, D, gauge = np.empty_like(c), np.empty_like(c), np.zeros((len(c), 3, 3)), np.zeros((len(c), 3, 6))
    by_local, back, ray = np.zeros((3, 3)), np.zeros((3, 3)), np.empty(3)
    for m in range(len(c)):
        R, y = anchors[m], out[m]
        for i in range(3):
            y[i] = points[m, i] = c[m, i] + change[m, i]
            D[m, i, i] = gauge[m, i, i] = 1.0
        if inverse:
            for i in range(2):
                aside = max(abs(c[m, i]), _ASIDE)
                y[i] = min(max(y[i], -aside), aside)
            y[2] = max(y[2], max(_LEFT * c[m, 2], _FARTHEST))
            w = y[2]
            by_local[0, 0] = by_local[1, 1] = 1.0 / w
            back[0, 0] = back[1, 1] = w
            ray[0], ray[1], ray[2] = y[0] / w, y[1] / w, 1.0 / w
            for i in range(3):
                by_local[i, 2], back[i, 2] = -ray[i] / w, -y[i] * w
            multiply(R, by_local, D[m])
            for i in range(3):
                points[m, i] = row_times(R, i, ray) + R[i, 3]
                for j in range(3):
                    gauge[m, i, j] = row_times(back, i, R[j])
        x = points[m]
        for i in range(3):  # D⁻¹ [1, −hat(x)]
            g = gauge[m, i]
            g[3], g[4], g[5] = g[2] * x[1] - g[1] * x[2], g[0] * x[2] - g[2] * x[0], g[1] * x[0] - g[0] * x[1]
    return out, points, D, gauge


@kernel
def measured(camera, T, points, D, lever, of_prior, z):
    """``h(x)`` (M, 3) [px], NaN behind the camera, linearised at a pose T (4, 4); see `backends.ekf.innovation`.

    Further what is seen of the measurements z (M, 3), as a mask; derivatives of it by the coordinates (M, 3, 3) and by
    the pose's error (3M, 6), and what these would be less by the prior's lever.
    """
    count = len(points)
    predicted, seen, own = np.empty((count, 3)), np.zeros((count, 3), np.bool_), np.zeros((count, 3, 3))
    by_pose, B = np.zeros((3 * count, 6)), np.zeros((3 * count, 6))
    local, r, J, by_world, origin = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3), np.zeros(3)
    for m in range(count):
        transform_back(T, points[m], local)
        front = residual(camera, local, origin, r, J)
        for a in range(3):
            predicted[m, a] = -r[a]
            if not (front and np.isfinite(z[m, a])):
                continue
            seen[m, a] = True
            by_point(J[a], T, by_world)
            for i in range(3):
                for j in range(3):
                    own[m, a, i] += by_world[j] * D[m, j, i]
            for i in range(3):
                for j in range(6):
                    by_pose[3 * m + a, j] -= own[m, a, i] * lever[m, i, j]
                    B[3 * m + a, j] += own[m, a, i] * (of_prior[m, i, j] - lever[m, i, j])
    return predicted, seen, own, by_pose, B


@kernel
def H_times(X, at, by_pose, own, B, GX):
    """``H X − B (G X)`` (3M, k) of X (n, k); the coordinates of landmark m stand at ``at[m]``, and the pose first."""
    out = np.zeros((len(by_pose), X.shape[1]))
    for i in range(len(out)):
        m = i // 3
        a, h = own[m, i % 3], at[m]
        _combine(out[i], by_pose[i], X[0], X[1], X[2], X[3], X[4], X[5], a, X[h], X[h + 1], X[h + 2])
        for j in range(len(GX)):
            subtract(out[i], B[i, j], GX[j])
    return out


@disjoint_vector_helper
def _combine(out, w, x0, x1, x2, x3, x4, x5, a, y0, y1, y2):
    """``Σ w_k x_k + Σ a_k y_k``."""
    w0, w1, w2, w3, w4, w5, a0, a1, a2 = w[0], w[1], w[2], w[3], w[4], w[5], a[0], a[1], a[2]
    for j in range(len(out)):
        out[j] = w0 * x0[j] + w1 * x1[j] + w2 * x2[j] + w3 * x3[j] + w4 * x4[j] + w5 * x5[j]
        out[j] += a0 * y0[j] + a1 * y1[j] + a2 * y2[j]


@kernel
def innovation_covariance(HP, at, by_pose, own, B, HPG, variance):
    """``S = H P Hᵀ + σ² 1`` (3M, 3M) by ``H P`` (3M, n), and ``H P Gᵀ`` where H is less by ``B G``."""
    S = np.empty((len(HP), len(HP)))
    for i in range(len(HP)):
        row = HP[i]
        for j in range(i + 1):
            w, a, h = by_pose[j], own[j // 3, j % 3], at[j // 3]
            total = a[0] * row[h] + a[1] * row[h + 1] + a[2] * row[h + 2]
            for k in range(6):
                total += w[k] * row[k]
            for k in range(HPG.shape[1]):
                total -= HPG[i, k] * B[j, k]
            S[i, j] = S[j, i] = total
        S[i, i] += variance
    return S


@kernel
def mirror(P, n):
    """The lower triangle of the first n rows and columns of P also above its diagonal, in place."""
    for first in range(0, n, _BLOCK):
        for left in range(0, first + 1, _BLOCK):
            for i in range(first, min(first + _BLOCK, n)):
                for j in range(left, min(left + _BLOCK, i)):
                    P[j, i] = P[i, j]


@kernel
def reordered(P, order):
    """P (n, n) with its rows and columns in an order (k,)."""
    out = np.empty((len(order), len(order)))
    for i in range(len(order)):
        for j in range(len(order)):
            out[i, j] = P[order[i], order[j]]
    return out
