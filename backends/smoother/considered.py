"""How errors of the rig move the newest pose and the landmarks (consider parameters; Schmidt, 1966).

The pose follows from the landmarks as they stand, and each landmark from its measurements given the poses: the gains
are those of the estimate, and move the derivatives by the errors as they move the estimate.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array, points_by_pose
from slam.window import pose_only


def by_pose_and_rig(one: pose_only.PoseProblem, T: Array, by_rig: Array, field: Array) -> tuple[Array, Array]:
    """Derivatives of whitened residuals by a pose T (3 M, 6), and by errors of the rig where it is known (3 M, m).

    The errors move the landmarks in the world by `by_rig` (M, 3, m), and measurements by `field` (M, 3, m).
    """
    local = (one.points - T[:3, 3]) @ T[:3, :3]
    D = one.whiteners @ one.stereo.project(local)[1]
    F = one.whiteners @ np.nan_to_num(field) - D @ T[:3, :3].T @ by_rig
    return (D @ points_by_pose(local)).reshape(-1, 6), F.reshape(3 * len(F), F.shape[2])


def landmarks_by_rig(
    one: pose_only.PoseProblem, T: Array, pose: Array, by_rig: Array, field: Array, own: Array, sigma: float
) -> Array:
    """`by_rig` (M, 3, m) after the measurements, from a pose T (4, 4) that the errors move by `pose` (6, m).

    The landmarks had covariances `own` (M, 3, 3) where the pose is known; `sigma` is the noise of a pixel.
    """
    local = (one.points - T[:3, 3]) @ T[:3, :3]
    D = one.stereo.project(local)[1]
    D[np.isnan(one.z[:, 2]), 2] = 0.0
    H = D @ T[:3, :3].T
    rest = np.nan_to_num(field) - (D @ points_by_pose(local)) @ pose - H @ by_rig
    gain = own @ np.swapaxes(H, 1, 2) @ np.linalg.inv(H @ own @ np.swapaxes(H, 1, 2) + sigma**2 * np.eye(3))
    return np.asarray(by_rig + gain @ rest)
