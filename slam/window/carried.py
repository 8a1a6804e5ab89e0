"""The motion of the camera, and of a body that is carried past a camera that is known: constant velocity, disturbed."""

from __future__ import annotations

import numpy as np

from slam.kernels.se3 import adjoint, between
from slam.kernels.velocities import add_velocity_rows, velocity_change
from slam.runtime.compilation import helper


@helper
def add_motion(poses, column, motion, H, b):
    """Add constant velocity, disturbed: successive velocities differ by noise. Returns the sum of squares."""
    triple, interval, weight = motion
    cost, J, r = 0.0, np.empty((6, 18)), np.empty(6)
    for m in range(len(triple)):
        i0, i1, i2 = triple[m]
        velocity_change(poses, i0, i1, i2, interval[m, 0], interval[m, 1], r, J)
        for i in range(6):
            r[i] *= weight[m, i]
            cost += r[i] * r[i]
            for j in range(18):
                J[i, j] *= weight[m, i]
        add_velocity_rows(J, r, triple[m], column, H, b)
    return cost


@helper
def add_carried(poses, column, carried, H, b):
    """Add constant velocity of a body, disturbed, whose window's poses are those of a camera in the body.

    With Y_k of `poses` (K, 4, 4) and X_k of `cameras` (K, 4, 4), T_world_left, the body is at ``B_k = X_k Y_k⁻¹``. The
    change of its velocity is noise with `variance` (V, 6), besides the error of the cameras, whose joint `covariance`
    (6 K, 6 K) counts in each row by itself: errors of successive rows hang together, but little of what they are is
    the camera's. Arrays are those of `slam.window.problem.Carried`. Returns the sum of squares.
    """
    cameras, covariance, triple, interval, mean, variance = carried
    count = len(poses)
    bodies, Ad = np.zeros((count, 4, 4)), np.empty((count, 6, 6))
    back, one = np.empty((3, 4)), np.zeros((4, 4))
    for i in range(4):
        one[i, i] = 1.0
    for k in range(count):
        adjoint(poses[k], Ad[k])
        between(poses[k], one, back)
        for i in range(3):
            for j in range(4):
                total = cameras[k, i, 3] if j == 3 else 0.0
                for h in range(3):
                    total += cameras[k, i, h] * back[h, j]
                bodies[k, i, j] = total
    cost = 0.0
    r, by_body, J, S = np.empty(6), np.empty((6, 18)), np.zeros((6, 18)), np.empty((6, 6))
    for m in range(len(triple)):
        i0, i1, i2 = triple[m]
        velocity_change(bodies, i0, i1, i2, interval[m, 0], interval[m, 1], r, by_body)
        for i in range(6):
            r[i] -= mean[m, i]
        for p in range(3):  # a perturbation ξ of Y is −Ad_Y ξ of B, one χ of X is Ad_Y χ
            k = max(triple[m, p], 0)
            for i in range(6):
                for j in range(6):
                    total = 0.0
                    for h in range(6):
                        total -= by_body[i, 6 * p + h] * Ad[k, h, j]
                    J[i, 6 * p + j] = total
        _whiten(J, covariance, triple[m], variance[m], S, r)
        for i in range(6):
            cost += r[i] * r[i]
        add_velocity_rows(J, r, triple[m], column, H, b)
    return cost


@helper
def _whiten(J, covariance, triple, variance, S, r):
    """J (6, 18) and r (6,) times the inverse Cholesky factor of their noise ``diag(variance) + J P Jᵀ``, in place."""
    for i in range(6):
        for j in range(6):
            S[i, j] = 0.0
        for o in range(3):
            for j in range(6 if triple[o] >= 0 else 0):
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
