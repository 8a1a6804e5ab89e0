"""Compiled loops over a window's normal equations once they are solved: covariances, and what leaves the window.

The arrays are those of `slam.window.kernels`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, row_times, subtract, turn
from slam.kernels.se3 import point_by_motion, transform_back
from slam.runtime.compilation import helper, kernel
from slam.window.terms import ELIMINATED, KNOWN, row_jacobians, whitened_residual


@kernel
def point_relations(T, points, asked, layout, E, cross, inverse, X, P_poses, newest, skipped):
    """Covariances of points in the coordinates of a pose T (4, 4), and in the world (N, 3, 3) each, of those `asked`.

    T's unknowns begin at `newest`, negative where it is fixed. `X` (x, x) is the last part of ``L⁻¹`` of the normal
    equations' Cholesky factor, without the first `skipped` unknown points, which are not asked for.
    `P_poses` (6 F, 6 F) is the joint covariance of the free poses, `inverse` that of `slam.window.kernels`.
    """
    column, place, basis, _, pose_of, first, order = layout
    prior, mine = 3 * len(basis), 3 * (len(basis) - skipped)
    size, at = len(P_poses), newest - prior
    camera, world = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, 3))
    own, by = np.empty((3, 3)), np.zeros((3, 6))
    blocks = _covariances(X, mine, mine + at if newest >= 0 else -1)
    A, AP = np.zeros((3, size)), np.zeros((3, size))
    q, D, G, M = np.empty(3), np.empty((3, 3)), np.zeros((3, 6)), np.empty((3, 6))
    for p in range(len(points)):
        if not asked[p]:
            continue
        if place[p] >= 0:
            assign(blocks[place[p] - skipped, :, :3], own)
            assign(blocks[place[p] - skipped, :, 3:], by)
        elif place[p] == ELIMINATED and inverse[p, 0, 0] > 0.0:
            for i in range(3):
                for a in range(size):
                    A[i, a] = AP[i, a] = 0.0
            for o in range(first[p], first[p + 1]):
                m = order[o]
                to = column[pose_of[m]] - prior
                for i in range(3 if to >= 0 else 0):
                    for j in range(6):
                        for a in range(3):
                            A[i, to + j] -= inverse[p, i, a] * cross[m, j, a]
            for i in range(3):
                for a in range(size):
                    if A[i, a] != 0.0:
                        for j in range(size):
                            AP[i, j] += A[i, a] * P_poses[a, j]
                for j in range(6 if newest >= 0 else 0):
                    by[i, j] = AP[i, at + j]
            for i in range(3):
                for j in range(3):
                    total = inverse[p, i, j]
                    for a in range(size):
                        total += AP[i, a] * A[j, a]
                    own[i, j] = total
        else:
            continue
        turn(E[p], own, world[p])
        # q = Rᵀ (p − t): δq = Rᵀ E d + hat(q) ω − v
        transform_back(T, points[p], q)
        for i in range(3):
            for j in range(3):
                D[i, j] = T[0, i] * E[p, 0, j] + T[1, i] * E[p, 1, j] + T[2, i] * E[p, 2, j]
        turn(D, own, camera[p])
        if newest < 0:
            continue
        point_by_motion(q, -1.0, G)
        for i in range(3):
            for j in range(6):
                M[i, j] = row_times(D, i, by[:, j])
                for k in range(6):
                    M[i, j] += 0.5 * G[i, k] * P_poses[at + k, at + j]
        for i in range(3):
            for j in range(3):
                for k in range(6):
                    camera[p, i, j] += M[i, k] * G[j, k] + G[i, k] * M[j, k]
    return camera, world


@helper
def _covariances(X, unknown, newest):
    """Covariances (D, 3, 9) of the first D = unknown / 3 points with themselves and with the pose at `newest`."""
    out = np.zeros((unknown // 3, 3, 9))
    for row in range(len(X)):  # ``Xᵀ X``, in the order in which X lies in memory
        for d in range(min(row, unknown - 1) // 3 + 1):
            for i in range(3):
                x = X[row, 3 * d + i]
                for j in range(3):
                    out[d, i, j] += x * X[row, 3 * d + j]
                for j in range(6 if newest >= 0 and row >= newest else 0):
                    out[d, i, 3 + j] += x * X[row, newest + j]
    return out


@kernel
def rig_columns(camera, poses, points, layout, E, rows, field, cross, inverse, B):
    """How ``H x = b`` depends on m errors of the rig, which displace measurements by `field` (M, 3, m), added to B.

    Returns ``inverse gradient`` (N, 3, m) of the points that are eliminated.
    """
    (pose, point, z, root), m = rows, field.shape[2]
    column, place, _, _, pose_of, first, order = layout
    gradient, own = np.zeros((len(points), 3, m)), np.zeros((len(points), 3, m))
    q, r, D, F = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, m))
    J, Jp = np.empty((3, 6)), np.empty((3, 3))
    for row in range(len(pose)):
        T, p, at = poses[pose[row]], point[row], column[pose[row]]
        transform_back(T, points[p], q)
        if root[row, 0, 0] == 0.0 or not whitened_residual(camera, q, z[row], root[row], r, D):
            continue
        row_jacobians(T, E[p], q, D, J, Jp)
        for i in range(3):
            for k in range(m):
                F[i, k] = 0.0
                for j in range(i + 1 if D[i, i % 2] != 0.0 else 0):  # none of what is not measured
                    F[i, k] += root[row, i, j] * field[row, j, k]
        for a in range(6 if at >= 0 else 0):
            for k in range(m):
                B[at + a, k] += J[0, a] * F[0, k] + J[1, a] * F[1, k] + J[2, a] * F[2, k]
        for a in range(3 if place[p] != KNOWN else 0):
            for k in range(m):
                gradient[p, a, k] += Jp[0, a] * F[0, k] + Jp[1, a] * F[1, k] + Jp[2, a] * F[2, k]
    for p in range(len(points)):
        g, its = gradient[p], own[p]
        for i in range(3):
            for k in range(m if place[p] >= 0 else 0):
                B[3 * place[p] + i, k] += g[i, k]
            for k in range(m if place[p] == ELIMINATED else 0):
                its[i, k] = inverse[p, i, 0] * g[0, k] + inverse[p, i, 1] * g[1, k] + inverse[p, i, 2] * g[2, k]
        for o in range(first[p], first[p + 1] if place[p] == ELIMINATED else first[p]):
            at, c = column[pose_of[order[o]]], cross[order[o]]
            for a in range(6 if at >= 0 else 0):
                for k in range(m):
                    B[at + a, k] -= c[a, 0] * its[0, k] + c[a, 1] * its[1, k] + c[a, 2] * its[2, k]
    return own


@kernel
def rig_points(layout, E, cross, inverse, own, X):
    """Derivatives (N, 3, m) of points in the world by errors of the rig, given those of the unknowns X (n, m).

    `own` (N, 3, m) is by `rig_columns`.
    """
    column, place, _, _, pose_of, first, order = layout
    m = X.shape[1]
    out, d = np.zeros((len(place), 3, m)), np.empty((3, m))
    for p in range(len(place)):
        if place[p] != ELIMINATED and place[p] < 0:
            continue
        for i in range(3):
            for k in range(m):
                d[i, k] = X[3 * place[p] + i, k] if place[p] >= 0 else own[p, i, k]
        for o in range(first[p], first[p + 1] if place[p] == ELIMINATED else first[p]):
            at, c = column[pose_of[order[o]]], cross[order[o]]
            for i in range(3 if at >= 0 else 0):
                for a in range(6):
                    gain = inverse[p, i, 0] * c[a, 0] + inverse[p, i, 1] * c[a, 1] + inverse[p, i, 2] * c[a, 2]
                    for k in range(m):
                        d[i, k] -= gain * X[at + a, k]
        for i in range(3):
            for k in range(m):
                out[p, i, k] = E[p, i, 0] * d[0, k] + E[p, i, 1] * d[1, k] + E[p, i, 2] * d[2, k]
    return out


@kernel
def schur_complement(H, b, gone, stay):
    """Marginalise the unknowns `gone` (g,) out of ``H x = b``; the others are `stay` (s,), both ascending.

    Returns ``H_ss − H_sg H_gg⁻¹ H_gs`` (s, s), ``b_s − H_sg H_gg⁻¹ b_g`` (s,), ``H_gg⁻¹ b_g`` (g,) and ``H_gg⁻¹ H_gs``
    (g, s), all symmetric parts whole; NaN where H_gg is not positive definite. By Gauss and Jordan's elimination.
    """
    g, s = len(gone), len(stay)
    M, cross = np.empty((g, g + s)), np.empty((s, g))
    mean, vector, information = np.empty(g), np.empty(s), np.empty((s, s))
    for i in range(g):
        mean[i] = b[gone[i]]
        for j in range(g):
            M[i, j] = H[gone[max(i, j)], gone[min(i, j)]]
        M[i, i] *= 1.0 + 1e-13  # numerics: keeps what nothing measures positive
        for j in range(s):
            M[i, g + j] = cross[j, i] = H[max(gone[i], stay[j]), min(gone[i], stay[j])]
    for k in range(g):
        pivot = M[k, k] if M[k, k] > 0.0 else np.nan
        mean[k] /= pivot
        for j in range(k + 1, g + s):
            M[k, j] /= pivot
        for i in range(g):
            if i != k:
                mean[i] -= M[i, k] * mean[k]
                subtract(M[i, k + 1 :], M[i, k], M[k, k + 1 :])
    gain = M[:, g:].copy()
    taken = np.dot(cross, gain)
    for i in range(s):
        vector[i] = b[stay[i]]
        for k in range(g):
            vector[i] -= cross[i, k] * mean[k]
        for j in range(i + 1):
            information[i, j] = information[j, i] = H[stay[i], stay[j]] - taken[i, j]
    return information, vector, mean, gain
