"""Prediction of the newest pose and of the landmarks, and how well measurements fit it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.smoother import motion
from backends.smoother.path import Path
from backends.smoother.pose_set import PoseSet, PredictedPose
from backends.smoother.uncertainty import quadratic
from slam.data import IndexArray
from slam.geometry.se3 import Array, points_by_pose
from slam.models import EstimatorModels
from slam.window.gating import whiteners
from slam.window.pose_only import seen_from
from slam.window.stereo import RectifiedStereo


def predict_pose(models: EstimatorModels, path: Path, window: PoseSet, stamp: float) -> PredictedPose:
    """The next pose by the motion model."""
    stamps, poses = path.stamps, path.poses
    dt = motion.bounded(stamp - stamps[-1])
    J = np.zeros((6, 6 * len(window)))
    if path.count in path.rests:
        T, J[:, -6:], Jw = motion.predict_from_rest(poses[-1], 1.0)
        sigmas = motion.rest_sigmas()
    elif len(stamps) == 1 or path.jumped(path.count - 1):
        T, J[:, -6:], Jw = motion.predict_from_rest(poses[-1], dt)
        sigmas = motion.first_velocity_sigmas(models, dt)
    else:
        T, J[:, -12:-6], J[:, -6:], Jw = motion.predict(poses[-2], poses[-1], path.interval(len(stamps) - 1), dt)
        sigmas = motion.motion_sigmas(models, dt)
    return PredictedPose(stamp, T, J, (Jw * sigmas**2) @ Jw.T, window)


def first_pose(models: EstimatorModels, stamp: float) -> PredictedPose:
    """The first pose by its prior."""
    sigmas = np.repeat([models.initial_rotation_sigma, models.initial_position_sigma], 3)
    none = PoseSet(np.zeros(0, np.intp), np.zeros((0, 4, 4)), np.zeros((0, 0)))
    return PredictedPose(stamp, models.initial_pose, np.zeros((6, 0)), np.diag(sigmas**2), none)


def propagated_covariance(models: EstimatorModels, path: Path, known: PoseSet | None, frames: IndexArray) -> Array:
    """Joint covariance of successive poses up to the newest, propagated from an earlier set by the motion alone.

    Args:
        models: priors and motion.
        path: stamps and poses of all frames.
        known: the earlier set; None for the first pose.
        frames: the poses asked for (W,).
    """
    if known is None:
        prior = np.repeat([models.initial_rotation_sigma, models.initial_position_sigma], 3)
        known = PoseSet(np.zeros(1, np.intp), path.poses[:1], np.diag(prior**2))
    for i in range(int(known.frames[-1]) + 1, path.count):
        one = predict_pose(models, path.upto(i), known, float(path.stamps[i]))
        carry = np.concatenate([np.eye(6 * len(known)), one.by_window])
        P = carry @ known.covariance @ carry.T
        P[-6:, -6:] += one.noise
        known = PoseSet(np.append(known.frames, i), np.concatenate([known.poses, path.poses[i : i + 1]]), P)
    rows = np.concatenate([np.arange(6) + 6 * k for k in np.searchsorted(known.frames, frames)])
    return known.covariance[np.ix_(rows, rows)]


@dataclass(frozen=True, eq=False)
class PredictedPoints:
    """Landmarks in the predicted camera's coordinates.

    Attributes:
        predicted: the camera's pose.
        local: positions (M, 3).
        own: covariances (M, 3, 3) of the landmarks where all poses are known.
        by_camera: Jacobians (M, 3, 6) of `local` by what the motion adds to the pose.
        carried: Jacobians (M, 3, 6 W) of the landmarks in world coordinates by the poses of the window.
    """

    predicted: PredictedPose
    local: Array
    own: Array
    by_camera: Array
    carried: Array

    def by_window(self, J: Array) -> Array:
        """Jacobians (M, k, 6 W) by the poses of the window of what depends on `local` by J (M, k, 3)."""
        moved = (J @ self.by_camera).reshape(-1, 6) @ self.predicted.by_window
        by_landmark = (J @ self.predicted.T[:3, :3].T) @ self.carried
        return np.asarray(by_landmark + moved.reshape(by_landmark.shape))

    def covariance(self, J: Array) -> Array:
        """Covariances (M, k, k) of what depends on `local` by J (M, k, 3)."""
        from_window = quadratic(self.by_window(J), self.predicted.window.covariance)
        return from_window + quadratic(J @ self.by_camera, self.predicted.noise) + J @ self.own @ np.swapaxes(J, 1, 2)


def predict_points(predicted: PredictedPose, points: Array, own: Array, carried: Array) -> PredictedPoints:
    """Landmarks as seen from the predicted pose.

    Args:
        predicted: the pose.
        points: landmark positions (M, 3) in world coordinates.
        own: their covariances (M, 3, 3) where all poses are known.
        carried: their Jacobians (M, 3, 6 W) by the poses of the window.
    """
    local, own = seen_from(predicted.T, points, own)
    return PredictedPoints(predicted, local, own, points_by_pose(local), carried)


def normalised_innovation(
    stereo: RectifiedStereo, sigma: float, points: PredictedPoints, z: Array, step: Array
) -> tuple[float, int]:
    """``νᵀ S⁻¹ ν`` of measurements (M, 3) taken together, and its degrees of freedom.

    `points` are as seen from the solved pose, which lies `step` (6,) from the predicted one. The
    innovation at the prediction follows by linearising at the solved pose, which holds for long steps too.

    S is the innovations' joint covariance: from the poses of the window and the motion, common to all, and from each
    landmark's own. It is inverted by Woodbury's identity, as the poses are fewer.
    """
    predicted, (h, J) = points.predicted, stereo.project(points.local)
    r = z - h
    missing = ~np.isfinite(r)
    own = J @ points.own @ np.swapaxes(J, 1, 2) + sigma**2 * np.eye(3)
    W = whiteners(own)
    W[missing[:, 2], 2] = 0
    r = r + (J @ (points.by_camera @ step)[:, :, None])[:, :, 0]
    r[missing] = 0
    r = (W @ r[:, :, None]).reshape(-1)
    W = W @ J
    W[missing] = 0
    by_window, by_motion = points.by_window(W).reshape(len(r), -1), (W @ points.by_camera).reshape(-1, 6)
    G = np.concatenate([by_window @ _root(predicted.window.covariance), by_motion @ _root(predicted.noise)], axis=1)
    b, M = G.T @ r, G.T @ G
    M[np.diag_indices_from(M)] += 1
    return float(r @ r - b @ np.linalg.solve(M, b)), int((~missing).sum())


def _root(P: Array) -> Array:
    """A lower triangular L with ``L Lᵀ = P``; a little is added to the diagonal, as P may be nearly singular."""
    return np.linalg.cholesky(P + 1e-10 * np.diag(np.diag(P)))
