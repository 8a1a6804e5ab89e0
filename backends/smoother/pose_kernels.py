"""Compiled loops of `backends.smoother.pose_only`: residuals of one pose, and Gauss-Newton on them."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel

NEAREST = 1e-6  # numerics: no depth below this [m] is projected
_SMALL = 1e-5  # numerics: below this angle [rad] series are exact to double precision
_SMALL_CUBIC = 1e-2  # numerics: the same where a difference of third order is taken


@helper
def _residual(camera, R_left, point, z, T, r, J):
    """Measured less predicted r (3,), NaN where missing or behind, and derivatives J (3, 6) of the prediction by T."""
    f, u0, v0, baseline = camera[0], camera[1], camera[2], camera[3]
    x, y, depth = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
    a = T[0, 0] * x + T[1, 0] * y + T[2, 0] * depth
    b = T[0, 1] * x + T[1, 1] * y + T[2, 1] * depth
    c = T[0, 2] * x + T[1, 2] * y + T[2, 2] * depth
    q = R_left[2, 0] * a + R_left[2, 1] * b + R_left[2, 2] * c
    if not q >= NEAREST:
        for i in range(3):
            r[i] = np.nan
            for k in range(6):
                J[i, k] = 0.0
        return
    w = 1 / q
    scale = f * w
    left = scale * (R_left[0, 0] * a + R_left[0, 1] * b + R_left[0, 2] * c)
    row = scale * (R_left[1, 0] * a + R_left[1, 1] * b + R_left[1, 2] * c)
    right = left - scale * baseline
    r[0], r[1], r[2] = z[0] - u0 - left, z[1] - v0 - row, z[2] - u0 - right
    for k in range(3):
        J[0, 3 + k] = left * w * R_left[2, k] - scale * R_left[0, k]
        J[1, 3 + k] = row * w * R_left[2, k] - scale * R_left[1, k]
        J[2, 3 + k] = right * w * R_left[2, k] - scale * R_left[0, k]
    for k in range(3):
        J[k, 0] = J[k, 5] * b - J[k, 4] * c
        J[k, 1] = J[k, 3] * c - J[k, 5] * a
        J[k, 2] = J[k, 4] * a - J[k, 3] * b


@helper
def _move(T, step):
    """``T ← T exp(step)``."""
    t2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    t = np.sqrt(t2)
    a, b, c = 1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120 + t2 * t2 / 5040
    if t >= _SMALL:
        a, b = np.sin(t) / t, 2 * np.sin(0.5 * t) ** 2 / t2
    if t >= _SMALL_CUBIC:
        c = (t - np.sin(t)) / (t * t2)
    exp, out = np.zeros((3, 4)), np.empty((3, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        exp[i, i] = 1 + b * (step[i] * step[i] - t2)
        exp[i, j] = b * step[i] * step[j] - a * step[k]
        exp[i, k] = b * step[i] * step[k] + a * step[j]
        exp[i, 3] = (1 + c * (step[i] * step[i] - t2)) * step[3 + i]
        exp[i, 3] += (c * step[i] * step[j] - b * step[k]) * step[3 + j]
        exp[i, 3] += (c * step[i] * step[k] + b * step[j]) * step[3 + k]
    for i in range(3):
        for j in range(4):
            out[i, j] = T[i, 0] * exp[0, j] + T[i, 1] * exp[1, j] + T[i, 2] * exp[2, j]
        out[i, 3] += T[i, 3]
    for i in range(3):
        for j in range(4):
            T[i, j] = out[i, j]


@kernel
def moved(poses, steps):
    """Poses (n, 4, 4) changed on the right by tangent vectors (n, 6)."""
    out = poses.copy()
    for i in range(len(out)):
        _move(out[i], steps[i])
    return out


@kernel
def residuals(camera, R_left, points, z, T):
    """Measured less predicted (M, 3), NaN where missing or behind, and the prediction's Jacobians (M, 3, 6) by T.

    Args:
        camera: f, u0, v0, baseline (4,) of the rectified rig.
        R_left: rotation (3, 3) from left-camera to rectified coordinates.
        points: in world coordinates (M, 3).
        z: measurements (M, 3).
        T: pose T_world_left (4, 4).
    """
    r, J = np.empty((len(points), 3)), np.empty((len(points), 3, 6))
    for m in range(len(points)):
        _residual(camera, R_left, points[m], z[m], T, r[m], J[m])
    return r, J


@kernel
def gauss_newton(camera, R_left, points, z, whitener, used, information, prior, start, huber, steps, enough):
    """The pose (4, 4) by at most `steps` steps of Gauss-Newton from `start`.

    Args:
        camera: f, u0, v0, baseline (4,) of the rectified rig.
        R_left: rotation (3, 3) from left-camera to rectified coordinates.
        points: in world coordinates (M, 3).
        z: measurements (M, 3), NaN where missing.
        whitener: of the residuals (M, 3, 3).
        used: which measurements count (M,).
        information: of the prior (6, 6).
        prior: the start beside the prior's mean (6,).
        start: pose (4, 4).
        huber: whitened residual from which on a measurement's pull no longer grows; ∞ for least squares.
        steps: at most so many.
        enough: steps that are smaller are the last [rad, m].
    """
    T, off = start.copy(), prior.copy()
    r, J, white, G = np.empty(3), np.empty((3, 6)), np.empty(3), np.empty((3, 6))
    H, step = np.empty((6, 6)), np.empty(6)
    for _ in range(steps):
        for i in range(6):
            step[i] = 0.0
            for j in range(6):
                H[i, j] = information[i, j]
                step[i] -= information[i, j] * off[j]
        for m in range(len(points)):
            if used[m]:
                _residual(camera, R_left, points[m], z[m], T, r, J)
                _whiten(whitener, m, r, J, white, G)
                size = np.sqrt(white[0] * white[0] + white[1] * white[1] + white[2] * white[2])
                weight = 1.0 if size <= huber else huber / size
                for i in range(6):
                    step[i] += weight * (G[0, i] * white[0] + G[1, i] * white[1] + G[2, i] * white[2])
                    for j in range(i + 1):
                        H[i, j] += weight * (G[0, i] * G[0, j] + G[1, i] * G[1, j] + G[2, i] * G[2, j])
        _solve(H, step)
        _move(T, step)
        largest = 0.0
        for i in range(6):
            off[i] += step[i]  # exact to first order: enough for a prior that only keeps few measurements in bounds
            largest = max(largest, abs(step[i]))
        if largest < enough:
            break
    return T


@helper
def _whiten(whitener, m, r, J, white, G):
    """Residual and derivatives of measurement m times its whitener; components that are missing count for nothing."""
    for i in range(3):
        white[i] = 0.0
        for j in range(6):
            G[i, j] = 0.0
        for k in range(3):
            if not np.isnan(r[k]):
                white[i] += whitener[m, i, k] * r[k]
                for j in range(6):
                    G[i, j] += whitener[m, i, k] * J[k, j]


@helper
def _solve(M, v):
    """``M⁻¹ v`` into v (6,) by M = L D Lᵀ, which overwrites the lower triangle of M (6, 6).

    As in `slam.geometry.pnp_kernels`: kernels of two files share no helper, as the cache of one file's kernels does not
    notice that the other file has changed.
    """
    for i in range(6):
        for j in range(i + 1):
            for h in range(j):
                M[i, j] -= M[i, h] * M[j, h] * M[h, h]
            if j < i:
                M[i, j] /= M[j, j]
                v[i] -= M[i, j] * v[j]
    for i in range(5, -1, -1):
        v[i] /= M[i, i]
        for h in range(i + 1, 6):
            v[i] -= M[h, i] * v[h]
