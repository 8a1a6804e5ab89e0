"""The posterior Cramér-Rao bound of a camera's path among unknown landmarks.

No estimator that is unbiased has less error covariance than the inverse of the Fisher information. Here that is the
information of all measurements, of the first pose's prior and of the motion prior, linearised at the truth, with the
landmarks eliminated; the path is the one that was flown, so that it is the bound for that path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.data import Observations
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels


def pose_bounds(
    rig: StereoRig, models: EstimatorModels, stamps: Array, poses: Array, points: Array, frames: Sequence[Observations]
) -> Array:
    """Least covariances (F, 6, 6) of the poses given all measurements, as perturbations ``T exp(ξ)`` of the true ones.

    Online, the newest pose of a path that is cut off there has its bound: pass what was measured until then.

    Args:
        rig: the cameras.
        models: noise, priors and motion, which are those of the estimators.
        stamps: times (F,) [s].
        poses: true ``T_world_left`` (F, 4, 4).
        points: true landmarks (N, 3) by id, in the world [m].
        frames: what was measured; the pixels do not matter, only which there are.
    """
    count = len(frames)
    H = _prior(models, stamps[:count], poses[:count]) + _measured(rig, models, poses, points, frames)
    covariance = np.linalg.inv(H)
    own = np.arange(6 * count).reshape(count, 6)
    return np.asarray(covariance[own[:, :, None], own[:, None, :]])


def _measured(
    rig: StereoRig, models: EstimatorModels, poses: Array, points: Array, frames: Sequence[Observations]
) -> Array:
    """Information (6F, 6F) of the measurements, landmarks eliminated."""
    frame = np.repeat(np.arange(len(frames)), [len(o) for o in frames])
    ids = np.concatenate([o.ids for o in frames])
    stereo = np.concatenate([o.has_stereo for o in frames])
    R, r = poses[frame, :3, :3], poses[frame, :3, 3]
    h = np.einsum("nji,nj->ni", R, points[ids] - r)
    J = rig.project_stereo(h)[1] / models.pixel_sigma
    J[~stereo, 2] = 0.0
    by_pose = np.concatenate([J @ se3.hat(h), -J], axis=2)  # T exp(ξ) moves h by h × ξ_rotation − ξ_translation
    by_point = J @ np.swapaxes(R, 1, 2)
    H = np.zeros((6 * len(frames),) * 2)
    order = np.argsort(ids, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1):
        if stereo[rows].any():  # a landmark joins the map where its depth is seen; without, it tells next to nothing
            _add_landmark(H, frame[rows], by_pose[rows], by_point[rows])
    return H


def _add_landmark(H: Array, frame: np.ndarray, by_pose: Array, by_point: Array) -> None:
    """What one landmark's measurements, in different frames, tell about the poses."""
    columns = (6 * frame[:, None] + np.arange(6)).reshape(-1)
    m = len(frame)
    A = np.zeros((m, 3, m, 6))
    A[np.arange(m), :, np.arange(m)] = by_pose
    A, B = A.reshape(3 * m, 6 * m), by_point.reshape(3 * m, 3)
    mixed = A.T @ B
    H[np.ix_(columns, columns)] += A.T @ A - mixed @ np.linalg.solve(B.T @ B, mixed.T)


def _prior(models: EstimatorModels, stamps: Array, poses: Array) -> Array:
    """Information (6F, 6F) of the first pose, the first velocity, and the changes of velocity (paper B, section 2).

    The model's velocity after a step is the step over its time, so that velocities need no variables of their own.
    """
    count = len(stamps)
    H = np.zeros((6 * count,) * 2)
    first = np.repeat([models.initial_rotation_sigma, models.initial_position_sigma], 3)
    H[:6, :6] = np.diag(first**-2.0)
    before = None
    for k in range(1, count):
        dt = stamps[k] - stamps[k - 1]
        linear, angular = models.motion.velocity_variance(dt)
        velocity = _velocity_jacobian(poses, k, count, dt)
        variance = np.repeat([angular, linear], 3)
        if before is None:
            priors = (models.initial_angular_velocity_sigma, models.initial_velocity_sigma)
            variance = variance + np.repeat(priors, 3) ** 2
            change = velocity
        else:
            change = velocity - before
        nonzero = slice(6 * max(0, k - 2), 6 * (k + 1))
        part = change[:, nonzero]
        H[nonzero, nonzero] += part.T @ (part / variance[:, None])
        before = velocity
    return H


def _velocity_jacobian(poses: Array, k: int, count: int, dt: float) -> Array:
    """Derivative (6, 6F) of the angular velocity in body axes and of the linear one in the world, over step k."""
    J = np.zeros((6, 6 * count))
    R_before, R = poses[k - 1, :3, :3], poses[k, :3, :3]
    now, last = slice(6 * k, 6 * k + 6), slice(6 * k - 6, 6 * k)
    J[:3, now][:, :3] = np.eye(3) / dt
    J[:3, last][:, :3] = -R.T @ R_before / dt
    J[3:, now][:, 3:] = R / dt
    J[3:, last][:, 3:] = -R_before / dt
    return J
