"""Compiled loops of `slam.calibration.model` and `slam.calibration.pairs`.

Columns of the model are its parameters, `LENS` twice and `POSE`, and a turn.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, factorise, invert_symmetric, median, row_times, solve_factorised, square
from slam.kernels.se3 import exp
from slam.runtime.compilation import helper, kernel


@helper
def _field_at(x, y, d, focal, out):
    """Change [px] of a point ``(x, y, d)`` and of its vertical disparity [focal lengths]: `out` (4, n + 3)."""
    right = x - d
    for side in range(2):
        u, sign = (right, -focal) if side else (x, focal)
        r2, both = u * u + y * y, 2 * u * y
        along = 1.0, 0.0, u, 0.0, u * r2, u * r2 * r2, both, r2 + 2 * u * u
        across = 0.0, 1.0, y, y, y * r2, y * r2 * r2, r2 + 2 * y * y, both
        for i in range(8):
            out[2, 8 * side + i], out[3, 8 * side + i] = sign * along[i], -sign * across[i]
            if side == 0:
                out[0, i], out[1, i] = focal * along[i], focal * across[i]
    d_by_pose = right * y, -1 - right * right, y, 0.0, d * right
    vertical_by_pose = -1 - y * y, right * y, right, d, -d * y
    for i in range(5):
        out[2, 16 + i], out[3, 16 + i] = focal * d_by_pose[i], focal * vertical_by_pose[i]
    turn = (-x * y, 1 + x * x, -y), (-1 - y * y, x * y, x), (-d * y, d * x, 0.0)
    for i in range(3):
        for j in range(3):
            out[i, 21 + j] = focal * turn[i][j]


@kernel
def field(points, focal):
    """Change (N, 4, n + 3) [px] of points ``(x, y, d)`` (N, 3) [px] and of their vertical disparities."""
    out = np.zeros((len(points), 4, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, out[p])
    return out


@kernel
def shift(points, focal, amounts):
    """Change (N, 4) [px] of points (N, 3) [px] and of their vertical disparities by amounts (n + 3,) of the columns."""
    out, columns = np.zeros((len(points), 4)), np.zeros((4, 24))
    for p in range(len(points)):
        _field_at(points[p, 0] / focal, points[p, 1] / focal, points[p, 2] / focal, focal, columns)
        for i in range(4):
            for j in range(24):
                out[p, i] += columns[i, j] * amounts[j]
    return out


@kernel
def residual_field(points, focal, centre, half, degrees):
    """Change (N, 4, m) [px] of points (N, 3) [px] and of their vertical disparities by the residual fields.

    The image has its `centre` and half sizes in focal lengths; `degrees` are the polynomials' in x and y.
    """
    k = (degrees[0] + 1) * (degrees[1] + 1) - 3
    out, values = np.zeros((len(points), 4, 4 * k)), np.ones((3, max(degrees) + 1))
    for p in range(len(points)):
        at = points[p, 0], points[p, 1], points[p, 0] - points[p, 2]  # of the left image, and x of the right one
        for line in range(3):
            x = (at[line] / focal - centre[line % 2]) / half[line % 2]
            x = 1.1 if x > 1.1 else -1.1 if x < -1.1 else x  # 1.1: beyond so many half widths they are constant
            values[line, 1] = x  # NaN stays NaN
            for i in range(2, len(values[0])):
                values[line, i] = ((2 * i - 1) * x * values[line, i - 1] - (i - 1) * values[line, i - 2]) / i
        c = 0
        for i in range(degrees[0] + 1):
            for j in range(degrees[1] + 1):
                if i + j > 1:  # with a mean square of one over the image
                    value = focal * np.sqrt((2 * i + 1) * (2 * j + 1)) * values[1, j]
                    left, right = value * values[0, i], value * values[2, i]
                    out[p, 0, c], out[p, 1, c + k], out[p, 2, c], out[p, 3, c + k] = left, left, left, -left
                    out[p, 2, c + 2 * k], out[p, 3, c + 3 * k] = -right, right
                    c += 1
    return out


@kernel
def fit(first, second, R, t, focal, noise, typical, steps):
    """Gauss-Newton of `slam.calibration.pairs.fit_motion`, of some steps at most; see there for the arguments.

    Without any, the problem is linearised at the first guess. Points are weighted by Student's t distribution of four
    degrees of freedom, `typical` being the median of χ². Returns what `slam.calibration.pairs.Fit` has, and the last
    change of a predicted point [px], infinite where there is no solution.
    """
    n, last = len(first), np.inf
    R, t, points, weights = R.copy(), t.copy(), first.copy(), np.empty(len(first))
    at = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 6)), np.empty((n, 3)), np.empty((n, 3, 3))
    residual, information = at[3:]
    step, turn, before = np.empty(6), np.empty((3, 4)), np.empty((3, 3))
    for _ in range(max(steps, 1)):
        _linearise(first, second, points, R, t, focal, noise, *at)
        if steps == 0:
            break
        for p in range(n):
            weights[p] = square(information[p], residual[p])
        if n == 0 or not np.isfinite(weights.sum()):
            last = np.inf
            break
        # 0.2: no less than a fifth of the configured noise
        scale = max(median(weights.copy()) / typical, 0.2 * 0.2)
        for p in range(n):
            weights[p] = 7.0 / (4.0 + weights[p] / scale) / scale
        _solve(*at[2:], weights, step)
        exp(step, turn)
        assign(R, before)
        for i in range(3):
            t[i] += step[3 + i]
            for j in range(3):
                R[i, j] = row_times(before.T, j, turn[i])
        last = _correct(first, *at[1:], step, noise, points)
        if not last >= 1e-3:  # 1e-3: [px]; at 0.02 focal lengths were wrong by percents
            break
    return (R, t, points, *at, weights), last


@helper
def _solve(J_motion, residual, information, weights, step):
    """The step (6,) of the motion that solves the weighted normal equations."""
    H, weighted, ridge = np.zeros((6, 6)), np.empty(3), 0.0
    step[:] = 0.0
    for p in range(len(weights)):
        for i in range(6):
            for k in range(3):
                weighted[k] = weights[p] * row_times(information[p].T, k, J_motion[p, :, i])
            step[i] += weighted[0] * residual[p, 0] + weighted[1] * residual[p, 1] + weighted[2] * residual[p, 2]
            for j in range(i + 1):
                H[i, j] += row_times(J_motion[p].T, j, weighted)
    for i in range(6):
        ridge += H[i, i]
    for i in range(6):
        H[i, i] += 1e-12 * ridge
    factorise(H, 6)
    solve_factorised(H, 6, step)


@helper
def _correct(first, J_point, J_motion, residual, information, step, noise, points):
    """Estimate the first view's points anew after a step; the largest change of a predicted one [px], NaN counts."""
    last, rest, weighted = 0.0, np.empty(3), np.empty(3)
    for p in range(len(points)):
        for i in range(3):
            change = 0.0
            for k in range(6):
                change += J_motion[p, i, k] * step[k]
            rest[i] = residual[p, i] - change
            last = last if abs(change) <= last else abs(change)
        for i in range(3):
            weighted[i] = row_times(information[p], i, rest)
        for i in range(3):
            rest[i] = row_times(J_point[p].T, i, weighted)
        for i in range(3):
            points[p, i] = first[p, i] + row_times(noise.T, i, rest)
    return last


@helper
def _linearise(first, second, points, R, t, focal, noise, moved, J_point, J_motion, residual, information):
    """Fill in what `slam.calibration.pairs.Fit` has, at a motion and estimates of the first view's points."""
    by_all, by_depth, B, C = np.empty((3, 9)), np.empty(9), np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(points)):
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
