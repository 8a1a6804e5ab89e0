"""Compiled loops of the smoother: over landmarks and the poses that measured them, and over three poses in motion."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, invert_symmetric, trace
from slam.kernels.se3 import transform_back
from slam.kernels.stereo import by_point, residual
from slam.kernels.velocities import velocity_change
from slam.runtime.compilation import helper, kernel

_GAIN, _STEPS = 0.01, 10  # numerics: a landmark is refined until a step would lessen its sum of squares by less
_DAMPING = 0.01  # numerics: the first that is tried where a plain step fails, as a share of the information
_BEHIND = 1e4  # numerics: sum of squares of a measurement whose landmark lies behind the camera
_FREE = 1e-12  # numerics: share of an information that is added to keep the inverse finite: far points leave depth free


@helper
def add_information(camera, T, z, point, weight, H, g, work):
    """Add what a measurement z (3,) from a pose T (4, 4) says of a point (3,) to information H (3, 3), gradient g (3,).

    Returns its sum of squares, or `_BEHIND` where the point lies behind the camera: it says nothing else then. `camera`
    is as in `slam.kernels.stereo`; `weight` is one over the variance of a pixel; `work` (6, 3) is overwritten.
    """
    local, r, d, J = work[0], work[1], work[2], work[3:]
    transform_back(T, point, local)
    if not residual(camera, local, z, r, J):
        return _BEHIND
    squares = 0.0
    for c in range(3):  # uL, vL, uR
        if np.isfinite(r[c]):
            squares += weight * r[c] * r[c]
            by_point(J[c], T, d)
            for i in range(3):
                g[i] += weight * r[c] * d[i]
                for j in range(3):
                    H[i, j] += weight * d[i] * d[j]
    return squares


@kernel
def refine(camera, poses, frames, z, sigma, mean, information, points, own):
    """Move points (M, 3) to where their measurements put them, given poses (F, 4, 4), and fill in their covariances.

    Each by Levenberg-Marquardt for itself: a plain step from a distant start may end behind the camera. A landmark
    without measurements stays as it is.

    Args:
        camera: see `add_information`.
        poses: T_world_left.
        frames: poses that measured each (M, K), negative for none.
        z: the measurements (M, K, 3) [px].
        sigma: noise of a pixel [px].
        mean: what is known of each besides (M, 3),
        information: and how well (M, 3, 3) [1/m²].
        points: changed in place.
        own: covariances (M, 3, 3) [m²] where all poses are known, changed in place.
    """
    weight = 1 / (sigma * sigma)
    H, g, A, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    H_there, g_there, x, step = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    work = np.empty((6, 3))
    for m in range(len(points)):
        if frames[m].max() < 0:
            continue
        damping, cost = 0.0, np.inf
        for i in range(3):
            x[i] = points[m, i]
        for iteration in range(_STEPS + 1):
            there = 0.0
            for i in range(3):
                g_there[i] = 0.0
                for j in range(3):
                    H_there[i, j] = information[m, i, j]
                    g_there[i] += information[m, i, j] * (mean[m, j] - x[j])
                there += g_there[i] * (mean[m, i] - x[i])
            for k in range(frames.shape[1]):
                if frames[m, k] >= 0:
                    there += add_information(camera, poses[frames[m, k]], z[m, k], x, weight, H_there, g_there, work)
            if there < cost or not iteration:
                cost, damping = there, 0.1 * damping
                assign(H_there, H)
                for i in range(3):
                    points[m, i], g[i] = x[i], g_there[i]
            else:
                damping = max(10 * damping, _DAMPING)
            assign(H, A)
            for i in range(3):
                A[i, i] *= 1 + damping
            invert_symmetric(A, _FREE * (1 + trace(A)), inverse)
            gain = 0.0
            for i in range(3):
                step[i] = inverse[i, 0] * g[0] + inverse[i, 1] * g[1] + inverse[i, 2] * g[2]
                gain += g[i] * step[i]
            if not gain > _GAIN:
                break
            for i in range(3):
                x[i] = points[m, i] + step[i]
        invert_symmetric(H, _FREE * (1 + trace(H)), own[m])


@kernel
def motion_error(poses, before, dt):
    """Change of velocity (6,) over the last of some poses (K, 4, 4), and derivatives (6, 18) by the last three.

    See `slam.kernels.velocities.velocity_change`. The last interval is `dt` [s], the one before it `before`; of two
    poses the change is the velocity itself, and the first six columns are zero.
    """
    r, J, last = np.empty(6), np.empty((6, 18)), len(poses) - 1
    velocity_change(poses, last - 2, last - 1, last, before, dt, r, J)
    return r, J
