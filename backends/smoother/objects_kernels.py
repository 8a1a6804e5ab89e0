"""Compiled loops of a body's window: its normal equations, factor by factor.

See `backends.smoother.objects_factors` for the unknowns.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import column_times
from slam.kernels.se3 import between, log, rotation_vector, transform
from slam.kernels.stereo import by_pose, residual
from slam.runtime.compilation import helper, kernel

FRAME = 12  #: fixed: unknowns of a frame: body pose (6), camera pose (6)

# ---------------------------------------------------------------------------------------------- measurements


@kernel
def add_measurements(H, g, camera, R_left, sigma, z, Y, points, first_point):
    """Add measurements to the information H and the vector g.

    Args:
        H: (U, U), changed in place.
        g: (U,), changed in place.
        camera: of the rectified rig (7,), see `slam.kernels.stereo`.
        R_left: rotation (3, 3) from left-camera to rectified coordinates.
        sigma: pixel noise [px].
        z: (n, p, 3), NaN where there is none.
        Y: poses (n, 4, 4) of the body in the camera.
        points: in body coordinates (p, 3).
        first_point: where the points' unknowns begin.
    """
    h, r, J, G = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, FRAME))
    for i in range(len(z)):
        R, start = Y[i], FRAME * i
        for j in range(len(points)):
            if np.isnan(z[i, j, 0]) and np.isnan(z[i, j, 1]) and np.isnan(z[i, j, 2]):
                continue
            transform(R, points[j], h)
            if not residual(camera, R_left, h, z[i, j], r, J):
                continue
            for k in range(3):
                known = np.isfinite(r[k])
                r[k] = r[k] / sigma if known else 0.0
                for c in range(3):
                    J[k, c] = J[k, c] / sigma if known else 0.0
                _derivatives(J[k], R, points[j], h, G[k])
            _add(H, g, G, r, start, first_point + 3 * j)


@helper
def _derivatives(J, R, point, h, out):
    """Derivatives (12,) by body pose and camera pose of what has the derivatives J (3,) by the point h in the camera.

    Those by the point in the body stand at 3 to 5.
    """
    for k in range(3):
        out[3 + k] = column_times(R, k, J)
    out[0] = out[5] * point[1] - out[4] * point[2]
    out[1] = out[3] * point[2] - out[5] * point[0]
    out[2] = out[4] * point[0] - out[3] * point[1]
    by_pose(J, h, out[6:])


@helper
def _add(H, g, G, r, start, own):
    """Three residuals r with derivatives G (3, 12) by a frame's unknowns at `start`, and by a point's at `own`."""
    for a in range(FRAME):
        g[start + a] += G[0, a] * r[0] + G[1, a] * r[1] + G[2, a] * r[2]
        for b in range(FRAME):
            H[start + a, start + b] += G[0, a] * G[0, b] + G[1, a] * G[1, b] + G[2, a] * G[2, b]
        for b in range(3):
            cross = G[0, a] * G[0, 3 + b] + G[1, a] * G[1, 3 + b] + G[2, a] * G[2, 3 + b]
            H[start + a, own + b] += cross
            H[own + b, start + a] += cross
    for a in range(3):
        g[own + a] += G[0, 3 + a] * r[0] + G[1, 3 + a] * r[1] + G[2, 3 + a] * r[2]
        for b in range(3):
            H[own + a, own + b] += G[0, 3 + a] * G[0, 3 + b] + G[1, 3 + a] * G[1, 3 + b] + G[2, 3 + a] * G[2, 3 + b]


# ---------------------------------------------------------------------------------------------- motion


@kernel
def velocities(T, stamps):
    """Velocities [ω, v] (n − 1, 6) between successive poses, with their derivatives (n − 1, 6, 6) by both poses."""
    n = len(T) - 1
    velocity, before, after = np.empty((n, 6)), np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    turn, w, inverse_J = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for m in range(n):
        A, B, per_second = T[m], T[m + 1], 1 / (stamps[m + 1] - stamps[m])
        for i in range(3):
            for j in range(3):
                turn[i, j] = B[i, 0] * A[j, 0] + B[i, 1] * A[j, 1] + B[i, 2] * A[j, 2]
        rotation_vector(turn, w, inverse_J)
        for i in range(3):
            velocity[m, i] = w[i] * per_second
            velocity[m, 3 + i] = (B[i, 3] - A[i, 3]) * per_second
            for j in range(3):
                for k in range(3):  # the right Jacobian is the transposed left one
                    before[m, i, j] -= inverse_J[k, i] * A[k, j] * per_second
                    after[m, i, j] += inverse_J[i, k] * B[k, j] * per_second
                before[m, 3 + i, 3 + j] = -A[i, j] * per_second
                after[m, 3 + i, 3 + j] = B[i, j] * per_second
    return velocity, before, after


@kernel
def add_motion(H, g, velocity, before, after, mean, sigmas, first, last):
    """Add the steps from `first` up to `last` to the information H and the vector g: the velocity is that before.

    Before step 0 it is the mean.

    Args:
        H: (U, U), changed in place.
        g: (U,), changed in place.
        velocity: of each step (n − 1, 6).
        before: derivatives (n − 1, 6, 6) by the earlier pose.
        after: the same by the later one.
        mean: of the first velocity (6,).
        sigmas: standard deviations (n − 1, 6) of the change of velocity.
        first: step.
        last: the step after the last.
    """
    J = np.empty(18)
    for m in range(first, last):
        for k in range(6):
            weight, change = 1 / sigmas[m, k], velocity[m, k] - mean[k]
            for j in range(6):
                J[6 + j], J[12 + j] = before[m, k, j], after[m, k, j]
            if m > 0:
                change = velocity[m, k] - velocity[m - 1, k]
                for j in range(6):
                    J[j] = -before[m - 1, k, j]
                    J[6 + j] -= after[m - 1, k, j]
            for a in range(0 if m > 0 else 6, 18):
                J[a] *= weight
            for a in range(0 if m > 0 else 6, 18):
                row = FRAME * (m - 1 + a // 6) + a % 6
                g[row] -= J[a] * weight * change
                for b in range(0 if m > 0 else 6, 18):
                    H[row, FRAME * (m - 1 + b // 6) + b % 6] += J[a] * J[b]


# ---------------------------------------------------------------------------------------------- prior


@kernel
def relinearised(H, g, T0, X0, points0, T, X, points):
    """A prior, linearised at T0, X0 (n, 4, 4), points0 (p, 3), for changes of T, X and points.

    The points' part is one on where they are beside the oldest pose.

    Returns the information (U, U) and the vector (U,).
    """
    n, first = len(T), FRAME * len(T)
    delta = np.empty(len(g))
    D, w, inverse_J, moved = np.empty((3, 4)), np.empty(3), np.empty((3, 3)), np.empty(3)
    for m in range(n):
        for at, (A, B) in enumerate(((T0[m], T[m]), (X0[m], X[m]))):
            between(A, B, D)
            log(D, w, inverse_J, delta[FRAME * m + 6 * at :])
    between(T0[0], T[0], D)
    for j in range(len(points)):
        old, now, at = points0[j], points[j], first + 3 * j
        transform(D, now, moved)
        for i in range(3):
            delta[at + i] = moved[i] - old[i] - delta[3 + i]
        delta[at] += old[1] * delta[2] - old[2] * delta[1]
        delta[at + 1] += old[2] * delta[0] - old[0] * delta[2]
        delta[at + 2] += old[0] * delta[1] - old[1] * delta[0]
    out, vector = H.copy(), g.copy()
    for i in range(len(g)):
        for j in range(len(g)):
            vector[i] -= H[i, j] * delta[j]
    # A turn of the frame moves a point by the cross product with where it is: only that has changed.
    for j in range(len(points)):
        at = first + 3 * j
        away = points[j, 0] - points0[j, 0], points[j, 1] - points0[j, 1], points[j, 2] - points0[j, 2]
        for i in range(len(out)):
            _turn_with(out[i], at, away)
        for i in range(len(out)):
            _turn_with(out[:, i], at, away)
        _turn_with(vector, at, away)
    return out, vector


@helper
def _turn_with(line, at, away):
    """Take what a point's three entries at `at` say into those of the frame's turn, the first three."""
    (a, b, c), (x, y, z) = (line[at], line[at + 1], line[at + 2]), away
    line[0] -= b * z - c * y
    line[1] -= c * x - a * z
    line[2] -= a * y - b * x
