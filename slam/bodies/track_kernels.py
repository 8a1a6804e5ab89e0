"""Compiled loops over tracks: 3x3 matrices are worked through in place of many small batches of arrays.

Windows are those of `slam.tracks.table.Tracks`: information ``A`` (N, W, 3, 3) and points ``p`` (N, W, 3) by slot;
`rows` (M,) names the tracks. A fixed point fitted to a window is ``(Σ A)⁻¹ Σ A p``; a small share of the trace on the
diagonal makes information invertible that knows nothing along the ray.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, invert_symmetric, multiply, row_times, trace, turn
from slam.kernels.se3 import transform, transform_back
from slam.kernels.stereo import by_point, residual
from slam.runtime.compilation import disjoint_helper, helper, kernel

RIDGE = 1e-9  #: numerics: share of the trace, for information over a whole window,
PART = 1e-6  #: numerics: for a part of it
LEAST = 1e-12  #: numerics: and this for windows that are empty


@helper
def add(total, M, factor):
    """Add a factor times M (3, 3)."""
    for i in range(3):
        for j in range(3):
            total[i, j] += factor * M[i, j]


@helper
def add_times(total, M, v, factor):
    """Add a factor times ``M v`` (3,)."""
    for i in range(3):
        total[i] += factor * row_times(M, i, v)


@disjoint_helper
def add_weighted(total, part, weight):
    """Add a track's sums (28,), see `slam.bodies.scene_kernels`, times a weight."""
    for k in range(28):
        total[k] += weight * part[k]


@helper
def add_rows(total, parts, rows, weight):
    """Add the `rows` (M,) of `parts` (N, 28), each times its `weight` (N,)."""
    n = len(rows)
    for m in range(0, n - 3, 4):
        a, b, c, d = rows[m], rows[m + 1], rows[m + 2], rows[m + 3]
        _add_four(total, parts[a], parts[b], parts[c], parts[d], (weight[a], weight[b], weight[c], weight[d]))
    for m in range(n - n % 4, n):
        add_weighted(total, parts[rows[m]], weight[rows[m]])


@disjoint_helper
def _add_four(total, a, b, c, d, weight):
    """What is loaded and stored once serves four tracks."""
    for k in range(28):
        total[k] += (weight[0] * a[k] + weight[1] * b[k]) + (weight[2] * c[k] + weight[3] * d[k])


# ---------------------------------------------------------------------------------------------- windows of tracks


@helper
def _count(dof):
    """In how many slots (W,) something was measured."""
    count = 0
    for w in range(len(dof)):
        count += dof[w] > 0
    return count


@kernel
def fit_tracks(A, p, dof, anchor, rows, asked, least, times, prior, moves, position, covariance, velocity, spread):
    """Fixed points that fit the windows best, in place; or points with an even velocity, where its χ² is above `moves`.

    A velocity is sought for tracks that are `asked` for (N,), have one already, or were measured less than `least`
    times, but twice. Slots have `times` (W,) less the present [s], to which positions refer; `prior` is the information
    on each axis of the velocity before anything is known [s²/m²]; `spread` (N, 3, 3) are the velocities' covariances.
    Returns χ²(3) of the velocities (M,), 0 where none was sought.
    """
    test, even, M2, S, G = np.zeros(len(rows)), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    M0, M1, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    b0, b1, told = np.empty(3), np.empty(3), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        M0[:], M1[:], M2[:], b0[:], b1[:] = 0.0, 0.0, 0.0, 0.0, 0.0
        count, had = _count(dof[n]), asked[n]
        for i in range(3):
            had = had or velocity[n, i] != 0.0
            velocity[n, i] = 0.0
        had = count > 1 and (had or count < least)
        for w in range(A.shape[1]):
            t, Aw, pw = times[w], A[n, w], p[n, w]
            add(M0, Aw, 1.0)
            add_times(b0, Aw, pw, 1.0)
            if had:
                add(M1, Aw, t)
                add(M2, Aw, t * t)
                add_times(b1, Aw, pw, t)
        invert_symmetric(M0, RIDGE * trace(M0) + LEAST, covariance[n])
        for i in range(3):
            position[n, i] = anchor[n, i] + row_times(covariance[n], i, b0)
        if not had:
            continue
        multiply(covariance[n], M1, G)
        for i in range(3):
            told[i] = b1[i] - row_times(G.T, i, b0)
            for j in range(3):
                S[i, j] = M2[i, j] - (G[0, i] * M1[0, j] + G[1, i] * M1[1, j] + G[2, i] * M1[2, j])
            S[i, i] += prior
        invert_symmetric(S, RIDGE * trace(S) + LEAST, P)
        for i in range(3):
            even[i] = row_times(P, i, told)
            test[m] += even[i] * told[i]
        if test[m] > moves:
            turn(G, P, S)
            add(covariance[n], S, 1.0)
            assign(P, spread[n])
            for i in range(3):
                velocity[n, i] = even[i]
                position[n, i] -= row_times(G, i, even)
    return test


@kernel
def well_known(T_world_left, position, covariance, dof, rows, least, farthest):
    """Those of the tracks (K,) measured `least` times whose depth is known, and where they are seen from a pose (4, 4).

    Known is a depth of more than `farthest` times its deviation. Seen they are at x/z, y/z, log z (K, 3).
    """
    known, place, local, k = np.empty(len(rows), np.intp), np.empty((len(rows), 3)), np.empty(3), 0
    for m in range(len(rows)):
        n = rows[m]
        variance = trace(covariance[n])  # below 0 by rounding alone
        transform_back(T_world_left, position[n], local)
        if _count(dof[n]) < least or variance < 0.0 or not local[2] > farthest * np.sqrt(variance):
            continue
        depth = max(local[2], 1e-9)
        known[k], place[k, 0], place[k, 1], place[k, 2] = n, local[0] / depth, local[1] / depth, np.log(depth)
        k += 1
    return known[:k], place[:k]


@kernel
def displaced(A, p, dof, rows, ages, most_recent, rays, centres, slide):
    """How far tracks went from the older to the recent frames of their windows: see `slam.bodies.finder`.

    Slots have `ages` (W,) in frames, of which `most_recent` are recent at most; `rays` (M, 3) point from the camera,
    which was at `centres` (W, 3), to the tracks. `slide` is the variance of a feature's direction with each angle by
    which it is seen otherwise [rad]. Displacements (M, 3), their information (M, 3, 3), and lags (M,) [frames].
    """
    d, W, lag = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3)), np.empty(len(rows))
    total, P, told = np.empty((2, 3, 3)), np.empty((2, 3, 3)), np.empty((2, 3))
    age, slots = np.empty(2), np.empty(2, np.intp)
    for m in range(len(rows)):
        n = rows[m]
        recent = min(max(_count(dof[n]) // 2, 2), most_recent)
        total[:], told[:], age[:], slots[:] = 0.0, 0.0, 0.0, -1
        for w in range(A.shape[1]):
            if dof[n, w] == 0:
                continue
            side = 0 if ages[w] < recent else 1
            add(total[side], A[n, w], 1.0)
            add_times(told[side], A[n, w], p[n, w], 1.0)
            age[side] += ages[w] * trace(A[n, w])
            if slots[side] < 0 or (ages[w] < ages[slots[side]]) == (side == 0):
                slots[side] = w
        for side in range(2):
            size = trace(total[side])
            age[side] /= max(size, LEAST)
            invert_symmetric(total[side], PART * size + 1e3 * LEAST, P[side])
        lag[m] = max(age[1] - age[0], 1.0)
        for i in range(3):
            d[m, i] = row_times(P[0], i, told[0]) - row_times(P[1], i, told[1])
        add(P[0], P[1], 1.0)
        if slots[0] >= 0 and slots[1] >= 0:
            _add_slide(P[0], rays[m], centres[slots[0]], centres[slots[1]], slide)
        invert_symmetric(P[0], 0.0, W[m])
    return d, W, lag


@helper
def _add_slide(P, ray, late, early, slide):
    """Add to P (3, 3) the slide of a feature that was seen along `ray` (3,) from two places of the camera."""
    far, along, way = 0.0, 0.0, 0.0
    for i in range(3):
        far += ray[i] * ray[i]
        along += ray[i] * (late[i] - early[i])
        way += (late[i] - early[i]) ** 2
    across = np.sqrt(max(way - along * along / far, 0.0))
    variance = slide * np.sqrt(far) * across  # of the angle across / depth, at the depth
    for i in range(3):
        P[i, i] += variance
        for j in range(3):
            P[i, j] -= variance * ray[i] * ray[j] / far


# ---------------------------------------------------------------------------------------------- pixels


@kernel
def expected_pixels(camera, T_world_left, position, covariance, dof, rows, sigma, sigmas, least, reach):
    """Pixels (M, 3) at which tracks are expected, NaN behind the camera, and their innovation covariances (M, 3, 3).

    And by how much the right pixel may be off (M,): by so many `sigmas`, and by the first `reach` over the depth [px m]
    for tracks measured in less than the `least` frames, by the second for others.
    """
    n = len(rows)
    z, S, none, allowance = np.empty((n, 3)), np.empty((n, 3, 3)), np.zeros(3), np.empty(n)
    local, J, G = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for m in range(n):
        transform_back(T_world_left, position[rows[m]], local)
        residual(camera, local, none, z[m], J)
        for i in range(3):
            z[m, i] = -z[m, i]
            by_point(J[i], T_world_left, G[i])
        turn(G, covariance[rows[m]], S[m])
        for i in range(3):
            S[m, i, i] += sigma * sigma
        deviation = np.sqrt(max(S[m, 2, 2], sigma * sigma))  # rounding may leave a covariance that is not definite
        uneven = reach[0] if _count(dof[rows[m]]) < least else reach[1]
        allowance[m] = sigmas * deviation + uneven / max(local[2], 1e-3)
    return z, S, allowance


@kernel
def measure(camera, T_world_left, position, anchor, measured, rows, slot, sigma, far, steps, A, p, dof):
    """Enter what tracks measured (M, 3) into a slot of their windows, in place: see `slam.bodies.fits.record`.

    `camera` (7,) is `slam.geometry.rig.StereoRig.rectified_parameters`, `far` [px] how far off an expected point may
    be, and `steps` how often it is linearised at most.
    """
    fu, fv, u0, v0, right_fu, _, shift = camera
    place, r, J, g = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    for m in range(len(rows)):
        n, z = rows[m], measured[m]
        x, y = (z[0] - u0) / fu, (z[1] - v0) / fv
        transform_back(T_world_left, position[n], place)
        met, stereo, front = place[2], not np.isnan(z[2]), False
        for _ in range(steps):
            depth = met
            place[0], place[1], place[2] = x * depth, y * depth, depth
            front = residual(camera, place, z, r, J) and r[0] + r[1] == r[0] + r[1]
            if not (front and stereo):
                break
            met = depth - r[2] * depth * depth / (right_fu * shift)  # on the ray uR changes by f' b / z
            if abs(r[2]) <= far:
                break
        place[0], place[1], place[2] = (x * met, y * met, met) if front else (0.0, 0.0, 0.0)
        transform(T_world_left, place, p[n, slot])
        dof[n, slot] = (3 if stereo else 2) if front else 0
        A[n, slot] = 0.0
        for i in range(3):
            p[n, slot, i] -= anchor[n, i]
        for k in range(dof[n, slot]):
            by_point(J[k], T_world_left, g)
            for i in range(3):
                for j in range(3):
                    A[n, slot, i, j] += g[i] * g[j] / (sigma * sigma)
