"""Compiled loops over a body's points: on which correction of its pose they agree."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import factorise, invert, invert_symmetric, row_times, solve_factorised, square
from slam.kernels.se3 import point_by_motion
from slam.runtime.compilation import helper, kernel


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
            gaps[k, i] = shift[i] - y[k, i] + row_times(axes, i, seen[k])
            for j in range(3):
                own[i, j] = information[k, i, j] + (least if i == j else 0.0)
        point_by_motion(y[k], 1.0, D[k])
        invert_symmetric(own, 0.0, noise)
        invert(J[k], own)
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
        invert_symmetric(noise, 0.0, weight[k])
        invert_symmetric(spread, 0.0, own)
        agrees[k] = square(own, gaps[k]) < limit
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
            distance = square(weight[k], gap)
            if not distance <= most:
                worst, most = k, distance
        if most < limit:
            return change, agrees, True
        agrees[worst] = False
    return change, agrees, False


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
    factorise(H, 6)
    solve_factorised(H, 6, out)
