"""What a frame's pixels say of points in world coordinates: points with their information."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.objects.pixel_kernels import points_on_rays

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
        rig: the cameras, rectified.
        T_world_left: pose (4, 4) of the left camera.
        points: expected points (N, 3) in world coordinates.
        measured: (N, 3) = (uL, vL, uR).
        sigma: pixel noise [px].
    """
    camera = rig.rectified_parameters
    out, A, dof = points_on_rays(camera, T_world_left, points, measured, sigma, _FAR, _STEPS)
    return out, A, dof
