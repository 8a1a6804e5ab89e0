"""Compiled loops of the smoother: over landmarks and the poses that measured them, and over three poses in motion."""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import multiply
from slam.kernels.se3 import transform_back
from slam.kernels.stereo import by_point, residual
from slam.kernels.velocities import velocity_change
from slam.runtime.compilation import kernel


@kernel
def information_of(camera, poses, frames, z, points, rows, sigma):
    """What measurements z (n, 3) [px], made in `frames` (n,), say of landmarks, linearised at their `points` (M, 3).

    `camera` (7,) is as in `slam.kernels.stereo`, `poses` T_world_left (F, 4, 4); `rows` (M, K) are
    the measurements of each landmark, −1 for none. Returns the information of each measurement (M, K, 3, 3) [1/m²], the
    gradient (M, 3) towards the optimum, half the negative derivative of the sum of squares, which is the third (M,),
    and the number of measurements whose landmark lies behind the camera (M,): they count for nothing in the others.
    """
    count, most = rows.shape
    information, gradient = np.zeros((count, most, 3, 3)), np.zeros((count, 3))
    squares, behind = np.zeros(count), np.zeros(count)
    weight = 1 / (sigma * sigma)
    local, r, J, d = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    for m in range(count):
        for k in range(most):
            row = rows[m, k]
            if row < 0:
                continue
            T = poses[frames[row]]
            transform_back(T, points[m], local)
            if not residual(camera, local, z[row], r, J):
                behind[m] += 1
                continue
            for c in range(3):  # uL, vL, uR
                if not np.isfinite(r[c]):
                    continue
                squares[m] += weight * r[c] * r[c]
                by_point(J[c], T, d)
                for i in range(3):
                    gradient[m, i] += weight * r[c] * d[i]
                    for j in range(3):
                        information[m, k, i, j] += weight * d[i] * d[j]
    return information, gradient, squares, behind


@kernel
def carried_by(known, poses, frames, points, rows, information, older, covariance):
    """How poses (W, 4, 4) of the frames `known`, ascending, carry landmarks along: Jacobians (M, 3, 6 W) by the poses.

    `frames`, `points` and `rows` are as in `information_of`, `information` (M, K, 3, 3) is by it. That of measurements
    before these, `older` (M, 3, 3), counts for the pose of the oldest of these. The landmarks have `covariance`
    (M, 3, 3) where all poses are known.
    """
    count, most, width = len(points), rows.shape[1], len(known)
    out = np.zeros((count, 3, 6 * width))
    places, d = np.empty(most, np.int64), np.empty(3)
    share, C, D = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for m in range(count):
        oldest = width - 1
        for k in range(most):
            places[k] = -1
            if rows[m, k] >= 0:
                place = 0
                while place < width - 1 and known[place] < frames[rows[m, k]]:
                    place += 1
                places[k] = place
                oldest = min(oldest, place)
        for w in range(width):
            for i in range(3):
                d[i] = points[m, i] - poses[w, i, 3]
                for j in range(3):
                    share[i, j] = older[m, i, j] if w == oldest else 0.0
                    for k in range(most):
                        if places[k] == w:
                            share[i, j] += information[m, k, i, j]
            multiply(covariance[m], share, C)
            for i in range(3):  # C times the negative cross product matrix of d
                D[i, 0] = C[i, 2] * d[1] - C[i, 1] * d[2]
                D[i, 1] = C[i, 0] * d[2] - C[i, 2] * d[0]
                D[i, 2] = C[i, 1] * d[0] - C[i, 0] * d[1]
            for i in range(3):
                for j in range(3):
                    for h in range(3):
                        out[m, i, 6 * w + j] += D[i, h] * poses[w, h, j]
                        out[m, i, 6 * w + 3 + j] += C[i, h] * poses[w, h, j]
    return out


@kernel
def motion_error(poses, before, dt):
    """Change of velocity (6,) over the last of some poses (K, 4, 4), and derivatives (6, 18) by the last three.

    See `slam.kernels.velocities.velocity_change`. The last interval is `dt` [s], the one before it `before`; of two
    poses the change is the velocity itself, and the first six columns are zero.
    """
    r, J, last = np.empty(6), np.empty((6, 18)), len(poses) - 1
    velocity_change(poses, last - 2, last - 1, last, before, dt, r, J)
    return r, J
