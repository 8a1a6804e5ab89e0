"""Compiled loops over a body's points: on which correction of its pose they agree, and how little is known of them."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel

_NEAREST = 1e-9  # numerics: no distance below this [m] is divided by


@kernel
def agreed_correction(y, information, seen, J, axes, shift, P, known, sigma, least, limit, fewest):
    """The correction [θ, τ] (6,) of a body's predicted pose on which its points agree, in the body's axes.

    A Kalman update whose measurements are the points that stereo gives; those beyond the limit are left out, one after
    the other.

    Args:
        y: points of the body (K, 3), in its coordinates.
        information: of these (K, 3, 3).
        seen: where stereo sees them (K, 3), in camera coordinates.
        J: derivatives of the pixels by these (K, 3, 3).
        axes: rotation (3, 3) from camera to body axes, by the predicted pose, and
        shift: the camera's place in the body (3,).
        P: covariance of the predicted pose (6, 6), body axes.
        known: its inverse.
        sigma: pixel noise [px].
        least: information that is added to that of every point.
        limit: χ²(3) up to which a point agrees.
        fewest: points that must agree.

    Returns:
        the correction, which points agree (K,), and whether enough do.
    """
    count = len(y)
    gaps, weight, D = np.empty((count, 3)), np.empty((count, 3, 3)), np.zeros((count, 3, 6))
    agrees = np.empty(count, np.bool_)
    noise, spread, own, B, DP = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 6))
    for k in range(count):
        for i in range(3):
            gaps[k, i] = shift[i] - y[k, i]
            for j in range(3):
                gaps[k, i] += axes[i, j] * seen[k, j]
                own[i, j] = information[k, i, j] + (least if i == j else 0.0)
        _derivatives(y[k], D[k])
        _invert_symmetric(own, noise)
        _invert(J[k], own)
        for i in range(3):
            for j in range(3):
                B[i, j] = sigma * (axes[i, 0] * own[0, j] + axes[i, 1] * own[1, j] + axes[i, 2] * own[2, j])
            for j in range(6):
                DP[i, j] = 0.0
                for h in range(6):
                    DP[i, j] += D[k, i, h] * P[h, j]
        for i in range(3):
            for j in range(3):
                noise[i, j] += B[i, 0] * B[j, 0] + B[i, 1] * B[j, 1] + B[i, 2] * B[j, 2]
                spread[i, j] = noise[i, j]
                for h in range(6):
                    spread[i, j] += DP[i, h] * D[k, j, h]
        _invert_symmetric(noise, weight[k])
        _invert_symmetric(spread, own)
        agrees[k] = _square(own, gaps[k]) < limit
    change, gap = np.zeros(6), np.empty(3)
    while agrees.sum() >= fewest:
        _solve(known, D, weight, gaps, agrees, change)
        worst, most = 0, -1.0
        for k in range(count):
            if not agrees[k]:
                continue
            for i in range(3):
                gap[i] = gaps[k, i]
                for h in range(6):
                    gap[i] -= D[k, i, h] * change[h]
            square = _square(weight[k], gap)
            if not square <= most:
                worst, most = k, square
        if most < limit:
            return change, agrees, True
        agrees[worst] = False
    return change, agrees, False


@kernel
def drift_roots(points, first, now, turned, density):
    """The angles (p,) and roots (p, 3, 3) of `slam.objects.points.drift`, which has the arguments, too.

    A point that is nowhere (NaN) keeps its angle, and its root is zero.
    """
    angles, roots = turned.copy(), np.zeros((len(points), 3, 3))
    sight, before = np.empty(3), np.empty(3)
    for p in range(len(points)):
        for i in range(3):
            sight[i], before[i] = now[i] - points[p, i], first[p, i] - points[p, i]
        (a, b, c), (x, y, z) = before, sight
        u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
        angle = np.arctan2(np.sqrt(u * u + v * v + w * w), a * x + b * y + c * z)
        if not angle > turned[p]:
            continue
        distance = max(np.sqrt(x * x + y * y + z * z), _NEAREST)
        scale = density * np.sqrt(angle - turned[p]) * distance
        angles[p] = angle
        for i in range(3):
            for j in range(3):
                roots[p, i, j] = scale * ((1.0 if i == j else 0.0) - sight[i] * sight[j] / (distance * distance))
    return angles, roots


@helper
def _derivatives(y, out):
    """Derivatives (3, 6) of a point y (3,) of a body, in the predicted body's axes, by [θ, τ]; `out` is zero before."""
    out[0, 1], out[0, 2], out[1, 2] = y[2], -y[1], y[0]
    out[1, 0], out[2, 0], out[2, 1] = -y[2], y[1], -y[0]
    out[0, 3] = out[1, 4] = out[2, 5] = 1.0


@helper
def _square(M, v):
    """``vᵀ M v``."""
    square = 0.0
    for i in range(3):
        square += v[i] * (M[i, 0] * v[0] + M[i, 1] * v[1] + M[i, 2] * v[2])
    return square


@helper
def _invert(M, out):
    """Inverse of a matrix (3, 3)."""
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        for i in range(3):
            c, d = (i + 1) % 3, (i + 2) % 3
            out[i, j] = M[a, c] * M[b, d] - M[a, d] * M[b, c]
    determinant = M[0, 0] * out[0, 0] + M[0, 1] * out[1, 0] + M[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] /= determinant


@helper
def _invert_symmetric(M, out):
    """Inverse of a symmetric positive definite matrix (3, 3), by M = L D Lᵀ."""
    d0 = M[0, 0]
    l10, l20 = M[1, 0] / d0, M[2, 0] / d0
    d1 = M[1, 1] - l10 * M[1, 0]
    rest = M[2, 1] - l20 * M[1, 0]
    l21 = rest / d1
    d2 = M[2, 2] - l20 * M[2, 0] - l21 * rest
    m20 = l10 * l21 - l20  # of the inverse of L
    out[0, 0] = 1 / d0 + l10 * l10 / d1 + m20 * m20 / d2
    out[1, 0] = out[0, 1] = -l10 / d1 - m20 * l21 / d2
    out[2, 0] = out[0, 2] = m20 / d2
    out[1, 1] = 1 / d1 + l21 * l21 / d2
    out[2, 1] = out[1, 2] = -l21 / d2
    out[2, 2] = 1 / d2


@helper
def _solve(known, D, weight, gaps, agrees, out):
    """The correction (6,) by the points that agree: the normal equations, solved by their L D Lᵀ."""
    H, WD = known.copy(), np.empty((3, 6))
    out[:] = 0.0
    for k in range(len(gaps)):
        if not agrees[k]:
            continue
        for i in range(3):
            for h in range(6):
                WD[i, h] = weight[k, i, 0] * D[k, 0, h] + weight[k, i, 1] * D[k, 1, h] + weight[k, i, 2] * D[k, 2, h]
        for h in range(6):
            out[h] += WD[0, h] * gaps[k, 0] + WD[1, h] * gaps[k, 1] + WD[2, h] * gaps[k, 2]
            for j in range(h + 1):
                H[h, j] += D[k, 0, h] * WD[0, j] + D[k, 1, h] * WD[1, j] + D[k, 2, h] * WD[2, j]
    for i in range(6):
        for j in range(i + 1):
            for h in range(j):
                H[i, j] -= H[i, h] * H[j, h] * H[h, h]
            if j < i:
                H[i, j] /= H[j, j]
                out[i] -= H[i, j] * out[j]
    for i in range(5, -1, -1):
        out[i] /= H[i, i]
        for h in range(i + 1, 6):
            out[i] -= H[h, i] * out[h]
