"""The measurement (uL, vL, uR) [px] of a point by a rectified stereo rig, and its derivatives.

``uL = u0 + fu x/z, vL = v0 + fv y/z, uR = u0' + f' (x + b)/z`` of a point (x, y, z) in rectified axes. The camera
(7,) is `slam.geometry.rig.StereoRig.rectified_parameters`: fu, fv, u0, v0, f', u0', b; b is minus the baseline [m].
Derivatives by the rig's own parameters are `slam.calibration.model.RigModel.field`.
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import row_times
from slam.runtime.compilation import helper

NEAREST = 1e-9  #: numerics: no depth up to this [m] is projected


@helper
def offsets(camera, x, y, depth):
    """Pixels less principal points, ``uL − u0, vL − v0, uR − u0'``, and the inverse depth; NaN behind the camera."""
    inverse = 1.0 / depth if depth > NEAREST else np.nan
    return camera[0] * x * inverse, camera[1] * y * inverse, camera[4] * (x + camera[6]) * inverse, inverse


@helper
def residual(camera, local, measured, r, J):
    """Measured less predicted r (3,), and derivatives J (3, 3) of the prediction by the point; whether it is in front.

    J has the rows ``[fu/z, 0, −(uL − u0)/z], [0, fv/z, −(vL − v0)/z], [f'/z, 0, −(uR − u0')/z]``.
    A component that is not measured is NaN in r. Behind the camera all r are NaN, and J is zero.

    Args:
        camera: see the module.
        local: the point (3,) in left-camera coordinates.
        measured: (3,) pixels.
        r: filled in.
        J: filled in.
    """
    left, row, right, inverse = offsets(camera, local[0], local[1], local[2])
    front = local[2] > NEAREST
    r[0], r[1] = measured[0] - (left + camera[2]), measured[1] - (row + camera[3])
    r[2] = measured[2] - (right + camera[5])
    if not front:
        inverse = left = row = right = 0.0
    J[0, 0], J[1, 1], J[2, 0] = camera[0] * inverse, camera[1] * inverse, camera[4] * inverse
    J[0, 1] = J[1, 0] = J[2, 1] = 0.0
    J[0, 2], J[1, 2], J[2, 2] = -left * inverse, -row * inverse, -right * inverse
    return front


@helper
def by_pose(J, local, out):
    """Derivatives (6,) by ξ of ``T_world_left exp(ξ)`` of what has derivatives J (3,) by the point in that camera.

    The point is fixed in the world, at `local` (3,) in the camera: ``J [hat(local), −1]``.
    """
    out[0] = J[1] * local[2] - J[2] * local[1]
    out[1] = J[2] * local[0] - J[0] * local[2]
    out[2] = J[0] * local[1] - J[1] * local[0]
    out[3], out[4], out[5] = -J[0], -J[1], -J[2]


@helper
def by_point(J, T, out):
    """Derivatives (3,) by the point in the world: ``J Rᵀ`` with the rotation of T_world_left."""
    for k in range(3):
        out[k] = row_times(T, k, J)
