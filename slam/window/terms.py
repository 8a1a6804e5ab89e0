"""How a window's unknowns stand, and what is added to its equations: prior, measurements, what is known of points.

The arrays are those of `slam.window.kernels`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import multiply, row_times, subtract
from slam.kernels.se3 import adjoint, between, compose, log, transform_back
from slam.kernels.stereo import by_pose, residual
from slam.kernels.velocities import add_velocity_rows, velocity_change
from slam.runtime.compilation import helper, kernel
from slam.window.chart_kernels import chart

#: fixed: what a point is to the solver, known exactly or eliminated. Others: its place among the prior's.
KNOWN, ELIMINATED = -2, -1

_BEHIND = 100.0  # numerics: whitened residual of a point that is behind its camera


@kernel
def arranged(poses, free, count, known, members, of_prior, relative, rows, places):
    """Where unknowns of `poses` and of `count` points stand, as `slam.window.problem.Layout` says, and their number.

    `free` (K,) and `known` (N,) are masks, without rows for all and none; `members` are points that are unknowns, in
    their order, those `of_prior` among them; the prior is of as many poses as `relative`. `rows` and `places` name
    their poses and points.
    """
    column, place, of_rows = np.full(poses, -1), np.full(count, ELIMINATED), len(rows[0])
    pose_of, point = np.empty(of_rows + len(places[0]), np.int64), np.empty(of_rows + len(places[0]), np.int64)
    for p in range(len(known)):
        if known[p]:
            place[p] = KNOWN
    for d in range(len(members)):
        place[members[d]] = d
    n, to = 3 * len(members), np.empty(3 * len(of_prior) + 6 * relative, np.int64)
    for i in range(len(to)):
        d = i - 3 * len(of_prior)
        to[i] = n + d if d >= 0 else 3 * place[of_prior[i // 3]] + i % 3
    for k in range(poses):
        if len(free) == 0 or free[k]:
            column[k] = n
            n += 6
    first, order, at = np.zeros(count + 1, np.int64), np.empty(len(point), np.int64), np.empty(count, np.int64)
    for m in range(len(point)):
        part, row = (rows, m) if m < of_rows else (places, m - of_rows)
        pose_of[m], point[m] = part[0][row], part[1][row]
        first[point[m] + 1] += 1
    for p in range(count):
        at[p] = first[p]
        first[p + 1] += first[p]
    for m in range(len(point)):
        order[at[point[m]]] = m
        at[point[m]] += 1
    return column, place, to, pose_of, first, order, n


@helper
def add_prior(poses, points, to, D, prior, whole, H, b):
    """Add the prior ``δᵀ Λ δ − 2 ηᵀ δ``, whose numbers are of the unknowns `to` (m,); poses begin at the unknown D.

    The reference pose changes all of δ, the others and the points only their own. Returns the cost, and δ's derivatives
    A (m, 6) by the reference.
    """
    information, vector, at = prior[5], prior[6], 3 * len(prior[0])
    n = len(vector)
    delta, A = np.empty(n), np.empty((n, 6))
    if n == 0:
        return 0.0, A
    if not _prior_rows(poses, points, prior, delta, A):
        return np.inf, A
    cost, pull, V = 0.0, vector.copy(), np.zeros((6, n))
    for i in range(n):
        subtract(pull, delta[i], information[i])
        for a in range(6 if whole else 0):
            subtract(V[a], -A[i, a], information[i])
    for i in range(n):
        cost -= delta[i] * (pull[i] + vector[i])
        for a in range(6):
            b[D + a] += A[i, a] * pull[i]
        if i < at or i >= at + 6:
            b[to[i]] += pull[i]
    for i in range(n if whole else 0):
        row = to[i]
        if i >= at and i < at + 6:
            for c in range(i - at + 1):
                for j in range(n):
                    H[row, D + c] += A[j, i - at] * V[c, j]
            continue
        for a in range(6):
            H[max(D + a, row), min(D + a, row)] = V[a, i]
        for j in range(i + 1):
            if j < at or j >= at + 6:
                H[max(row, to[j]), min(row, to[j])] = information[i, j]
    return cost, A


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
def add_rows(camera, poses, points, layout, E, rows, places, huber, whole, H, b, information, gradient, cross):
    """Add measurements, then points known relative to a pose: ``root ((α, β, ρ) − origin)`` is unit noise.

    Returns the sum of squares, of what a measurement has beyond `huber` as Huber (1964) counts it.
    """
    (pose, point, z, root), column, place = rows, layout[0], layout[1]
    cost, q, r, D = 0.0, np.empty(3), np.empty(3), np.empty((3, 3))
    s, S, J, Jp = np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for m in range(len(cross)):
        at = m - len(pose)
        k, p = (pose[m], point[m]) if at < 0 else (places[0][at], places[1][at])
        if at >= 0:
            front = chart(poses[k], points[p], places[2][at], places[3][at], q, s, S)
            for i in range(3):
                r[i] = -row_times(places[4][at], i, s)
            multiply(places[4][at], S, D)
        elif root[m, 0, 0] == 0.0:
            continue
        else:
            transform_back(poses[k], points[p], q)
            front = whitened_residual(camera, q, z[m], root[m], r, D)
        if not front:
            robust = at < 0 and place[p] == KNOWN and huber < _BEHIND  # one wrong match shall not stop a good step
            cost += huber * (2.0 * _BEHIND - huber) if robust else _BEHIND * _BEHIND
            continue
        square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        if at < 0 and square > huber * huber:
            scale = np.sqrt(huber / np.sqrt(square))
            for i in range(3):
                r[i] *= scale
                for j in range(3):
                    D[i, j] *= scale
            square = huber * (2.0 * np.sqrt(square) - huber)
        cost += square
        _add_row(poses, column, place, E, k, p, q, r, D, J, Jp, whole, H, b, information, gradient, cross[m])
    return cost


@helper
def sees(z):
    """Whether a row z (3,) has its left pixel."""
    return not (np.isnan(z[0]) or np.isnan(z[1]))


@helper
def whitened_residual(camera, q, z, root, r, D):
    """Residual r (3,) of a point q in the camera and derivatives D (3, 3) of its prediction, times `root` (3, 3).

    What is not measured is zero in both, all where the left pixel is not. Returns whether the point is in front of the
    camera.
    """
    if not residual(camera, q, z, r, D):
        return False
    blind = not sees(z)
    for i in range(2, -1, -1):  # `root` is lower triangular
        if blind or np.isnan(r[i]):
            r[i] = D[i, 0] = D[i, 1] = D[i, 2] = 0.0
            continue
        r[i] *= root[i, i]
        for j in range(3):
            D[i, j] *= root[i, i]
        for k in range(i):
            r[i] += root[i, k] * r[k]
            for j in range(3):
                D[i, j] += root[i, k] * D[k, j]
    return True


@helper
def row_jacobians(T, E, q, D, J, Jp):
    """Derivatives of numbers that change by D (3, 3) with a point q in the camera: J (3, 6) by the camera's pose T.

    And Jp (3, 3) by the coordinates of the chart in which the point has the derivatives E (3, 3).
    """
    for i in range(3):
        by_pose(D[i], q, J[i])
        x, y, z = row_times(T, 0, D[i]), row_times(T, 1, D[i]), row_times(T, 2, D[i])
        for j in range(3):
            Jp[i, j] = x * E[0, j] + y * E[1, j] + z * E[2, j]


@helper
def _add_row(poses, column, place, E, k, p, q, r, D, J, Jp, whole, H, b, information, gradient, cross):
    """Add one row: residual r (3,), predicted numbers that change by D (3, 3) with the point q in the camera."""
    row_jacobians(poses[k], E[p], q, D, J, Jp)
    at, free = column[k], place[p] != KNOWN
    for a in range(3 if free else 0):
        gradient[p, a] += Jp[0, a] * r[0] + Jp[1, a] * r[1] + Jp[2, a] * r[2]
        for c in range(3):
            information[p, a, c] += Jp[0, a] * Jp[0, c] + Jp[1, a] * Jp[1, c] + Jp[2, a] * Jp[2, c]
    for a in range(6 if at >= 0 else 0):
        b[at + a] += J[0, a] * r[0] + J[1, a] * r[1] + J[2, a] * r[2]
        for c in range(a + 1 if whole else 0):
            H[at + a, at + c] += J[0, a] * J[0, c] + J[1, a] * J[1, c] + J[2, a] * J[2, c]
        for c in range(3 if free else 0):
            cross[a, c] = J[0, a] * Jp[0, c] + J[1, a] * Jp[1, c] + J[2, a] * Jp[2, c]


@helper
def add_own_priors(points, place, E, mean, own, information, gradient):
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
def add_motion(poses, column, motion, H, b):
    """Add constant velocity, disturbed: successive velocities differ by noise. Returns the sum of squares.

    The velocity is that of the poses or, where there are `cameras`, of a body that these pass: with Y_k of `poses` and
    X_k of `cameras` (K, 4, 4), T_world_left, the body is at ``B_k = X_k Y_k⁻¹``. The change of its velocity is noise
    with `variance` (V, 6), besides the error of the cameras, whose joint `covariance` (6 K, 6 K) counts in each row by
    itself: errors of successive rows hang together, but little of what they are is the camera's.
    """
    triple, interval, mean, variance, cameras, covariance = motion
    carried, Ad, one = len(cameras) > 0, np.empty((len(cameras), 6, 6)), np.zeros((4, 4))
    frames = np.zeros((len(cameras), 4, 4)) if carried else poses
    back = np.empty((3, 4))
    for i in range(4):
        one[i, i] = 1.0
    for k in range(len(cameras)):
        adjoint(poses[k], Ad[k])
        between(poses[k], one, back)
        compose(cameras[k], back, frames[k])
    cost = 0.0
    r, by_frame, J, S = np.empty(6), np.empty((6, 18)), np.zeros((6, 18)), np.empty((6, 6))
    for m in range(len(triple)):
        i0, i1, i2 = triple[m]
        velocity_change(frames, i0, i1, i2, interval[m, 0], interval[m, 1], r, by_frame)
        for i in range(6):
            r[i] -= mean[m, i]
            for j in range(18):
                J[i, j] = by_frame[i, j]
        if not carried:
            _in_camera_axes(poses[i1], r, J)
        for p in range(3 if carried else 0):  # a perturbation ξ of Y is −Ad_Y ξ of B, one χ of X is Ad_Y χ
            k = max(triple[m, p], 0)
            for i in range(6):
                for j in range(6):
                    total = 0.0
                    for h in range(6):
                        total -= by_frame[i, 6 * p + h] * Ad[k, h, j]
                    J[i, 6 * p + j] = total
        _whiten(J, covariance, triple[m], variance[m], S, r)
        for i in range(6):
            cost += r[i] * r[i]
        add_velocity_rows(J, r, triple[m], column, H, b)
    return cost


@helper
def _in_camera_axes(T, r, J):
    """Turn the last three of r (6,) and J (6, 18) from the world's axes to those of the middle pose T, in place.

    Their noise is the same along all axes. In the world's, a turn of all poses together would change the residuals to
    first order: the normal equations would tell of it, where nothing is known of it.
    """
    v, w = np.empty(3), np.empty(3)
    for j in range(19):
        for i in range(3):
            v[i] = r[3 + i] if j == 18 else J[3 + i, j]
        for i in range(3):
            w[i] = T[0, i] * v[0] + T[1, i] * v[1] + T[2, i] * v[2]
        for i in range(3):
            if j == 18:
                r[3 + i] = w[i]
            else:
                J[3 + i, j] = w[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        J[3 + i, 6 + j] -= r[3 + k]
        J[3 + i, 6 + k] += r[3 + j]


@helper
def _whiten(J, covariance, triple, variance, S, r):
    """J (6, 18) and r (6,) times the inverse Cholesky factor of their noise ``diag(variance) + J P Jᵀ``, in place."""
    for i in range(6):
        for j in range(6):
            S[i, j] = 0.0
        for o in range(3):
            for j in range(6 if triple[o] >= 0 and len(covariance) else 0):
                product = 0.0  # of row i of J and a column of P
                for p in range(3):
                    for h in range(6 if triple[p] >= 0 else 0):
                        product += J[i, 6 * p + h] * covariance[6 * triple[p] + h, 6 * triple[o] + j]
                for k in range(6):
                    S[i, k] += product * J[k, 6 * o + j]
    for i in range(6):
        S[i, i] += variance[i]
    for i in range(6):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = np.sqrt(total) if i == j else total / S[j, j]
        for k in range(i):
            r[i] -= S[i, k] * r[k]
            for j in range(18):
                J[i, j] -= S[i, k] * J[k, j]
        r[i] /= S[i, i]
        for j in range(18):
            J[i, j] /= S[i, i]
