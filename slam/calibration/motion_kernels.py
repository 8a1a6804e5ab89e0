"""Compiled loops of `slam.calibration.motion`."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import whitener
from slam.runtime.compilation import kernel


@kernel
def linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, motion, white, residual):
    """Moved points, their Jacobians, and the second view's residuals whitened by their noise.

    NaN where the covariance of a residual is not positive definite. See `slam.calibration.motion.Linear` for the
    arguments from `moved` on, which are filled in.
    """
    C, B, W = np.zeros((3, 9)), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):  # slices take seconds to compile
        C[i, 0], C[i, 1], C[i, 2] = R[i, 0], R[i, 1], t[i]
    r = np.empty(3)
    for n in range(len(points)):
        x, y, d = points[n, 0], points[n, 1], points[n, 2]
        # Columns 3 to 8 of C: -hat of the turned point, and d times the unit matrix.
        a0 = R[0, 0] * x + R[0, 1] * y + R[0, 2] * focal
        a1 = R[1, 0] * x + R[1, 1] * y + R[1, 2] * focal
        a2 = R[2, 0] * x + R[2, 1] * y + R[2, 2] * focal
        C[0, 4], C[0, 5], C[1, 3], C[1, 5], C[2, 3], C[2, 4] = a2, -a1, -a2, a0, a1, -a0
        C[0, 6] = C[1, 7] = C[2, 8] = d
        depth = a2 + d * t[2]
        scale = focal / depth
        moved[n, 0], moved[n, 1], moved[n, 2] = (a0 + d * t[0]) * scale, (a1 + d * t[1]) * scale, d * scale
        for i in range(3):
            along, share = scale if i < 2 else 0.0, moved[n, i] / depth
            for j in range(3):
                J_point[n, i, j] = along * C[i, j] - share * C[2, j]
            for j in range(6):
                J_motion[n, i, j] = along * C[i, 3 + j] - share * C[2, 3 + j]
        J_point[n, 2, 2] += scale
        for i in range(3):
            r[i] = second[n, i] - moved[n, i]
            for j in range(3):
                r[i] -= J_point[n, i, j] * (first[n, j] - points[n, j])
                B[i, j] = 0.0
                for k in range(3):
                    B[i, j] += J_point[n, i, k] * noise[k, j]
        for i in range(3):  # the covariance, its lower triangle
            for j in range(i + 1):
                W[i, j] = noise[i, j]
                for k in range(3):
                    W[i, j] += B[i, k] * J_point[n, j, k]
        whitener(W, white[n])
        for i in range(3):
            residual[n, i] = 0.0
            for j in range(i + 1):
                residual[n, i] += white[n, i, j] * r[j]
            for k in range(6):
                motion[n, i, k] = 0.0
                for j in range(i + 1):
                    motion[n, i, k] += white[n, i, j] * J_motion[n, j, k]


@kernel
def move_points(first, J_point, J_motion, motion, white, residual, noise, step, points):
    """The first view's points after a step (6,) of the motion, into `points` (N, 3); returns how far they move [px].

    That is the largest change of a coordinate of a point in the second view. For the other arguments see
    `slam.calibration.motion.Linear`.
    """
    left, back = np.zeros(3), np.zeros(3)
    last = 0.0
    for n in range(len(first)):
        for j in range(3):
            left[j] = back[j] = 0.0
        for i in range(3):
            change, r = 0.0, residual[n, i]
            for k in range(6):
                change += J_motion[n, i, k] * step[k]
                r -= motion[n, i, k] * step[k]
            last = max(last, abs(change))
            for j in range(i + 1):
                left[j] += white[n, i, j] * r
        for i in range(3):
            for j in range(3):
                back[j] += J_point[n, i, j] * left[i]
        for j in range(3):
            points[n, j] = first[n, j]
            for k in range(3):
                points[n, j] += back[k] * noise[k, j]
    return last
