"""What is added to a window's normal equations: the prior, measurements, and what else is known of points.

The arrays are those of `slam.window.kernels`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import row_times
from slam.kernels.se3 import adjoint, between, log, transform_back
from slam.kernels.stereo import by_pose, residual
from slam.runtime.compilation import helper
from slam.window.chart_kernels import chart

#: What a point is to the solver: known exactly, or eliminated. Others (0, 1, ...) are its place among the prior's.
KNOWN, ELIMINATED = -2, -1

_BEHIND = 1e4  # numerics: squared whitened residual of a point that is behind its camera


@helper
def add_prior(poses, points, D, prior, whole, H, b):
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
def add_rows(camera, poses, column, points, place, E, rows, huber, whole, H, b, information, gradient, cross):
    """Add measurements. Returns the sum of squares, of what is beyond `huber` as Huber (1964) counts it."""
    pose, point, z, root = rows
    cost, q, r, D = 0.0, np.empty(3), np.empty(3), np.empty((3, 3))
    J, Jp = np.empty((3, 6)), np.empty((3, 3))
    for m in range(len(pose)):
        if root[m, 0, 0] == 0.0:
            continue
        transform_back(poses[pose[m]], points[point[m]], q)
        if not whitened_residual(camera, q, z[m], root[m], r, D):
            cost += _BEHIND
            continue
        square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        if square > huber * huber:
            size = np.sqrt(square)
            scale = np.sqrt(huber / size)
            for i in range(3):
                r[i] *= scale
                for j in range(3):
                    D[i, j] *= scale
            square = huber * (2.0 * size - huber)
        cost += square
        _add_row(
            poses, column, place, E, pose[m], point[m], q, r, D, J, Jp, whole, H, b, information, gradient, cross[m]
        )  # fmt: skip
    return cost


@helper
def whitened_residual(camera, q, z, root, r, D):
    """Residual r (3,) of a point q in the camera and derivatives D (3, 3) of its prediction, times `root` (3, 3).

    What is not measured is zero in both. Returns whether the point is in front of the camera.
    """
    if not residual(camera, q, z, r, D):
        return False
    for i in range(2, -1, -1):  # `root` is lower triangular
        if np.isnan(r[i]):
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
def add_places(poses, column, points, place, E, places, whole, H, b, information, gradient, cross):
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
