"""Compiled loops of the window: normal equations with landmarks eliminated, steps back to poses and points.

Poses are ``T_world_left`` with perturbations on the right, [rotation, translation]. A point's perturbation is in a
chart of inverse distance (`slam.window.chart_kernels`). Unknowns stand in the order: points of the prior, free poses.

Arrays that many loops take: `poses` (K, 4, 4) and `column`, their first unknowns (K,), −1 for a fixed one; `points`
(N, 3) and `place`, what each is to the solver (N,), see `KNOWN`; `E`, their derivatives by their charts' coordinates
(N, 3, 3); `pose` and `point`, what each row is of (M,); `first` and `order`, rows by point, see `by_point`; `H` (n, n),
lower triangle, and `b` (n,), which are added to; `information` (N, 3, 3) and `gradient` (N, 3) of each point by its
rows; `cross`, what each row tells of pose and point together (M, 6, 3).
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import invert_symmetric, row_times, turn
from slam.kernels.se3 import adjoint, between, log, move, transform_back
from slam.kernels.stereo import by_pose, residual
from slam.kernels.velocities import add_velocity_rows, velocity_change
from slam.runtime.compilation import helper, kernel
from slam.window.chart_kernels import chart, displace

#: What a point is to the solver: known exactly, or eliminated. Others (0, 1, ...) are its place among the prior's.
KNOWN, ELIMINATED = -2, -1

_BEHIND = 1e4  # numerics: squared whitened residual of a point that is behind its camera


@kernel
def linearise(camera, poses, column, points, place, E, pose, point, z, weight, whole, H, b):
    """Add the rows' normal equations: their squared whitened residuals (M,), information, gradient and cross.

    `camera` (7,) is as in `slam.kernels.stereo`; `z` is (uL, vL, uR) (M, 3), NaN where missing,
    and `weight` 1 / σ (M,), zero for a row that does not count. Unless
    `whole`, H is left as it is.
    """
    count, rows = len(points), len(pose)
    information, gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    cross, squares = np.zeros((rows, 6, 3)), np.zeros(rows)
    q, r, D, J, Jp = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for m in range(rows):
        w = weight[m]
        if w == 0.0:
            continue
        transform_back(poses[pose[m]], points[point[m]], q)
        if not residual(camera, q, z[m], r, D):
            squares[m] = _BEHIND
            continue
        for i in range(3):
            if np.isnan(r[i]):
                r[i] = 0.0
                for j in range(3):
                    D[i, j] = 0.0
            r[i] *= w
            squares[m] += r[i] * r[i]
            for j in range(3):
                D[i, j] *= w
        _add_row(
            poses, column, place, E, pose[m], point[m], q, r, D, J, Jp, whole, H, b, information, gradient, cross[m]
        )  # fmt: skip
    return squares, information, gradient, cross


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


@kernel
def place_rows(
    poses, column, points, place, E, pose, point, basis, origin, root, whole, H, b, information, gradient
):  # fmt: skip
    """Add points known relative to a pose: ``root ((α, β, ρ) − origin)`` of each is unit noise. See `linearise`.

    `basis` (Q, 3, 3) is each row's chart in the pose's axes, `origin` (Q, 3) where the point stood in it, and `root`
    (Q, 3, 3) the square root of its information. Returns the sum of squares, and cross (Q, 6, 3).
    """
    cross, cost = np.zeros((len(pose), 6, 3)), 0.0
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
    return cost, cross


@kernel
def own_priors(points, place, E, mean, own, information, gradient):
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


@kernel
def eliminate(column, place, pose, cross, first, order, information, gradient, whole, H, b):
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
                at = column[pose[m]]
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
                at = column[pose[m]]
                if at < 0:
                    continue
                for i in range(6):
                    b[at + i] -= cross[m, i, 0] * v[0] + cross[m, i, 1] * v[1] + cross[m, i, 2] * v[2]
                    for j in range(3):
                        W[i, j] = cross[m, i, 0] * S[0, j] + cross[m, i, 1] * S[1, j] + cross[m, i, 2] * S[2, j]
                for o2 in range(first[p], first[p + 1] if whole else 0):
                    m2 = order[o2]
                    to = column[pose[m2]]
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
def prior_rows(poses, points, members, T, relative, basis, origin, pose_of, delta, A):
    """Where unknowns stand relative to the prior's: δ (n,), and its derivative A (n, 6) by the reference pose.

    Both are overwritten, points first. `members` are the prior's points (D,), `basis` (D, 3, 3) and `origin` (D, 3)
    their charts in the reference pose's axes and where they stood in them; `T` (4, 4) is where that pose stood,
    `relative` (P, 4, 4) where the poses `pose_of` (P,) stood before it, itself the first. Returns False where a point
    has left the half space of its chart.
    """
    q, s, D, J = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    M, N, Ad = np.empty((3, 4)), np.empty((3, 4)), np.empty((6, 6))
    now, at = poses[pose_of[0]], 3 * len(members)
    for d in range(len(members)):
        if not chart(now, points[members[d]], basis[d], origin[d], q, s, D):
            return False
        for i in range(3):
            delta[3 * d + i] = s[i]
            by_pose(D[i], q, A[3 * d + i])
    for p in range(len(pose_of)):
        if p == 0:
            between(T, now, M)
        else:
            between(poses[pose_of[p]], now, N)
            adjoint(N, Ad)
            between(now, poses[pose_of[p]], N)
            between(relative[p], N, M)
        log(M, q, J, delta[at : at + 6])
        for i in range(6):
            for j in range(6):
                A[at + i, j] = (1.0 if i == j else 0.0) if p == 0 else -Ad[i, j]
        at += 6
    return True


@kernel
def motion_rows(poses, column, triple, interval, weight, H, b):
    """Add constant velocity, disturbed: successive velocities differ by noise. Returns the sum of squares.

    `triple` (V, 3) are three successive poses, −1 first where the first velocity itself is noise; `interval` (V, 2) the
    times between them [s], `weight` (V, 6) 1 / σ of the change of [ω, v].
    """
    cost = 0.0
    J, r = np.empty((6, 18)), np.empty(6)
    for m in range(len(triple)):
        i0, i1, i2 = triple[m]
        d0, d1 = interval[m]
        velocity_change(poses, i0, i1, i2, d0, d1, r, J)
        for i in range(6):
            r[i] *= weight[m, i]
            cost += r[i] * r[i]
            for j in range(18):
                J[i, j] *= weight[m, i]
        add_velocity_rows(J, r, triple[m], column, H, b)
    return cost


@kernel
def step(poses, column, points, place, E, pose, cross, first, order, inverse, gradient, x):
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
                at = column[pose[m]]
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
    not be positive. ∞ where the point is not in front of the camera, or where a residual has less than the share
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
        out[m] = total if tested and total >= 0.0 else np.inf
    return out
