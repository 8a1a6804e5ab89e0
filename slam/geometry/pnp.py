"""Stereo measurements of points, and the camera's pose from three of them in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse

#: fixed: Points that fix a pose.
MINIMAL_POINTS = 3


def measurement_rows(uv_left: Array, uv_right: Array) -> Array:
    """Stereo measurements (M, 3) = (uL, vL, uR); uR is NaN where there is no right pixel."""
    return np.concatenate([uv_left, uv_right[:, :1]], axis=1)


def poses_of_three(rig: StereoRig, points: Array, measured: Array, triples: NDArray[np.intp]) -> Array:
    """Poses T_world_left (H, 4, 4) from left pixels of triples (K, 3) of points (M, 3) [m]: up to four of each (P3P).

    `measured` (M, 3) is as by `measurement_rows`.
    """
    import cv2

    bearings = rig.left.normalise(measured[:, :2])
    poses = []
    for three in triples:
        _, turns, shifts = cv2.solveP3P(points[three], bearings[three], np.eye(3), None, cv2.SOLVEPNP_P3P)
        for turn, shift in zip(turns, shifts):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            poses.append(inverse(T))
    found = np.array(poses).reshape(-1, 4, 4)
    return found[np.isfinite(found).all(axis=(1, 2))]
