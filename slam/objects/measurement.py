"""What a frame's pixels say of points in world coordinates: points with their information."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.rig import StereoRig
from slam.se3 import Array, transform

_FAR = 3.0  # expected points so far off that linearising there is worse than at the measured point [px]
_STEPS = 4


def measure(
    rig: StereoRig, T_world_left: Array, points: Array, measured: Array, sigma: float
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Points (N, 3) that the pixels say, their information (N, 3, 3), and how many numbers each rests on (N,).

    Each is linearised on the measured ray, at the depth of the expected point: so the left pixel is met exactly, and
    the depth is linear in the disparity and therefore free of bias; only where the expected point is far off, at the
    measured depth. Rows whose uR is NaN know nothing along the ray; rows that cannot be used have no information.

    Args:
        rig: the cameras.
        T_world_left: pose (4, 4) of the left camera.
        points: expected points (N, 3) in world coordinates.
        measured: (N, 3) = (uL, vL, uR).
        sigma: pixel noise [px].
    """
    R = T_world_left[:3, :3]
    depth = (points - T_world_left[:3, 3]) @ R[:, 2]
    rays = np.column_stack([rig.left.normalise(measured[:, :2]), np.ones(len(points))])
    mono = np.isnan(measured[:, 2])
    for _ in range(_STEPS):
        q = rays * depth[:, None]
        z, J = rig.project_stereo(q)
        usable = np.isfinite(z).all(axis=1) & np.isfinite(J).all(axis=(1, 2)) & (depth > 0)
        J = np.where(usable[:, None, None], J, np.eye(3))
        step = np.where(usable & ~mono, measured[:, 2] - z[:, 2], 0.0)
        along = np.linalg.solve(J, np.broadcast_to([0.0, 0.0, 1.0], (len(J), 3))[..., None])[..., 0]  # by uR
        q = np.where(usable[:, None], q + along * step[:, None], 0.0)
        far = np.abs(step) > _FAR
        if not far.any():
            break
        depth = np.where(far, q[:, 2], depth)
    J = (J @ R.T) / sigma
    J[mono, 2] = 0.0
    J[~usable] = 0.0
    dof = np.where(usable, np.where(mono, 2, 3), 0).astype(np.int8)
    return transform(T_world_left, q), np.swapaxes(J, 1, 2) @ J, dof
