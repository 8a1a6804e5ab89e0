"""What a frame's pixels say of points in world coordinates: points with their information."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, transform

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
    stereo = np.isfinite(measured[:, 2])
    for _ in range(_STEPS):
        z, J = rig.project_stereo(rays * depth[:, None])
        usable = (depth > 0) & np.isfinite(z).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
        step = np.where(usable & stereo, measured[:, 2] - z[:, 2], 0.0)
        along = np.cross(J[:, 0], J[:, 1])  # along it neither uL nor vL changes
        with np.errstate(divide="ignore", invalid="ignore"):
            by_right = np.where(step == 0.0, 0.0, step / (J[:, 2] * along).sum(axis=1))
        met = rays * depth[:, None] + along * by_right[:, None]
        far = np.abs(step) > _FAR
        depth = np.where(far, met[:, 2], depth)
        if not far.any():
            break
    dof = np.where(usable, 2 + stereo, 0).astype(np.int8)
    G = np.where(usable[:, None, None], J, 0.0) @ T_world_left[:3, :3].T / sigma
    G[:, 2] *= (dof == 3)[:, None]
    return transform(T_world_left, np.where(usable[:, None], met, 0.0)), np.swapaxes(G, 1, 2) @ G, dof
