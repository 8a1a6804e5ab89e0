"""Compiled loops over pixels: how far off a track may be seen, and which feature it is."""

from __future__ import annotations

import numpy as np

from slam.kernels.se3 import transform, transform_back
from slam.kernels.stereo import by_point, residual
from slam.runtime.compilation import helper, kernel

_NEIGHBOURS = 8  # cost: features looked at in a window: the nearest ones
_RIGHT_SIGMAS = 4.0  # standard deviations that a right pixel may be off


@kernel
def points_on_rays(camera, T_world_left, points, measured, sigma, far, steps):
    """Points (N, 3) on the measured rays, their information (N, 3, 3), and numbers measured (N,).

    See `slam.objects.measurement.measure`; `camera` (7,) is `slam.geometry.rig.StereoRig.rectified_parameters`, `far`
    [px] how far off an expected point may be, and `steps` how often it is linearised at most.
    """
    fu, fv, u0, v0, right_fu, _, shift = camera
    out, A, dof = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3)), np.zeros(len(points), np.int8)
    place, r, J, g = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    for n in range(len(points)):
        x, y = (measured[n, 0] - u0) / fu, (measured[n, 1] - v0) / fv
        transform_back(T_world_left, points[n], place)
        met, stereo, front = place[2], not np.isnan(measured[n, 2]), False
        for _ in range(steps):
            depth = met
            place[0], place[1], place[2] = x * depth, y * depth, depth
            front = residual(camera, place, measured[n], r, J) and r[0] + r[1] == r[0] + r[1]
            if not (front and stereo):
                break
            met = depth - r[2] * depth * depth / (right_fu * shift)  # on the ray uR changes by f' b / z
            if abs(r[2]) <= far:
                break
        if not front:
            transform(T_world_left, np.zeros(3), out[n])
            continue
        place[0], place[1], place[2] = x * met, y * met, met
        transform(T_world_left, place, out[n])
        dof[n] = 3 if stereo else 2
        for k in range(dof[n]):
            by_point(J[k], T_world_left, g)
            for i in range(3):
                for j in range(3):
                    A[n, i, j] += g[i] * g[j] / (sigma * sigma)
    return out, A, dof


@kernel
def continue_tracks(
    z, J, T_world_left, P, more, rows, sigma, sigmas, least, limit, descriptors, signs, allowance, order, feature_uv,
    feature_uv_right, feature_descriptors, feature_signs, d_match, ratio, taken,
):  # fmt: skip
    """Features that continue tracks: the best inside a track's window, and that track the best of the feature's.

    A window is as wide as the pixel is uncertain. Matches whose right pixel says that it is another point, or a false
    stereo match, are dropped.

    Args:
        z: expected pixels (M, 3) = (uL, vL, uR); NaN where there are none.
        J: their derivatives (M, 3, 3) by the points, in camera axes.
        T_world_left: pose (4, 4) of the camera.
        P: covariances of all tracks (N, 3, 3), in world axes, and
        more: what is added to each (3, 3).
        rows: which tracks these are (M,).
        sigma: pixel noise [px].
        sigmas: half sizes of the windows in standard deviations, but
        least: at least so much (M,) [px], and
        limit: at most so much [px].
        descriptors: of all tracks (N, D).
        signs: of their Laplacians (N,).
        allowance: how far right pixels may be off besides, by an uneven motion (M,) [px].
        order: rows of the features (F,) by ascending v.
        feature_uv: their left pixels (F, 2).
        feature_uv_right: their right pixels (F, 2); NaN where there is none.
        feature_descriptors: their descriptors (F, D).
        feature_signs: the signs of their Laplacians (F,).
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best.
        taken: which features have a track already (F,); those found are entered.

    Returns:
        rows of the features (M,), −1 where there is none.
    """
    best, distance = np.full(len(rows), -1), np.full(len(rows), np.inf)
    right = np.empty(len(rows))
    owner = np.full(len(order), -1)
    near, gaps = np.empty(_NEIGHBOURS, np.int64), np.empty(_NEIGHBOURS)
    deviations, g = np.empty(3), np.empty(3)
    for m in range(len(rows)):
        n = rows[m]
        if not (np.isfinite(z[m, 0]) and np.isfinite(z[m, 1])):
            continue
        _pixel_deviations(J[m], T_world_left, P[n], more, sigma, g, deviations)
        right[m] = deviations[2]
        radius = least[m]
        if not (np.isnan(deviations[0]) or np.isnan(deviations[1])):
            radius = max(sigmas * max(deviations[0], deviations[1]), radius)
        count = _nearest(z[m], min(radius, limit), order, feature_uv, near, gaps)
        second = np.inf
        for c in range(count):
            k = near[c]
            if feature_signs[k] != signs[n]:
                continue
            gap = _distance(descriptors[n], feature_descriptors[k])
            if gap < distance[m]:
                best[m], distance[m], second = k, gap, distance[m]
            elif gap < second:
                second = gap
        if not (distance[m] < d_match and distance[m] < ratio * second):
            best[m] = -1
            continue
        rival = owner[best[m]]
        if rival < 0 or distance[m] < distance[rival]:
            owner[best[m]] = m
    for m in range(len(rows)):
        k = best[m]
        best[m] = -1
        if k < 0 or owner[k] != m or taken[k]:
            continue
        if not abs(feature_uv_right[k, 0] - z[m, 2]) > _RIGHT_SIGMAS * right[m] + allowance[m]:  # nor where one is NaN
            best[m] = k
    for m in range(len(rows)):
        if best[m] >= 0:
            taken[best[m]] = True
    return best


@helper
def _pixel_deviations(J, T_world_left, P, more, sigma, g, out):
    """Deviations (3,) of the pixels (uL, vL, uR) of a point that is not known exactly; `g` (3,) is overwritten."""
    for i in range(3):
        by_point(J[i], T_world_left, g)
        square = sigma * sigma
        for j in range(3):
            for k in range(3):
                square += g[j] * (P[j, k] + more[j, k]) * g[k]
        out[i] = np.sqrt(square)


@kernel
def within_reach(start, found, start_variance, found_variance, way, sigmas):
    """Which places (M, 3) are no farther than `way` [m] from the starts (N, 3), given the variances [m²]: (N, M)."""
    out = np.empty((len(start), len(found)), np.bool_)
    for n in range(len(start)):
        x, y, z = start[n]
        for m in range(len(found)):
            square = (found[m, 0] - x) ** 2 + (found[m, 1] - y) ** 2 + (found[m, 2] - z) ** 2
            out[n, m] = square < (way + sigmas * np.sqrt(start_variance[n] + found_variance[m])) ** 2
    return out


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
def _nearest(middle, radius, order, uv, near, gaps):
    """Rows of the pixels nearest to `middle` into `near`, the nearest first; how many there are, up to its length.

    `order` (F,) has the rows of the pixels `uv` (F, 2) by ascending v.
    """
    first, end = 0, len(uv)
    while first < end:
        half = (first + end) // 2
        if uv[order[half], 1] < middle[1] - radius:
            first = half + 1
        else:
            end = half
    count = 0
    for at in range(first, len(uv)):
        m = order[at]
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
