"""What is compiled: landmarks' positions by their coordinates, products with H, and the order of a covariance."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import multiply, row_times, subtract
from slam.runtime.compilation import kernel

_FARTHEST = 1e-6  # numerics: least inverse depth [1/m]
_LEFT = 0.1  # share of its inverse depth that a landmark keeps at least in an update
_ASIDE = 1e3  # guard: largest |x/z|, |y/z|; 89.9 degrees from the axis of the camera that saw it first
_BLOCK = 32  # cost: rows and columns that are mirrored at once


@kernel
def charted(inverse, anchors, c, change):
    """Landmarks after a change (M, 3) of their coordinates c (M, 3), as `backends.ekf.landmarks` describes them.

    Coordinates are of inverse depth, or else Euclidean. Returns them; positions (M, 3); derivatives (M, 3, 3) of these
    by the coordinates; derivatives (M, 3, 6) of the coordinates by a displacement of the world.
    """
    out, points, D, gauge = np.empty_like(c), np.empty_like(c), np.zeros((len(c), 3, 3)), np.zeros((len(c), 3, 6))
    by_local, back, ray = np.zeros((3, 3)), np.zeros((3, 3)), np.empty(3)
    for m in range(len(c)):
        R, y, x = anchors[m], out[m], points[m]
        for i in range(3):
            y[i] = x[i] = c[m, i] + change[m, i]
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
                x[i] = row_times(R, i, ray) + R[i, 3]
                for j in range(3):
                    gauge[m, i, j] = row_times(back, i, R[j])
        for i in range(3):  # D⁻¹ [1, −hat(x)]
            g = gauge[m, i]
            g[3], g[4], g[5] = g[2] * x[1] - g[1] * x[2], g[0] * x[2] - g[2] * x[0], g[1] * x[0] - g[0] * x[1]
    return out, points, D, gauge


@kernel
def H_times(X, at, by_pose, own):
    """``H X`` (3M, k) of X (n, k), where the pose stands first and the coordinates of landmark m at ``at[m]``."""
    out = np.zeros((len(by_pose), X.shape[1]))
    for i in range(len(out)):
        for k in range(6):
            subtract(out[i], -by_pose[i, k], X[k])
        for k in range(3):
            subtract(out[i], -own[i // 3, i % 3, k], X[at[i // 3] + k])
    return out


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
