"""Compiled loops of `slam.geometry.rig`."""

from __future__ import annotations

import numpy as np

from slam.kernels.stereo import offsets
from slam.runtime.compilation import kernel


@kernel
def project_rectified(cameras, points, jacobian):
    """Pixels (uL, vL, uR) (N, 3) of points (N, 3) in a rectified rig, and their derivatives (N, 3, 3) by the points.

    Args:
        cameras: `slam.geometry.rig.StereoRig.rectified_parameters` (7,).
        points: in left-camera coordinates (N, 3); rows of those behind the camera become NaN.
        jacobian: whether to work out the derivatives; else there are no rows of them.
    """
    z, J = np.empty((len(points), 3)), np.zeros((len(points) if jacobian else 0, 3, 3))
    for n in range(len(points)):
        u, v, right_u, inverse = offsets(cameras, points[n, 0], points[n, 1], points[n, 2])
        z[n, 0], z[n, 1], z[n, 2] = u + cameras[2], v + cameras[3], right_u + cameras[5]
        if jacobian:
            J[n, 0, 0], J[n, 1, 1], J[n, 2, 0] = cameras[0] * inverse, cameras[1] * inverse, cameras[4] * inverse
            J[n, 0, 2], J[n, 1, 2], J[n, 2, 2] = -u * inverse, -v * inverse, -right_u * inverse
    return z, J


@kernel
def triangulate_rectified(cameras, uv_left, uv_right):
    """Points (N, 3) in left-camera coordinates of a rectified rig; NaN where the pixels say no positive depth.

    Args:
        cameras: `slam.geometry.rig.StereoRig.rectified_parameters` (7,).
        uv_left: left pixels (N, 2).
        uv_right: right pixels (N, 2).
    """
    fu, fv, u0, v0, right_fu, right_u0, shift = cameras
    points = np.full((len(uv_left), 3), np.nan)
    for n in range(len(uv_left)):
        x = (uv_left[n, 0] - u0) / fu
        depth = -shift / (x - (uv_right[n, 0] - right_u0) / right_fu)
        if depth > 0 and np.isfinite(depth):
            points[n, 0], points[n, 1], points[n, 2] = x * depth, (uv_left[n, 1] - v0) / fv * depth, depth
    return points
