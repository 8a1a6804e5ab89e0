"""Gauss-Newton of the window, compiled: normal equations with landmarks eliminated, steps back to poses and points.

Poses are ``T_world_left`` with perturbations on the right, [rotation, translation]. A point's perturbation is in a
chart of inverse distance (`slam.window.chart_kernels`). Unknowns stand in the order: points of the prior and those that
join them, free poses.

Arrays that many loops take: `poses` (K, 4, 4) and `points` (N, 3); `layout`, see `slam.window.problem.Layout`; `E`,
derivatives of the points by their charts' coordinates (N, 3, 3); `H` (n, n), lower triangle, and `b` (n,), which are
added to; `information` (N, 3, 3) and `gradient` (N, 3) of each point by its rows; `cross`, what each row or place tells
of pose and point together (M + Q, 6, 3). `knowledge` is that of `slam.window.problem.Window`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import cholesky, invert_symmetric, row_times, square, turn
from slam.kernels.se3 import move, transform_back
from slam.kernels.stereo import residual
from slam.runtime.compilation import helper, kernel
from slam.window.chart_kernels import charts, displace
from slam.window.terms import ELIMINATED, add_motion, add_own_priors, add_prior, add_rows, sees, whitened_residual

_HALVINGS = 8  # numerics: of a step that does not lessen the cost
_NEAR = 50.0  # numerics: a step with a factor of its own is the last at this many times `close`: it leaves the square


@helper
def _equations(camera, poses, points, layout, knowledge, centre, huber, whole, H):
    """The equations at some poses and points; H, which is filled in, is undefined unless `whole`."""
    column, place, basis, to, pose_of = layout[:5]
    rows, places, own, motion, prior = knowledge
    b, information, gradient = np.zeros(len(H)), np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    cross = np.zeros((len(pose_of), 6, 3))
    E = charts(poses, centre, points, place, basis)
    for i in range(len(H)):
        for j in range(i + 1):
            H[i, j] = 0.0
    cost, A = add_prior(poses, points, to, 3 * len(basis), prior, whole, H, b)
    cost += add_rows(camera, poses, points, layout, E, rows, places, huber, whole, H, b, information, gradient, cross)
    if len(own[0]):
        cost += add_own_priors(points, place, E, own[0], own[1], information, gradient)
    cost += add_motion(poses, column, motion, H, b)
    inverse = _eliminate(layout, cross, information, gradient, whole, H, b)
    return b, cost, A, E, inverse, gradient, cross


@helper
def _solve(L, b, gradient, inverse, x):
    """``x = (L Lᵀ)⁻¹ b``. Returns the decrease of the cost that it promises, with that of points that are eliminated.

    L lies in memory by columns.
    """
    n, rest = len(b), 0.0
    for i in range(n):
        x[i] = b[i]
    for j in range(n):
        x[j] /= L[j, j]
        for i in range(j + 1, n):
            x[i] -= L[i, j] * x[j]
    for j in range(n - 1, -1, -1):
        total = x[j]
        for i in range(j + 1, n):
            total -= L[i, j] * x[i]
        x[j] = total / L[j, j]
        rest += x[j] * b[j]
    for p in range(len(gradient)):
        rest += square(inverse[p], gradient[p])
    return rest


@helper
def _stepped(layout, start, x):
    """Poses (K, 4, 4) and points (N, 3) after a step x (n,) of the unknowns; eliminated points follow."""
    column, place, _, _, pose_of, first, order = layout
    poses, points, E, inverse, gradient, cross = start
    new, to = poses.copy(), points.copy()
    for k in range(len(poses)):
        if column[k] >= 0:
            move(new[k], x[column[k] : column[k] + 6])
    d, v = np.empty(3), np.empty(3)
    for p in range(len(points)):
        if place[p] >= 0:
            for i in range(3):
                d[i] = x[3 * place[p] + i]
        elif place[p] == ELIMINATED and inverse[p, 0, 0] > 0.0:
            for i in range(3):
                v[i] = gradient[p, i]
            for o in range(first[p], first[p + 1]):
                m = order[o]
                at = column[pose_of[m]]
                if at >= 0:
                    for i in range(3):
                        for j in range(6):
                            v[i] -= cross[m, j, i] * x[at + j]
            for i in range(3):
                d[i] = inverse[p, i, 0] * v[0] + inverse[p, i, 1] * v[1] + inverse[p, i, 2] * v[2]
        else:
            continue
        displace(points[p], E[p], d, to[p])
    return new, to


@helper
def _eliminate(layout, cross, information, gradient, whole, H, b):
    """Take points into H and b: those of the prior as unknowns, the others eliminated.

    Returns inverses (N, 3, 3) of the information of points that are eliminated.
    """
    column, place, _, _, pose_of, first, order = layout
    inverse, W, v = np.zeros_like(information), np.empty((6, 3)), np.empty(3)
    for p in range(len(place)):
        d = place[p]
        if d >= 0:
            for i in range(3):
                b[3 * d + i] += gradient[p, i]
                for j in range(i + 1 if whole else 0):
                    H[3 * d + i, 3 * d + j] += information[p, i, j]
            for o in range(first[p], first[p + 1] if whole else 0):
                m = order[o]
                at = column[pose_of[m]]
                if at >= 0:
                    for i in range(6):
                        for j in range(3):
                            H[at + i, 3 * d + j] += cross[m, i, j]
        elif d == ELIMINATED:
            # what nothing measures along some direction (depth, of one left pixel) gets next to no information there
            trace = information[p, 0, 0] + information[p, 1, 1] + information[p, 2, 2]
            if trace == 0.0:
                continue
            for i in range(3):
                information[p, i, i] += 1e-12 * trace + 1e-9
            invert_symmetric(information[p], 0.0, inverse[p])
            S = inverse[p]
            for i in range(3):
                v[i] = S[i, 0] * gradient[p, 0] + S[i, 1] * gradient[p, 1] + S[i, 2] * gradient[p, 2]
            for o in range(first[p], first[p + 1]):
                m = order[o]
                at = column[pose_of[m]]
                if at < 0:
                    continue
                for i in range(6):
                    b[at + i] -= cross[m, i, 0] * v[0] + cross[m, i, 1] * v[1] + cross[m, i, 2] * v[2]
                    for j in range(3):
                        W[i, j] = cross[m, i, 0] * S[0, j] + cross[m, i, 1] * S[1, j] + cross[m, i, 2] * S[2, j]
                for o2 in range(first[p], first[p + 1] if whole else 0):
                    m2 = order[o2]
                    to = column[pose_of[m2]]
                    if to < 0 or to > at:
                        continue
                    for i in range(6):
                        for j in range(6 if to < at else i + 1):
                            H[at + i, to + j] -= (
                                W[i, 0] * cross[m2, j, 0] + W[i, 1] * cross[m2, j, 1] + W[i, 2] * cross[m2, j, 2]
                            )
    return inverse


@kernel
def gauss_newton(camera, poses, points, layout, knowledge, centre, n, huber, close, steps, fresh):
    """Gauss-Newton with halved steps on a window's normal equations ``H x = b`` (n,), its points eliminated.

    `camera` (7,) is as in `slam.kernels.stereo`; `layout` ends with `order`. Inverse distances of points that are
    eliminated count from the pose `centre`. A whitened residual beyond `huber` pulls no more than one there. A step
    that lessens the cost by less than `close` is the last; it is taken with the factor of the step before, unless
    each shall have one of its own (`fresh`). `steps` are most with a factor of their own; without any, there is no
    factor at all.

    Returns poses, points, and the cost there, NaN where H is not positive definite or a step not finite; whether it is
    a minimum; the factor L (n, n); H; and of both, where they were linearised: poses, points, E, the inverse
    information (N, 3, 3) and the gradient of points, cross, b, the cost (∞ where a point has left the prior's chart),
    derivatives (m, 6) of the prior's numbers by the first pose.
    """
    H, U, x = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    L = U.T
    whole, minimum, best, halvings, taken = True, False, np.inf, 0, 0
    while True:
        b, cost, A, E, inverse, gradient, cross = _equations(
            camera, poses, points, layout, knowledge, centre, huber, whole, H
        )
        if best == np.inf or cost <= best + 1e-9 * abs(best) + 1e-12:
            start = poses, points, E, inverse, gradient, cross
            if whole:
                linearised, best = (*start, b, cost, A), cost
                if steps == 0:
                    break
            rest = _solve(L, b, gradient, inverse, x) if not whole or cholesky(H, U) else np.nan
            if not np.isfinite(rest):
                cost = np.nan
                break
            minimum = rest < (_NEAR * close if whole else close)
            if not minimum and not whole:
                whole = True
                continue
            if not minimum and taken == steps:
                break
            taken, halvings = taken + 1, 0
        else:
            halvings += 1
            for i in range(n):
                x[i] *= 0.5
            if halvings == _HALVINGS:
                poses, points, cost = linearised[0], linearised[1], best
                break
        poses, points = _stepped(layout, start, x)
        if minimum:
            cost -= rest
            break
        whole = fresh
    return poses, points, cost, minimum, L, H, linearised


@kernel
def row_distances(camera, poses, points, rows):
    """Square of each whitened residual (M,), ∞ for a row that does not count, without a left pixel, or behind."""
    pose, point, z, root = rows
    out, q, r, D = np.empty(len(pose)), np.empty(3), np.empty(3), np.empty((3, 3))
    for m in range(len(pose)):
        transform_back(poses[pose[m]], points[point[m]], q)
        front = whitened_residual(camera, q, z[m], root[m], r, D)
        out[m] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] if front and sees(z[m]) and root[m, 0, 0] != 0.0 else np.inf
    return out


@kernel
def left_out_distances(camera, T, points, z, covariances, sigma, least, T_then, points_then):
    """Squared distance (M,) of each row from what all others predict for it, at the solution, with 3 or 2 numbers.

    With r the residual, ``rᵀ (σ² 1 − J C Jᵀ)⁻¹ r``, C the point's covariance (3, 3) in the newest camera T, in which
    the row itself takes part, and J as linearised for C, at `T_then` and `points_then`: elsewhere the difference need
    not be positive. ∞ without a left pixel or where the point is not in front of the camera; 0 where a residual has
    less than the share `least` of the row's noise.
    """
    out, q, r, D = np.empty(len(points)), np.empty(3), np.empty(3), np.empty((3, 3))
    S, inverse, r_then = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for m in range(len(points)):
        transform_back(T, points[m], q)
        front = residual(camera, q, z[m], r, D)
        transform_back(T_then, points_then[m], q)
        if not (residual(camera, q, z[m], r_then, D) and front and sees(z[m])):
            out[m] = np.inf
            continue
        if np.isnan(r[2]):
            r[2] = D[2, 0] = D[2, 1] = D[2, 2] = 0.0
        turn(D, covariances[m], S)
        for i in range(3):
            for j in range(3):
                S[i, j] = (sigma * sigma if i == j else 0.0) - S[i, j]
        for i in range(3):  # a row that alone fixes its point has no residual
            S[i, i] += 1e-6 * sigma * sigma
        invert_symmetric(S, 0.0, inverse)
        total = 0.0
        for i in range(3):
            total += r[i] * row_times(inverse, i, r)
        tested = min(S[0, 0], S[1, 1], S[2, 2]) >= least * sigma * sigma
        out[m] = 0.0 if not tested else total if total >= 0.0 else np.inf
    return out
