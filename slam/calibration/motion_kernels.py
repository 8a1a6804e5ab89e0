"""Compiled loop of `slam.calibration.motion`."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import invert_symmetric
from slam.runtime.compilation import kernel


@kernel
def linearise(first, second, points, R, t, focal, noise):
    """The fields of `slam.calibration.motion.Linear`; see `slam.calibration.motion.linearised` for the arguments."""
    n = len(points)
    moved, residual = np.empty((n, 3)), np.empty((n, 3))
    J_point, J_motion, information = np.empty((n, 3, 3)), np.empty((n, 3, 6)), np.empty((n, 3, 3))
    by_all, by_depth, B, C = np.empty((3, 9)), np.empty(9), np.empty((3, 3)), np.empty((3, 3))
    for p in range(n):
        x, y, d = points[p, 0], points[p, 1], points[p, 2]
        turned = R[0, 0] * x + R[0, 1] * y + R[0, 2] * focal, R[1, 0] * x + R[1, 1] * y + R[1, 2] * focal
        ahead = R[2, 0] * x + R[2, 1] * y + R[2, 2] * focal
        depth = ahead + d * t[2]
        scale = focal / depth
        moved[p, 0], moved[p, 1] = (turned[0] + d * t[0]) * scale, (turned[1] + d * t[1]) * scale
        moved[p, 2] = d * scale
        # Derivatives of the point before it is scaled, and of its depth, by x, y, d, the rotation and t.
        by_all[:] = 0.0
        by_depth[:] = 0.0
        for i in range(2):
            by_all[i, 0], by_all[i, 1], by_all[i, 2], by_all[i, 6 + i] = R[i, 0], R[i, 1], t[i], d
        by_all[0, 4], by_all[0, 5], by_all[1, 3], by_all[1, 5] = ahead, -turned[1], -ahead, turned[0]
        by_all[2, 2] = 1.0
        by_depth[0], by_depth[1], by_depth[2], by_depth[8] = R[2, 0], R[2, 1], t[2], d
        by_depth[3], by_depth[4] = turned[1], -turned[0]
        for i in range(3):
            for j in range(9):
                change = scale * by_all[i, j] - moved[p, i] / depth * by_depth[j]
                if j < 3:
                    J_point[p, i, j] = change
                else:
                    J_motion[p, i, j - 3] = change
        for i in range(3):
            residual[p, i] = second[p, i] - moved[p, i]
            for j in range(3):
                residual[p, i] -= J_point[p, i, j] * (first[p, j] - points[p, j])
                B[i, j] = 0.0
                for k in range(3):
                    B[i, j] += J_point[p, i, k] * noise[k, j]
        for i in range(3):
            for j in range(i + 1):
                C[i, j] = noise[i, j]
                for k in range(3):
                    C[i, j] += B[i, k] * J_point[p, j, k]
        invert_symmetric(C, 0.0, information[p])
    return moved, J_point, J_motion, residual, information
