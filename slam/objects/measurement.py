"""What a frame's pixels say of points in world coordinates: points with their information."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.objects.pixel_kernels import information_in_world, move_along_rays

_FAR = 3.0  # expected points so far off that linearising there is worse than at the measured point [px]
_STEPS = 4  # numerics: of Gauss-Newton at most


def measure(
    rig: StereoRig, T_world_left: Array, points: Array, measured: Array, sigma: float
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Points (N, 3) measured by pixels, their information (N, 3, 3), and the number of measured values of each (N,).

    Each is linearised on the measured ray, at the depth of the expected point: so the left pixel is met exactly, and
    the depth is linear in the disparity and therefore free of bias; only where the expected point is far off, at the
    measured depth. Rows whose uR is NaN have no information along the ray; unusable rows have none at all.

    Args:
        rig: the cameras.
        T_world_left: pose (4, 4) of the left camera.
        points: expected points (N, 3) in world coordinates.
        measured: (N, 3) = (uL, vL, uR).
        sigma: pixel noise [px].
    """
    depth = (points - T_world_left[:3, 3]) @ T_world_left[:3, 2]
    rays = np.ones((len(points), 3))
    rays[:, :2] = rig.left.normalise(measured[:, :2])
    for _ in range(_STEPS):
        z, J = rig.project_stereo(rays * depth[:, None])
        met, usable, any_far = move_along_rays(rays, depth, z, J, measured, _FAR)
        if not any_far:
            break
    found, A, dof = information_in_world(met, usable, J, measured, T_world_left, sigma)
    return found, A, dof
