"""Compiled loop of `backends.ekf.jacobian`."""

from __future__ import annotations

from slam.runtime.compilation import kernel


@kernel
def times(by_pose, own, X, out):
    """``H X`` into `out` (3M, N) for X (6 + 3M, N), by derivatives (M, 3, 6) by the pose and (M, 3, 3) by landmarks."""
    for i in range(len(own)):
        x, y, z = 6 + 3 * i, 7 + 3 * i, 8 + 3 * i
        for j in range(3):
            row = 3 * i + j
            a, b, c = own[i, j, 0], own[i, j, 1], own[i, j, 2]
            for k in range(X.shape[1]):
                out[row, k] = a * X[x, k] + b * X[y, k] + c * X[z, k]
            a, b, c = by_pose[i, j, 0], by_pose[i, j, 1], by_pose[i, j, 2]
            d, e, f = by_pose[i, j, 3], by_pose[i, j, 4], by_pose[i, j, 5]
            for k in range(X.shape[1]):
                out[row, k] += a * X[0, k] + b * X[1, k] + c * X[2, k] + d * X[3, k] + e * X[4, k] + f * X[5, k]
