"""Compiled loops over tracks: 3x3 matrices are worked through in place of many small batches of arrays.

Windows are those of `slam.tracks.table.Tracks`: information ``A`` (N, W, 3, 3) and points ``p`` (N, W, 3) by slot;
`rows` (M,) names the tracks. A fixed point fitted to a window is ``(Σ A)⁻¹ Σ A p``; a small share of the trace on the
diagonal makes information invertible that knows nothing along the ray.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import assign, invert_symmetric, multiply, row_times, square, trace, turn
from slam.kernels.se3 import point_by_motion, transform, transform_back
from slam.kernels.stereo import by_point, residual
from slam.runtime.compilation import disjoint_helper, helper, kernel

RIDGE = 1e-9  #: numerics: share of the trace, for information over a whole window,
PART = 1e-6  #: numerics: for a part of it
LEAST = 1e-12  #: numerics: and this for windows that are empty


@helper
def _add(total, M, factor):
    for i in range(3):
        for j in range(3):
            total[i, j] += factor * M[i, j]


@helper
def _add_times(total, M, v, factor):
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


@kernel
def fit_tracks(A, p, dof, anchor, rows, doubtful, least, times, prior, moves, position, covariance, velocity, spread):
    """Fixed points that fit the windows best, in place; or points with an even velocity that is clear, above `moves`.

    A velocity is sought for tracks that are `doubtful` (N,), have one already, or were measured less than `least`
    times, but twice. See `constant_velocities`; `spread` (N, 3, 3) are the velocities' covariances.
    """
    total, told, at, own = np.empty((3, 3)), np.empty(3), np.empty((2, 3)), np.empty((2, 3, 3))
    for m in range(len(rows)):
        n = rows[m]
        total[:], told[:], count, had = 0.0, 0.0, 0, doubtful[n]
        for w in range(A.shape[1]):
            _add(total, A[n, w], 1.0)
            _add_times(told, A[n, w], p[n, w], 1.0)
            count += dof[n, w] > 0
        invert_symmetric(total, RIDGE * trace(total) + LEAST, covariance[n])
        for i in range(3):
            had = had or velocity[n, i] != 0.0
            position[n, i], velocity[n, i] = anchor[n, i] + row_times(covariance[n], i, told), 0.0
        if count < 2 or not (had or count < least):
            continue
        if _constant_velocity(A[n], p[n], times, prior, at, own) > moves:
            for i in range(3):
                position[n, i], velocity[n, i] = anchor[n, i] + at[0, i], at[1, i]
            assign(own[0], covariance[n])
            assign(own[1], spread[n])


@kernel
def constant_velocities(A, p, rows, times, prior):
    """Points at time 0 and even velocities (M, 2, 3) [m], [m/s] that fit the windows best, covariances (M, 2, 3, 3).

    And χ²(3) of the velocities (M,). Slots have `times` (W,) [s]; `prior` is the information on each axis of the
    velocity before anything is known [s²/m²].
    """
    n = len(rows)
    at, own, test = np.empty((n, 2, 3)), np.empty((n, 2, 3, 3)), np.empty(n)
    for m in range(n):
        test[m] = _constant_velocity(A[rows[m]], p[rows[m]], times, prior, at[m], own[m])
    return at, own, test


@helper
def _constant_velocity(A, p, times, prior, at, own):
    """See `constant_velocities`, of one window; returns χ²(3)."""
    M0, M1, M2 = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    P0, G, S = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    b0, b1, told, test = np.zeros(3), np.zeros(3), np.empty(3), 0.0
    for w in range(len(p)):
        t = times[w]
        _add(M0, A[w], 1.0)
        _add(M1, A[w], t)
        _add(M2, A[w], t * t)
        _add_times(b0, A[w], p[w], 1.0)
        _add_times(b1, A[w], p[w], t)
    invert_symmetric(M0, RIDGE * trace(M0) + LEAST, P0)
    multiply(P0, M1, G)
    for i in range(3):
        told[i] = b1[i] - row_times(G.T, i, b0)
        for j in range(3):
            S[i, j] = M2[i, j] - (G[0, i] * M1[0, j] + G[1, i] * M1[1, j] + G[2, i] * M1[2, j])
        S[i, i] += prior
    invert_symmetric(S, RIDGE * trace(S) + LEAST, own[1])
    for i in range(3):
        at[1, i] = row_times(own[1], i, told)
        test += at[1, i] * told[i]
    turn(G, own[1], own[0])
    _add(own[0], P0, 1.0)
    for i in range(3):
        at[0, i] = row_times(P0, i, b0) - row_times(G, i, at[1])
    return test


@kernel
def well_known(T_world_left, position, covariance, dof, rows, least, farthest):
    """Those of the tracks measured `least` times whose depth is `farthest` times its deviation; x/z, y/z, log z (K, 3).

    So they are seen from a pose (4, 4).
    """
    known, place, local, k = np.empty(len(rows), np.intp), np.empty((len(rows), 3)), np.empty(3), 0
    for m in range(len(rows)):
        n, count = rows[m], 0
        for w in range(dof.shape[1]):
            count += dof[n, w] > 0
        variance = trace(covariance[n])
        transform_back(T_world_left, position[n], local)
        if count < least or variance < 0.0 or not local[2] > farthest * np.sqrt(variance):  # below 0 by rounding alone
            continue
        depth = max(local[2], 1e-9)
        known[k], place[k, 0], place[k, 1], place[k, 2] = n, local[0] / depth, local[1] / depth, np.log(depth)
        k += 1
    return known[:k].copy(), place[:k].copy()


@kernel
def displaced(A, p, dof, rows, ages, most_recent, rays, centres, slide):
    """How far tracks went from the older to the recent frames of their windows: see `slam.bodies.finder`.

    Slots have `ages` (W,) in frames, of which `most_recent` are recent at most; `rays` (M, 3) point from the camera,
    which was at `centres` (W, 3), to the tracks. `slide` is the variance of a feature's direction with each angle by
    which it is seen otherwise [rad]. Displacements (M, 3), their information (M, 3, 3), and lags (M,) [frames].
    """
    d, W, lag = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3)), np.empty(len(rows))
    now, before, P_now, P_before = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    b_now, b_before = np.empty(3), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        count = 0
        for w in range(A.shape[1]):
            count += dof[n, w] > 0
        recent = min(max(count // 2, 2), most_recent)
        now[:], b_now[:], before[:], b_before[:] = 0.0, 0.0, 0.0, 0.0
        late = early = 0.0
        late_slot, early_slot = -1, -1
        for w in range(A.shape[1]):
            if dof[n, w] == 0:
                continue
            if ages[w] < recent:
                _add(now, A[n, w], 1.0)
                _add_times(b_now, A[n, w], p[n, w], 1.0)
                late += ages[w] * trace(A[n, w])
                if late_slot < 0 or ages[w] < ages[late_slot]:
                    late_slot = w
            else:
                _add(before, A[n, w], 1.0)
                _add_times(b_before, A[n, w], p[n, w], 1.0)
                early += ages[w] * trace(A[n, w])
                if early_slot < 0 or ages[w] > ages[early_slot]:
                    early_slot = w
        lag[m] = max(early / max(trace(before), LEAST) - late / max(trace(now), LEAST), 1.0)
        invert_symmetric(now, PART * trace(now) + 1e3 * LEAST, P_now)
        invert_symmetric(before, PART * trace(before) + 1e3 * LEAST, P_before)
        for i in range(3):
            d[m, i] = row_times(P_now, i, b_now) - row_times(P_before, i, b_before)
        _add(P_now, P_before, 1.0)
        if late_slot >= 0 and early_slot >= 0:
            _add_slide(P_now, rays[m], centres[late_slot], centres[early_slot], slide)
        invert_symmetric(P_now, 0.0, W[m])
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


# ---------------------------------------------------------------------------------------------- windows and bodies


@helper
def _mean(points, A, mean):
    """Mean of a window's points (W, 3), weighted by their information (W, 3, 3)."""
    total, P, told = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3)
    for w in range(len(points)):
        _add(total, A[w], 1.0)
        _add_times(told, A[w], points[w], 1.0)
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
    points, turned, world, mean = np.empty((size, 3)), np.empty((size, 3, 3)), np.zeros((size, 3, 3)), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        for w in range(size):
            there = known[w] and dof[n, w] > 0
            _window_in_body(A[n, w], p[n, w], anchor[n], history[w], there, points[w], turned[w])
            world[w] = 0.0
            if there:
                _add(world[w], A[n, w], 1.0)
                counts[m, 0] += 1
                counts[m, 1] += dof[n, w]
        out[m, 0], out[m, 1] = _square(points, turned, mean), _square(p[n], world, mean)
    return out, counts


@helper
def _square(points, A, mean):
    """χ² of "one fixed point" for points by slot (W, 3) with information (W, 3, 3); the point is put into `mean`."""
    total = 0.0
    _mean(points, A, mean)
    for w in range(len(points)):
        total += square(A[w], (points[w, 0] - mean[0], points[w, 1] - mean[1], points[w, 2] - mean[2]))
    return total


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
        _add(information[n], turned, 1.0)
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
        count = 0
        for w in range(dof.shape[1]):
            count += dof[rows[m], w] > 0
        for i in range(3):
            S[m, i, i] += sigma * sigma
        deviation = np.sqrt(max(S[m, 2, 2], sigma * sigma))  # rounding may leave a covariance that is not definite
        allowance[m] = sigmas * deviation + (reach[0] if count < least else reach[1]) / max(local[2], 1e-3)
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
        scale = met if front else 0.0
        place[0], place[1], place[2] = x * scale, y * scale, scale
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
