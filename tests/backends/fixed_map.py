"""A small back end as somebody else might write one: landmarks stay where they were first seen, poses are fitted.

It shows how little the contract asks for, and stands for a third-party package in the tests.
"""

from __future__ import annotations

import numpy as np

from slam.data import Estimate, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.window.consensus import find_consensus
from slam.window.gating import chi_square_gate

MODELS = EstimatorModels()


class FixedMapBackend:
    """Pose by least squares on a map that is never corrected; a landmark's noise is that of its first sight."""

    def __init__(self, rig: StereoRig, models: EstimatorModels = MODELS, **options) -> None:
        if options:
            raise ConfigurationError(f"fixed map: unknown option {min(options)!r}; there are none")
        self.rig, self.models = rig, models
        self.stamps: list[float] = []
        self.poses: list[np.ndarray] = []
        self.measured = True  # whether the newest pose may not be updated any more
        self.covariance = np.diag(np.repeat([models.initial_rotation_sigma**2, models.initial_position_sigma**2], 3))
        self.landmarks: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # position (3,), covariance (3, 3)

    def predict(self, stamp):
        if not np.isfinite(stamp) or (self.stamps and stamp <= self.stamps[-1]):
            raise MeasurementError(f"stamp {stamp}: time must be finite and increase")
        T = self.models.initial_pose
        if self.stamps:
            T = self._extrapolate(stamp)
            dt = min(stamp - self.stamps[-1], 1000.0)
            linear, angular = self.models.motion.velocity_variance(dt)
            # a pose extrapolated from two: 2² + 1² times the noise of one
            self.covariance = 5 * self.covariance + dt**2 * np.diag(np.repeat([angular, linear], 3))
            self.covariance *= min(1.0, 1e6 / np.trace(self.covariance))
        self.stamps.append(float(stamp))
        self.poses.append(T)
        self.measured = False
        ids, points, covariances = self._rows(sorted(self.landmarks))
        seen = self.rig.left.in_view(self._local(points))
        h = self._local(points[seen])
        left, right = self.rig.project(h)
        S = self._spread(h, covariances[seen])[:, :2, :2] + self.models.pixel_sigma**2 * np.eye(2)
        return Prediction(float(stamp), T.copy(), self.covariance.copy(), ids[seen], left, right, S)

    def update(self, observations, guess=None):
        if not self.stamps:
            raise MeasurementError("update before the first predict")
        if self.measured:
            raise MeasurementError("a stamp has one update, right after its predict")
        _, points, covariances = self._rows(observations.ids)
        self.measured = True
        if not len(points):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "nothing was observed")
        measured = np.concatenate([observations.uv_left, observations.uv_right[:, :1]], axis=1)
        start = self.poses[-1] if guess is None else guess
        consensus = find_consensus(self.rig, points, measured, start, 8 * self.models.pixel_sigma, 50, seed=0)
        self.poses[-1] = consensus.T_world_left
        h = self._local(points)
        z, J = self.rig.project_stereo(h)
        S = self._spread(h, covariances, pose=False) + self.models.pixel_sigma**2 * np.eye(3)
        used = consensus.inliers & chi_square_gate(measured - z, S, self.models.gate_probability)
        if used.sum() < 3:
            return UpdateReport.nothing(UpdateStatus.FAILED, "too few observations agree", observations.ids[~used])
        by_pose = np.concatenate([J @ se3.hat(h), -J], axis=2)
        kept = np.isfinite(measured[used])
        information, nis = np.zeros((6, 6)), 0.0
        for k, nu, A, V in zip(kept, (measured - z)[used], by_pose[used], S[used]):
            information += A[k].T @ np.linalg.solve(V[np.ix_(k, k)], A[k])
            nis += nu[k] @ np.linalg.solve(V[np.ix_(k, k)], nu[k])
        P = np.linalg.inv(information + np.linalg.inv(self.covariance))
        self.covariance = 0.5 * (P + P.T)
        ids = observations.ids
        return UpdateReport(UpdateStatus.OK, "", ids[used], ids[~used], float(nis), int(kept.sum()))

    def add(self, observations: Observations):
        if not self.stamps:
            raise MeasurementError("add before the first predict")
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)
        if not np.isfinite(h).all() or any(i in self.landmarks for i in observations.ids.tolist()):
            raise MeasurementError("a landmark has no depth or is in the map already")
        self.measured = self.measured or len(observations) > 0
        R, t = self.poses[-1][:3, :3], self.poses[-1][:3, 3]
        noise = self.rig.triangulation_covariance(h, self.models.pixel_sigma)
        by_pose = np.concatenate([-se3.hat(h), np.tile(np.eye(3), (len(h), 1, 1))], axis=2)
        noise = noise + by_pose @ self.covariance @ np.swapaxes(by_pose, 1, 2)
        for i, position, P in zip(observations.ids.tolist(), h @ R.T + t, R @ noise @ R.T):
            self.landmarks[i] = position, P

    def remove(self, ids):
        self._rows(ids)
        for i in np.asarray(ids).tolist():
            del self.landmarks[i]

    def estimate(self, landmarks=True):
        ids, points, covariances = self._rows(sorted(self.landmarks) if landmarks else [])
        return Estimate(self.stamps[-1], self.poses[-1].copy(), self.covariance.copy(), ids, points, covariances)

    def positions(self, ids):
        return self._rows(ids)[1]

    def trajectory(self):
        return Trajectory(np.array(self.stamps), np.array(self.poses).reshape(-1, 4, 4))

    def _extrapolate(self, stamp):
        if len(self.stamps) < 2:
            return self.poses[-1].copy()
        share = (stamp - self.stamps[-1]) / (self.stamps[-1] - self.stamps[-2])
        return self.poses[-1] @ se3.exp(share * se3.log(se3.inverse(self.poses[-2]) @ self.poses[-1]))

    def _local(self, points):
        return se3.transform(se3.inverse(self.poses[-1]), points)

    def _spread(self, h, covariances, pose=True):
        _, J = self.rig.project_stereo(h)
        R = self.poses[-1][:3, :3]
        P = R.T @ covariances @ R
        if pose:
            by_pose = np.concatenate([se3.hat(h), np.tile(-np.eye(3), (len(h), 1, 1))], axis=2)
            P = P + by_pose @ self.covariance @ np.swapaxes(by_pose, 1, 2)
        return J @ P @ np.swapaxes(J, 1, 2)

    def _rows(self, ids):
        try:
            rows = [self.landmarks[int(i)] for i in ids]
        except KeyError as error:
            raise MeasurementError(f"landmark {error.args[0]} is not in the map") from None
        points = np.array([row[0] for row in rows]).reshape(-1, 3)
        return np.array(list(ids), np.int64), points, np.array([row[1] for row in rows]).reshape(-1, 3, 3)
