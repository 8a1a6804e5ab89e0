"""Compiled loops over pixels: how far off a track may be seen, which feature it is, and which point that says."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel


@kernel
def pixel_deviations(J, T_world_left, P, rows, sigma):
    """Deviations (M, 3) of the pixels (uL, vL, uR) of points that are not known exactly.

    Args:
        J: derivatives of the pixels (M, 3, 3) by the points, in camera axes.
        T_world_left: pose (4, 4) of the camera.
        P: covariances of all points (N, 3, 3), in world axes.
        rows: which points these are (M,).
        sigma: pixel noise.
    """
    out = np.empty((len(rows), 3))
    g = np.empty(3)
    for m in range(len(rows)):
        for i in range(3):
            _into_world(T_world_left, J[m, i], g)
            square = sigma * sigma
            for j in range(3):
                for k in range(3):
                    square += g[j] * P[rows[m], j, k] * g[k]
            out[m, i] = np.sqrt(square)
    return out


@helper
def _into_world(T, v, out):
    """A direction in world axes."""
    for i in range(3):
        out[i] = T[i, 0] * v[0] + T[i, 1] * v[1] + T[i, 2] * v[2]


@kernel
def move_along_rays(rays, depth, z, J, measured, far):
    """Move points along their rays so that they meet the measured uR.

    Args:
        rays: through the measured left pixels (N, 3), third coordinate 1.
        depth: of the points (N,); changed where a point was off by more than `far`.
        z: the points' pixels (N, 3).
        J: their derivatives (N, 3, 3).
        measured: pixels (N, 3); uR is NaN where there is none.
        far: [px].

    Returns:
        points (N, 3) in camera coordinates, which of them can be used (N,), and whether any was far off.
    """
    points, usable, any_far = np.zeros((len(rays), 3)), np.empty(len(rays), np.bool_), False
    for n in range(len(rays)):
        known = 0.0  # becomes NaN where a pixel or a derivative is not finite
        for i in range(3):
            known += 0.0 * z[n, i]
            for j in range(3):
                known += 0.0 * J[n, i, j]
        usable[n] = depth[n] > 0 and known == 0.0
        if not usable[n]:
            continue
        for i in range(3):
            points[n, i] = depth[n] * rays[n, i]
        step = measured[n, 2] - z[n, 2]
        if np.isnan(step):
            continue
        a, b, c = J[n, 0], J[n, 1], J[n, 2]
        x, y, w = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        step_by_right = step / (c[0] * x + c[1] * y + c[2] * w)  # along a × b neither uL nor vL changes
        points[n, 0] += x * step_by_right
        points[n, 1] += y * step_by_right
        points[n, 2] += w * step_by_right
        if abs(step) > far:
            any_far = True
            depth[n] = points[n, 2]
    return points, usable, any_far


@kernel
def information_in_world(points, usable, J, measured, T_world_left, sigma):
    """Points (N, 3) in world coordinates, their information (N, 3, 3), and how many numbers each rests on (N,).

    Args:
        points: in camera coordinates (N, 3).
        usable: which of them can be used (N,).
        J: derivatives of the pixels by the points (N, 3, 3).
        measured: pixels (N, 3); uR is NaN where there is none.
        T_world_left: pose (4, 4) of the camera.
        sigma: pixel noise [px].
    """
    out, A, dof = np.empty((len(points), 3)), np.zeros((len(points), 3, 3)), np.zeros(len(points), np.int8)
    g = np.empty(3)
    for n in range(len(points)):
        _into_world(T_world_left, points[n], out[n])
        for i in range(3):
            out[n, i] += T_world_left[i, 3]
        if not usable[n]:
            continue
        dof[n] = 2 if np.isnan(measured[n, 2]) else 3
        for k in range(dof[n]):
            _into_world(T_world_left, J[n, k], g)
            for i in range(3):
                for j in range(3):
                    A[n, i, j] += g[i] * g[j] / (sigma * sigma)
    return out, A, dof


@kernel
def best_in_windows(
    uv, radius, first, descriptors, signs, feature_uv, feature_descriptors, feature_signs, most, d_match, ratio
):
    """Features that continue tracks: the best inside a track's window, and that track the best of the feature's.

    Args:
        uv: middles of the windows (N, 2); NaN where there is none.
        radius: their half sizes (N,) [px].
        first: the first feature in the rows of pixels of every window (N,).
        descriptors: of the tracks (N, D).
        signs: of their Laplacians (N,).
        feature_uv: pixels of the features (M, 2), by ascending v.
        feature_descriptors: their descriptors (M, D).
        feature_signs: of their Laplacians (M,).
        most: so many features are looked at in a window, the nearest ones.
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best.

    Returns:
        the features (N,), −1 where there is none.
    """
    best, distance = np.full(len(uv), -1), np.full(len(uv), np.inf)
    owner = np.full(len(feature_uv), -1)
    near, gaps = np.empty(most, np.int64), np.empty(most)
    for n in range(len(uv)):
        if not (np.isfinite(uv[n, 0]) and np.isfinite(uv[n, 1])):
            continue
        count = _nearest(uv[n], radius[n], feature_uv, first[n], near, gaps)
        second = np.inf
        for c in range(count):
            m = near[c]
            if feature_signs[m] != signs[n]:
                continue
            gap = _distance(descriptors[n], feature_descriptors[m])
            if gap < distance[n]:
                best[n], distance[n], second = m, gap, distance[n]
            elif gap < second:
                second = gap
        if not (distance[n] < d_match and distance[n] < ratio * second):
            best[n] = -1
            continue
        rival = owner[best[n]]
        if rival < 0 or distance[n] < distance[rival]:
            owner[best[n]] = n
    for n in range(len(uv)):
        if best[n] >= 0 and owner[best[n]] != n:
            best[n] = -1
    return best


@kernel
def best_of_products(products, allowed, signs, feature_signs, d_match, ratio):
    """Features that continue tracks, each the other's best where that is allowed.

    Args:
        products: of unit descriptors, tracks by features (N, M).
        allowed: which pairs may be (N, M).
        signs: of the tracks' Laplacians (N,).
        feature_signs: of the features' (M,).
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best.

    Returns:
        the features (N,), −1 where there is none.
    """
    best, least = np.full(len(products), -1), np.full(len(products), np.inf)
    other = np.full(len(products), np.inf)  # distance of the second best
    owner, owned = np.full(products.shape[1], -1), np.full(products.shape[1], np.inf)
    for n in range(len(products)):
        for m in range(products.shape[1]):
            if not allowed[n, m] or signs[n] != feature_signs[m]:
                continue
            distance = np.sqrt(max(2.0 - 2.0 * products[n, m], 0.0))
            if distance < least[n]:
                best[n], least[n], other[n] = m, distance, least[n]
            elif distance < other[n]:
                other[n] = distance
            if distance < owned[m]:
                owner[m], owned[m] = n, distance
    for n in range(len(products)):
        if not (least[n] < d_match and least[n] < ratio * other[n] and owner[best[n]] == n):
            best[n] = -1
    return best


@helper
def _nearest(middle, radius, uv, first, near, gaps):
    """Rows of the pixels nearest to `middle` into `near`, the nearest first; how many there are, up to its length."""
    count = 0
    for m in range(first, len(uv)):
        if uv[m, 1] > middle[1] + radius:
            break
        gap = (uv[m, 0] - middle[0]) ** 2 + (uv[m, 1] - middle[1]) ** 2
        if gap > radius * radius or (count == len(near) and gap >= gaps[count - 1]):
            continue
        place = min(count, len(near) - 1)
        while place > 0 and gaps[place - 1] > gap:
            near[place], gaps[place] = near[place - 1], gaps[place - 1]
            place -= 1
        near[place], gaps[place] = m, gap
        count = min(count + 1, len(near))
    return count


@helper
def _distance(a, b):
    """Distance of two descriptors, in four sums that need not wait for one another."""
    s0 = s1 = s2 = s3 = np.float32(0.0)
    whole = len(a) - len(a) % 4
    for i in range(0, whole, 4):
        s0 += (a[i] - b[i]) ** 2
        s1 += (a[i + 1] - b[i + 1]) ** 2
        s2 += (a[i + 2] - b[i + 2]) ** 2
        s3 += (a[i + 3] - b[i + 3]) ** 2
    for i in range(whole, len(a)):
        s0 += (a[i] - b[i]) ** 2
    return np.sqrt((s0 + s1) + (s2 + s3))
