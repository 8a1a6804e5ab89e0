"""Compiled passes of a body's estimate: from its motion to where the camera is in it, and back to the body's pose.

Covariances (6, 6) are of [rotation, translation] or [ω, v]; X are poses T_world_left, Y T_body_left.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import row_times, turn
from slam.kernels.se3 import adjoint, between, exp, rotation_vector
from slam.runtime.compilation import helper, kernel


@helper
def _add_product(A, P, out):
    """Add ``A P Aᵀ`` to out (a, a), of A (a, b) and a symmetric P (b, b)."""
    a, b = A.shape
    row = np.empty(b)
    for i in range(a):
        for k in range(b):
            row[k] = 0.0
            for h in range(b):
                row[k] += A[i, h] * P[h, k]
        for j in range(a):
            for k in range(b):
                out[i, j] += row[k] * A[j, k]


@helper
def _of_camera(X, Y, out):
    """The body's pose ``X Y⁻¹`` (4, 4)."""
    for i in range(3):
        out[i, 3] = X[i, 3]
        for j in range(3):
            out[i, j] = row_times(X, i, Y[j])
            out[i, 3] -= out[i, j] * Y[j, 3]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@kernel
def predicted_camera(Y, X, velocity, spread, variance, dt, local):
    """The camera's next pose in a body (4, 4) by the body's velocity (6,), and by the camera's poses X (2, 4, 4).

    And its covariance (6, 6) by the velocity and its impulse, the part of the impulse, and covariances (N, 3, 3) of
    points, `local` in the last camera, in the next one. The impulse has a `variance` (6,).
    """
    T, step, change, R = np.empty((4, 4)), np.zeros(6), np.empty((3, 4)), np.empty((3, 3))
    after, back, A, M = np.eye(4), np.empty((3, 4)), np.empty((6, 6)), np.zeros((6, 6))
    covariance, impulse, V, turned = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), np.empty_like(local)
    _of_camera(X[0], Y, T)
    for i in range(3):
        step[i] = dt * velocity[i]
        T[i, 3] += dt * velocity[3 + i]
        V[i, i], V[3 + i, 3 + i] = variance[i], variance[3 + i]
    exp(step, change)
    for i in range(3):
        for j in range(3):
            R[i, j] = row_times(T.T, j, change[i])
    T[:3, :3] = R
    between(T, X[1], after)
    between(X[1], T, back)
    adjoint(back, A)
    for i in range(6):
        for j in range(6):
            A[i, j] *= dt
        for j in range(3):
            M[i, j], M[i, 3 + j] = row_times(R, j, A[i]), row_times(R, j, A[i, 3:])
    _add_product(A, V, impulse)
    _add_product(M, spread, covariance)
    for i in range(6):
        for j in range(6):
            covariance[i, j] += impulse[i, j]
    for i in range(3):
        for j in range(3):
            R[i, j] = after[0, i] * Y[0, j] + after[1, i] * Y[1, j] + after[2, i] * Y[2, j]
    for n in range(len(local)):
        turn(R, local[n], turned[n])
    return after, covariance, impulse, turned


@kernel
def body_in_world(X, Y, P, dt, velocity, spread):
    """The body's last pose (4, 4) with its covariance, and its velocity (6,) with its covariance.

    By the camera's last poses in the world and in the body (K, 4, 4), one or two `dt` [s] apart, which together have a
    covariance P (6 K, 6 K). Of one alone the velocity is the given one, with its `spread` (6, 6).
    """
    k = len(Y)
    T, A, R, S = np.empty((k, 4, 4)), np.zeros((6 * k, 6 * k)), np.empty((3, 3)), np.zeros((6 * k, 6 * k))
    for i in range(k):
        _of_camera(X[i], Y[i], T[i])
        adjoint(Y[i], A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6])
    _add_product(A, P, S)
    last = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            last[i, j] = S[6 * k - 6 + i, 6 * k - 6 + j]
    if k > 1:
        velocity, spread = np.empty(6), np.zeros((6, 6))
        J, inverse_J = np.zeros((6, 12)), np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                R[i, j] = row_times(T[1], i, T[0, j])
        rotation_vector(R, velocity, inverse_J)
        for i in range(3):
            velocity[i] /= dt
            velocity[3 + i] = (T[1, i, 3] - T[0, i, 3]) / dt
            for j in range(3):
                J[i, 6 + j] = row_times(T[1].T, j, inverse_J[i]) / dt
                J[i, j] = -J[i, 6 + j]
                J[3 + i, 3 + j], J[3 + i, 9 + j] = -T[0, i, j] / dt, T[1, i, j] / dt
        _add_product(J, S, spread)
    return T[k - 1].copy(), last, velocity, spread


@kernel
def way_over_scatter(places, times, weak):
    """Squares of the way that points (K, D, 3) go with even acceleration at `times` (K,), over those of their scatter.

    The larger of the ratios of the first point and of all; `weak` [m²] is added to the scatter.
    """
    n, best, way, scatter = len(times), 0.0, 0.0, 0.0
    basis, mean = np.ones((3, n)), 0.0
    for k in range(n):
        mean += times[k] / n
    for column in range(3):  # 1, t, t², made orthonormal twice, for the digits
        for k in range(n):
            basis[column, k] = (times[k] - mean) ** column
        for _ in range(2):
            for other in range(column):
                _subtract_along(basis[column], basis[other])
            size = np.sqrt(_product(basis[column], basis[column]))
            for k in range(n):
                basis[column, k] /= size
    for end in range(places.shape[1]):
        for axis in range(3):
            offset = places[:, end, axis].copy()
            _subtract_along(offset, basis[0])
            along = _product(offset, basis[1]) ** 2 + _product(offset, basis[2]) ** 2
            way, scatter = way + along, scatter + _product(offset, offset) - along
        if end == 0 or end == places.shape[1] - 1:
            best = max(best, way / (max(scatter, 0.0) + weak))
    return best


@helper
def _product(a, b):
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@helper
def _subtract_along(a, b):
    """Leave of a what is across the unit vector b, in place."""
    along = _product(a, b)
    for k in range(len(a)):
        a[k] -= along * b[k]
