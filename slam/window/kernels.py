"""Compiled loops of the window: normal equations with landmarks eliminated, steps back to poses and points.

Poses are ``T_world_left`` with perturbations on the right, [rotation, translation]. A point's perturbation is in a
chart of inverse distance (`slam.window.chart_kernels`). Unknowns stand in the order: points of the prior, points that
join them, free poses.

Arrays that many loops take: `poses` (K, 4, 4) and `column`, their first unknowns (K,), −1 for a fixed one; `points`
(N, 3) and `place`, what each is to the solver (N,), see `KNOWN`; `E`, their derivatives by their charts' coordinates
(N, 3, 3); `pose_of`, the poses of all rows, then of all places; `first` and `order`, these by point, see `by_point`;
`H` (n, n), lower triangle, and `b` (n,), which are added to; `information` (N, 3, 3) and `gradient` (N, 3) of each
point by its rows; `cross`, what each row or place tells of pose and point together (M + Q, 6, 3). `rows`, `places`,
`motion`, `carried` and `prior` are tuples of the arrays of the classes of that name in `slam.window.problem`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import invert_symmetric, row_times, turn
from slam.kernels.se3 import adjoint, between, log, move, transform_back
from slam.kernels.stereo import by_pose, residual
from slam.runtime.compilation import helper, kernel
from slam.window.carried import add_carried, add_motion
from slam.window.chart_kernels import chart, charts, displace

#: What a point is to the solver: known exactly, or eliminated. Others (0, 1, ...) are its place among the prior's.
KNOWN, ELIMINATED = -2, -1

_BEHIND = 1e4  # numerics: squared whitened residual of a point that is behind its camera


@kernel
def normal_equations(
    camera, poses, column, points, place, basis, centre, rows, places, own, motion, carried, prior, pose_of, first,
    order, whole, n,
):  # fmt: skip
    """The normal equations ``H x = b`` (n,) of a window.

    `camera` (7,) is as in `slam.kernels.stereo`; `basis` (D + J, 3, 3) are charts of the points that are unknowns, in
    the first pose's axes; inverse distances of all others count from the pose `centre`; `own` are independent means
    (N, 3) and information (N, 3, 3) of points in world coordinates, or of none. Unless `whole`, H is left undefined.

    Returns H; b; the sum of squares, ∞ where a point has left the prior's chart; E; the inverse information (N, 3, 3)
    and the gradient of points; cross; derivatives (m, 6) of the prior's numbers by the first pose.
    """
    H, b = np.zeros((n, n)) if whole else np.empty((n, n)), np.zeros(n)
    E = charts(poses, centre, points, place, basis)
    information, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    cross = np.zeros((len(pose_of), 6, 3))
    cost, A = _add_prior(poses, points, 3 * len(basis), prior, whole, H, b)
    cost += _add_rows(camera, poses, column, points, place, E, rows, whole, H, b, information, gradient, cross)
    cost += _add_places(
        poses, column, points, place, E, places, whole, H, b, information, gradient, cross[len(rows[0]) :]
    )
    if len(own[0]):
        cost += _add_own_priors(points, place, E, own[0], own[1], information, gradient)
    cost += add_motion(poses, column, motion, H, b)
    if len(carried[2]):
        cost += add_carried(poses, column, carried, H, b)
    inverse = _eliminate(column, place, pose_of, cross, first, order, information, gradient, whole, H, b)
    return H, b, cost, E, inverse, gradient, cross, A


@helper
def _add_prior(poses, points, D, prior, whole, H, b):
    """Add the prior ``δᵀ Λ δ − 2 ηᵀ δ``; poses begin at the unknown D. Returns its value, and δ's derivatives A (m, 6).

    The reference pose changes all of δ, the others and the points only their own.
    """
    members, information, vector = prior[0], prior[5], prior[6]
    n, mine = len(vector), 3 * len(members)
    shift = D - mine  # of the poses, behind points that join
    delta, A = np.empty(n), np.empty((n, 6))
    if n == 0:
        return 0.0, A
    if not _prior_rows(poses, points, prior, delta, A):
        return np.inf, A
    cost, pull, V = 0.0, vector.copy(), np.zeros((6, n))
    for i in range(n):
        _subtract(pull, information[i], delta[i])
        for a in range(6 if whole else 0):
            _subtract(V[a], information[i], -A[i, a])
    for i in range(n):
        cost -= delta[i] * (pull[i] + vector[i])
        for a in range(6):
            b[D + a] += A[i, a] * pull[i]
        if i < mine or i >= mine + 6:
            b[i + (shift if i >= mine else 0)] += pull[i]
    for i in range(n if whole else 0):
        row = i + (shift if i >= mine else 0)
        if i < mine:
            for a in range(6):
                H[D + a, row] = V[a, i]
        elif i >= mine + 6:
            for a in range(6):
                H[row, D + a] = V[a, i]
        else:
            continue
        for j in range(min(mine, i + 1)):
            H[row, j] = information[i, j]
        for j in range(mine + 6, i + 1):
            H[row, j + shift] = information[i, j]
    for a in range(6 if whole else 0):
        for c in range(a + 1):
            total = 0.0
            for i in range(n):
                total += A[i, a] * V[c, i]
            H[D + a, D + c] = total
    return cost, A


@helper
def _subtract(v, row, x):
    """``v − x row``, in place."""
    for j in range(len(v)):
        v[j] -= x * row[j]


@helper
def _prior_rows(poses, points, prior, delta, A):
    """Where unknowns stand relative to the prior's: δ (m,), and its derivative A (m, 6) by the first pose.

    Returns False where a point has left the half space of its chart.
    """
    members, basis, origin, T, relative = prior[:5]
    q, s, D, J = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    M, N, Ad = np.empty((3, 4)), np.empty((3, 4)), np.empty((6, 6))
    now, at = poses[0], 3 * len(members)
    for d in range(len(members)):
        if not chart(now, points[members[d]], basis[d], origin[d], q, s, D):
            return False
        for i in range(3):
            delta[3 * d + i] = s[i]
            by_pose(D[i], q, A[3 * d + i])
    for p in range(len(relative)):
        if p == 0:
            between(T, now, M)
        else:
            between(poses[p], now, N)
            adjoint(N, Ad)
            between(now, poses[p], N)
            between(relative[p], N, M)
        log(M, q, J, delta[at : at + 6])
        for i in range(6):
            for j in range(6):
                A[at + i, j] = (1.0 if i == j else 0.0) if p == 0 else -Ad[i, j]
        at += 6
    return True


@helper
def _add_rows(camera, poses, column, points, place, E, rows, whole, H, b, information, gradient, cross):
    """Add measurements. Returns the sum of squares."""
    pose, point, z, weight = rows
    cost, q, r, D = 0.0, np.empty(3), np.empty(3), np.empty((3, 3))
    J, Jp = np.empty((3, 6)), np.empty((3, 3))
    for m in range(len(pose)):
        w = weight[m]
        if w == 0.0:
            continue
        transform_back(poses[pose[m]], points[point[m]], q)
        if not residual(camera, q, z[m], r, D):
            cost += _BEHIND
            continue
        for i in range(3):
            if np.isnan(r[i]):
                r[i] = 0.0
                for j in range(3):
                    D[i, j] = 0.0
            r[i] *= w
            cost += r[i] * r[i]
            for j in range(3):
                D[i, j] *= w
        _add_row(
            poses, column, place, E, pose[m], point[m], q, r, D, J, Jp, whole, H, b, information, gradient, cross[m]
        )  # fmt: skip
    return cost


@helper
def _add_row(poses, column, place, E, k, p, q, r, D, J, Jp, whole, H, b, information, gradient, cross):
    """Add one row: residual r (3,), predicted numbers that change by D (3, 3) with the point q in the camera."""
    T = poses[k]
    free = place[p] != KNOWN
    if free:
        for i in range(3):
            x, y, z = row_times(T, 0, D[i]), row_times(T, 1, D[i]), row_times(T, 2, D[i])
            for j in range(3):
                Jp[i, j] = x * E[p, 0, j] + y * E[p, 1, j] + z * E[p, 2, j]
        for a in range(3):
            gradient[p, a] += Jp[0, a] * r[0] + Jp[1, a] * r[1] + Jp[2, a] * r[2]
            for c in range(3):
                information[p, a, c] += Jp[0, a] * Jp[0, c] + Jp[1, a] * Jp[1, c] + Jp[2, a] * Jp[2, c]
    at = column[k]
    if at < 0:
        return
    for i in range(3):
        by_pose(D[i], q, J[i])
    for a in range(6):
        b[at + a] += J[0, a] * r[0] + J[1, a] * r[1] + J[2, a] * r[2]
        for c in range(a + 1 if whole else 0):
            H[at + a, at + c] += J[0, a] * J[0, c] + J[1, a] * J[1, c] + J[2, a] * J[2, c]
        if free:
            for c in range(3):
                cross[a, c] = J[0, a] * Jp[0, c] + J[1, a] * Jp[1, c] + J[2, a] * Jp[2, c]


@helper
def _add_places(poses, column, points, place, E, places, whole, H, b, information, gradient, cross):
    """Add points known relative to a pose: ``root ((α, β, ρ) − origin)`` is unit noise. Returns the sum of squares."""
    pose, point, basis, origin, root = places
    cost = 0.0
    q, s, D, W = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    J, Jp, r = np.empty((3, 6)), np.empty((3, 3)), np.empty(3)
    for m in range(len(pose)):
        if not chart(poses[pose[m]], points[point[m]], basis[m], origin[m], q, s, D):
            cost += _BEHIND
            continue
        for i in range(3):
            r[i] = -row_times(root[m], i, s)
            cost += r[i] * r[i]
            for j in range(3):
                W[i, j] = root[m, i, 0] * D[0, j] + root[m, i, 1] * D[1, j] + root[m, i, 2] * D[2, j]
        _add_row(
            poses, column, place, E, pose[m], point[m], q, r, W, J, Jp, whole, H, b, information, gradient, cross[m]
        )  # fmt: skip
    return cost


@helper
def _add_own_priors(points, place, E, mean, own, information, gradient):
    """Add independent priors of points in world coordinates: mean (N, 3), information (N, 3, 3). Returns their cost."""
    cost, d, v = 0.0, np.empty(3), np.empty(3)
    for p in range(len(points)):
        if own[p, 0, 0] == 0.0 or place[p] == KNOWN:
            continue
        for i in range(3):
            d[i] = mean[p, i] - points[p, i]
        for i in range(3):
            v[i] = own[p, i, 0] * d[0] + own[p, i, 1] * d[1] + own[p, i, 2] * d[2]
            cost += v[i] * d[i]
        for a in range(3):
            gradient[p, a] += E[p, 0, a] * v[0] + E[p, 1, a] * v[1] + E[p, 2, a] * v[2]
            for c in range(3):
                for i in range(3):
                    for j in range(3):
                        information[p, a, c] += E[p, i, a] * own[p, i, j] * E[p, j, c]
    return cost


@helper
def _eliminate(column, place, pose_of, cross, first, order, information, gradient, whole, H, b):
    """Take points into H and b: those of the prior as unknowns, the others eliminated.

    Returns inverses (N, 3, 3) of the information of points that are eliminated.
    """
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
                        for j in range(6):
                            H[at + i, to + j] -= (
                                W[i, 0] * cross[m2, j, 0] + W[i, 1] * cross[m2, j, 1] + W[i, 2] * cross[m2, j, 2]
                            )
    return inverse


@kernel
def by_point(point, count):
    """Rows by point: those of point p are ``order[first[p]:first[p + 1]]``."""
    first, order = np.zeros(count + 1, np.int64), np.empty(len(point), np.int64)
    for m in range(len(point)):
        first[point[m] + 1] += 1
    for p in range(count):
        first[p + 1] += first[p]
    at = np.empty(count, np.int64)
    for p in range(count):
        at[p] = first[p]
    for m in range(len(point)):
        order[at[point[m]]] = m
        at[point[m]] += 1
    return first, order


@kernel
def step(poses, column, points, place, E, pose_of, cross, first, order, inverse, gradient, x):
    """Poses (K, 4, 4) and points (N, 3) after a step x (n,) of the unknowns; eliminated points follow."""
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


@kernel
def left_out_distances(camera, T, points, z, covariances, sigma, least, T_then, points_then):
    """Squared distance (M,) of each row from what all others predict for it, at the solution, with 3 or 2 numbers.

    With r the residual, ``rᵀ (σ² 1 − J C Jᵀ)⁻¹ r``, C the point's covariance (3, 3) in the newest camera T, in which
    the row itself takes part, and J as linearised for C, at `T_then` and `points_then`: elsewhere the difference need
    not be positive. ∞ where the point is not in front of the camera; 0 where a residual has less than the share
    `least` of the row's noise.
    """
    out, q, r, D = np.empty(len(points)), np.empty(3), np.empty(3), np.empty((3, 3))
    S, inverse, r_then = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for m in range(len(points)):
        transform_back(T, points[m], q)
        front = residual(camera, q, z[m], r, D)
        transform_back(T_then, points_then[m], q)
        if not (residual(camera, q, z[m], r_then, D) and front):
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
