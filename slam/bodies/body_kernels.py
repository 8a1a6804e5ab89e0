"""Compiled passes of bodies over the table of tracks: what tracks say of one, and where its members are.

Windows of tracks are as in `slam.bodies.track_kernels`.
"""

from __future__ import annotations

import numpy as np

from slam.bodies.track_kernels import LEAST, PART, RIDGE, add, add_times
from slam.kernels.linear import invert_symmetric, row_times, square, trace, turn
from slam.kernels.se3 import point_by_motion, transform, transform_back
from slam.runtime.compilation import helper, kernel


@helper
def _mean(points, A, mean):
    """Mean of a window's points (W, 3), weighted by their information (W, 3, 3)."""
    total, P, told = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3)
    for w in range(len(points)):
        add(total, A[w], 1.0)
        add_times(told, A[w], points[w], 1.0)
    invert_symmetric(total, PART * trace(total) + LEAST, P)
    for i in range(3):
        mean[i] = row_times(P, i, told)


@helper
def _window_in_body(A, p, anchor, T, there, point, turned):
    """One measurement's point (3,) and information (3, 3), none where it is not `there`, in a body's axes T."""
    away = p[0] + anchor[0] - T[0, 3], p[1] + anchor[1] - T[1, 3], p[2] + anchor[2] - T[2, 3]
    for i in range(3):
        point[i] = row_times(T.T, i, away)
    if there:
        turn(T.T, A, turned)
    else:
        turned[:] = 0.0


@kernel
def windows_in_body(A, p, dof, anchor, rows, history, known):
    """What tracks measured, in the coordinates of a body with poses `history` (W, 4, 4) at the slots `known` (W,).

    Points (M, W, 3), their information (M, W, 3, 3), and whether there is any (M, W).
    """
    size = A.shape[1]
    points, turned = np.empty((len(rows), size, 3)), np.empty((len(rows), size, 3, 3))
    there = np.empty((len(rows), size), np.bool_)
    for m in range(len(rows)):
        n = rows[m]
        for w in range(size):
            there[m, w] = known[w] and dof[n, w] > 0
            _window_in_body(A[n, w], p[n, w], anchor[n], history[w], there[m, w], points[m, w], turned[m, w])
    return points, turned, there


@kernel
def weighted_means(points, A):
    """Means (M, 3) of points by slot (M, W, 3), weighted by their information (M, W, 3, 3)."""
    means = np.empty((len(points), 3))
    for m in range(len(points)):
        _mean(points[m], A[m], means[m])
    return means


@kernel
def membership_squares(A, p, dof, anchor, rows, history, known):
    """χ² (M, 2) of "one fixed point" in a body with poses `history` (W, 4, 4) and in the world, over its slots.

    These are the slots `known` (W,). And how many of them, and how many numbers in them, were measured (M, 2).
    """
    out, counts, size = np.zeros((len(rows), 2)), np.zeros((len(rows), 2), np.int64), A.shape[1]
    points, turned, mean = np.empty((2, size, 3)), np.empty((2, size, 3, 3)), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        for w in range(size):
            there = known[w] and dof[n, w] > 0
            _window_in_body(A[n, w], p[n, w], anchor[n], history[w], there, points[0, w], turned[0, w])
            for i in range(3):
                points[1, w, i] = p[n, w, i]
                for j in range(3):
                    turned[1, w, i, j] = A[n, w, i, j] if there else 0.0
            if there:
                counts[m, 0] += 1
                counts[m, 1] += dof[n, w]
        for k in range(2):
            _mean(points[k], turned[k], mean)
            for w in range(size):
                q = points[k, w]
                out[m, k] += square(turned[k, w], (q[0] - mean[0], q[1] - mean[1], q[2] - mean[2]))
    return out, counts


@kernel
def place_members(T, P, local, information, rows, least, position, covariance):
    """Positions and covariances in the world, in place, of tracks at `local` (N, 3) in a body at T, its covariance P.

    Their points have `information` (N, 3, 3) in its axes, and `least` more.
    """
    spread, J, v = np.empty((3, 3)), np.empty((3, 6)), np.empty(6)
    for m in range(len(rows)):
        n = rows[m]
        transform(T, local[n], position[n])
        invert_symmetric(information[n], least, spread)
        point_by_motion(local[n], 1.0, J)
        for i in range(3):
            for k in range(6):
                v[k] = row_times(P, k, J[i]) + P[k, 3 + i]
            for j in range(3):
                spread[i, j] += row_times(J, j, v) + v[3 + j]
        turn(T, spread, covariance[n])


@kernel
def improve_members(T, A, p, anchor, rows, slot, local, information):
    """Take the measurements of a slot into the points of a body at T and their information (N, 3, 3), in place."""
    turned, P, gap, told = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        _window_in_body(A[n, slot], p[n, slot], anchor[n], T, True, gap, turned)
        add(information[n], turned, 1.0)
        invert_symmetric(information[n], RIDGE * trace(information[n]), P)
        for i in range(3):
            gap[i] -= local[n, i]
        for i in range(3):
            told[i] = row_times(turned, i, gap)
        for i in range(3):
            local[n, i] += row_times(P, i, told)


@kernel
def distances_from_box(T, lower, upper, position, covariance, rows):
    """Squared distances (M,), in their own noise, of tracks from the box between two corners in a body's axes T."""
    out, local, away, gap, P = np.empty(len(rows)), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    for m in range(len(rows)):
        transform_back(T, position[rows[m]], local)
        for i in range(3):
            away[i] = local[i] - min(max(local[i], lower[i]), upper[i])
        for i in range(3):
            gap[i] = row_times(T, i, away)
        invert_symmetric(covariance[rows[m]], RIDGE * trace(covariance[rows[m]]) + LEAST, P)
        out[m] = square(P, gap)
    return out
