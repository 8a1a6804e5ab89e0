"""Errors of the rig in a frame of the smoother: they are considered, not estimated (Schmidt, 1966).

The pose follows from the landmarks as they stand, and each landmark from its measurements given the poses: these gains
move the derivatives by the errors, too.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array, points_by_pose
from slam.window.pose_only import PoseProblem


def considered(
    one: PoseProblem, T: Array, pose: Array, landmarks: Array, field: Array, own: Array, sigma: float
) -> tuple[Array, Array]:
    """Derivatives by m errors of the rig of the newest pose (6, m) and the landmarks (M, 3, m) after an update.

    Args:
        one: what the pose was found from.
        T: the pose (4, 4).
        pose: its derivatives (6, m) before.
        landmarks: the landmarks' (M, 3, m).
        field: those of the measurements (M, 3, m).
        own: covariances (M, 3, 3) of the landmarks before, where the pose is known.
        sigma: noise of a pixel [px].
    """
    local = (one.points - T[:3, 3]) @ T[:3, :3]
    D = one.stereo.project(local)[1]
    D[np.isnan(one.z[:, 2]), 2] = 0.0
    G, H = D @ points_by_pose(local), D @ T[:3, :3].T  # measurements by pose and landmarks
    rest = np.nan_to_num(field) - H @ landmarks
    by_pose, by_rig = ((one.whiteners @ A).reshape(3 * len(A), A.shape[2]) for A in (G, rest))
    pose = np.linalg.solve(one.information + by_pose.T @ by_pose, one.information @ pose + by_pose.T @ by_rig)
    gain = own @ np.swapaxes(H, 1, 2) @ np.linalg.inv(H @ own @ np.swapaxes(H, 1, 2) + sigma**2 * np.eye(3))
    return pose, landmarks + gain @ (rest - G @ pose)
