"""Compiled loops over pixels: what they say of points, and which points are within reach."""

from __future__ import annotations

import numpy as np

from slam.kernels.se3 import transform, transform_back
from slam.kernels.stereo import by_point, residual
from slam.runtime.compilation import kernel


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
def within_reach(start, found, start_variance, found_variance, way, sigmas):
    """Which places (M, 3) are no farther than `way` [m] from the starts (N, 3), given the variances [m²]: (N, M)."""
    out = np.empty((len(start), len(found)), np.bool_)
    for n in range(len(start)):
        x, y, z = start[n]
        for m in range(len(found)):
            square = (found[m, 0] - x) ** 2 + (found[m, 1] - y) ** 2 + (found[m, 2] - z) ** 2
            out[n, m] = square < (way + sigmas * np.sqrt(start_variance[n] + found_variance[m])) ** 2
    return out
