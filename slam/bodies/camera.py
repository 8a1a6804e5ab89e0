"""The camera's last poses with their joint covariance, from any back end."""

from __future__ import annotations

import numpy as np

from slam.data import Estimate, RecentPoses
from slam.geometry.arrays import Array
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import adjoint, inverse, points_by_pose
from slam.interfaces import Backend, RecentBackend


def with_estimate(
    path: RecentPoses | None, estimate: Estimate, rig: StereoRig, sigma: float, landmarks: Array, most: int
) -> RecentPoses:
    """The online poses of the last frames, and what each frame's own measurements are worth.

    Args:
        path: those before this frame; its `covariance` has the (6, 6) blocks on the diagonal alone.
        estimate: of this frame.
        rig: the cameras.
        sigma: pixel noise [px].
        landmarks: those that measured the pose, as this frame's stereo places them (M, 3) in camera coordinates.
        most: frames that are kept.
    """
    information = np.linalg.inv(estimate.covariance + 1e-12 * np.eye(6))
    if len(landmarks):
        J = (rig.project_stereo(landmarks)[1] @ points_by_pose(landmarks)).reshape(-1, 6)
        information = information + J.T @ J / sigma**2
    own = np.linalg.inv(information)
    n = 0 if path is None else min(len(path), most - 1)
    blocks = np.zeros((6 * n + 6, 6 * n + 6))
    blocks[-6:, -6:] = own
    if path is None or n == 0:
        return RecentPoses(np.array([estimate.stamp]), estimate.T_world_left[None], blocks)
    blocks[:-6, :-6] = path.covariance[-6 * n :, -6 * n :]
    return RecentPoses(
        np.append(path.stamps[-n:], estimate.stamp), np.concatenate([path.poses[-n:], estimate.T_world_left[None]]),
        blocks,
    )  # fmt: skip


def recent_poses(backend: Backend, n: int, path: RecentPoses, covariance: Array) -> RecentPoses:
    """The camera's last n poses as the back end gives them, or else by its online poses.

    An online estimate says how uncertain each pose is, not how much of that is one error that all of them share. Over a
    few frames nearly all of it is: the place in the map, and the map's own error. What differs from frame to frame is
    the noise of the pixels that measured each pose. So a pose is off by what the newest is off, carried along, and by
    the two frames' own noises N: what its landmarks, were they known, would leave uncertain (`with_estimate`). That
    leaves out how the noises were smoothed by the motion model, so the increments are rather too uncertain than too
    certain; against the impulses of a body's motion they hardly count. The newest pose has just its covariance (6, 6).
    A back end that has corrected its past may give fewer poses for a while; then the online poses serve as well.
    """
    k = len(path)
    if isinstance(backend, RecentBackend):
        recent = backend.recent(n)
        if len(recent) >= min(n, k):
            return recent
    by_newest = adjoint(inverse(path.poses) @ path.poses[-1])  # of a common error, as each pose's perturbation
    newest = path.covariance[-6:, -6:]
    stacked = by_newest.reshape(6 * k, 6)
    P = stacked @ covariance @ stacked.T
    earlier = stacked[:-6]
    P[:-6, :-6] += earlier @ newest @ earlier.T + path.covariance[:-6, :-6]
    return RecentPoses(path.stamps, path.poses, P)
