"""Compiled loops of `slam.calibration.motion`."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, solve_factorised, whitener
from slam.kernels.se3 import exp
from slam.runtime.compilation import helper, kernel


@kernel
def linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, motion, white, residual):
    """`_linearise`, for Python."""
    _linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, motion, white, residual)


@kernel
def fit(
    first, second, points, R, t, focal, noise, median, weights, moved, J_point, J_motion, motion, white, residual
):  # fmt: skip
    """Gauss-Newton of `slam.calibration.motion.fit_motion` on R, t and `points`, all in place.

    Points are weighted as in `slam.calibration.evidence.student_weights`, `median` being that of χ². Returns the last
    change of a predicted point [px], infinite where there is no solution.
    """
    H, step, turn, before, last = np.empty((6, 6)), np.empty(6), np.empty((3, 4)), np.empty((3, 3)), np.inf
    for _ in range(20):  # 20: iterations at most
        _linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, motion, white, residual)
        for n in range(len(first)):
            weights[n] = residual[n, 0] ** 2 + residual[n, 1] ** 2 + residual[n, 2] ** 2
        ordered = np.sort(weights)
        middle = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
        if not np.isfinite(ordered[len(ordered) - 1]):  # NaN is sorted to the end
            return np.inf
        scale = max(middle / median, 0.2 * 0.2)  # no less than a fifth of the configured noise
        for i in range(6):
            step[i] = 0.0
            for j in range(6):
                H[i, j] = 0.0
        for n in range(len(first)):
            weights[n] = 7.0 / (4.0 + weights[n] / scale) / scale
            for k in range(3):
                for i in range(6):
                    share = weights[n] * motion[n, k, i]
                    step[i] += share * residual[n, k]
                    for j in range(i + 1):
                        H[i, j] += share * motion[n, k, j]
        ridge = 1e-12 * (H[0, 0] + H[1, 1] + H[2, 2] + H[3, 3] + H[4, 4] + H[5, 5])
        for i in range(6):
            H[i, i] += ridge
        factorise(H, 6)
        solve_factorised(H, 6, step)
        exp(step, turn)
        for i in range(3):
            t[i] += step[3 + i]
            for j in range(3):
                before[i, j] = R[i, j]
        for i in range(3):
            for j in range(3):
                R[i, j] = turn[i, 0] * before[0, j] + turn[i, 1] * before[1, j] + turn[i, 2] * before[2, j]
        last = _move_points(first, J_point, J_motion, motion, white, residual, noise, step, points)
        if not last >= 1e-3:  # 1e-3: [px]; at 0.02 focal lengths were wrong by percents
            break
    return last if np.isfinite(last) else np.inf


@helper
def _linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, motion, white, residual):
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


@helper
def _move_points(first, J_point, J_motion, motion, white, residual, noise, step, points):
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
