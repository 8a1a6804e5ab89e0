"""A whole back end: an extended Kalman filter of the camera's pose and velocity and of all landmarks."""

import numpy as np

from slam.checks import require_guess, require_not_measured, require_stamp
from slam.chi_square import chi_square_limit
from slam.data import Estimate, Prediction, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry.arrays import LandmarkRows
from slam.geometry.se3 import adjoint, exp, inverse, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels


class SmallFilter:
    def __init__(self, rig, models=None, **options):
        if options:
            raise ConfigurationError(f"SmallFilter has no option {next(iter(options))}")
        self.rig, self.models = rig, (m := models or EstimatorModels())
        sigmas = (
            m.initial_rotation_sigma,
            m.initial_position_sigma,
            m.initial_angular_velocity_sigma,
            m.initial_velocity_sigma,
        )
        self.P = np.diag(np.repeat(sigmas, 3) ** 2)  # of [turn, shift] and their rates, in camera axes, then of points
        self.T, self.rate, self.closed = m.initial_pose, np.zeros(6), True
        self.points, self.marks, self.stamps, self.poses = np.zeros((0, 3)), LandmarkRows(np.zeros(0, np.int64)), [], []

    def _expected(self, rows):  # pixels (uL, vL, uR) of landmarks, their derivatives, and covariances with noise
        h, n, R = transform(inverse(self.T), self.points[rows]), np.arange(len(rows)), self.T[:3, :3]
        z, J = self.rig.project_stereo(h)
        H = np.zeros((len(rows), 3, len(self.P)))
        H[:, :, :6] = J @ points_by_pose(h)
        for k in range(3):
            H[n, :, 12 + 3 * rows + k] = J @ R[k]
        HP = (H.reshape(-1, len(self.P)) @ self.P).reshape(H.shape)
        return z, H, HP @ H.transpose(0, 2, 1) + self.models.pixel_sigma**2 * np.eye(3)

    def predict(self, stamp):
        require_stamp("SmallFilter", stamp, self.stamps[-1] if self.stamps else None)
        if self.stamps:  # constant velocity, disturbed by impulses
            dt, F = stamp - self.stamps[-1], np.eye(len(self.P))
            step, W = exp(dt * self.rate), np.concatenate([dt * np.eye(6), np.eye(6)])
            F[:6, :6], F[:6, 6:12] = adjoint(inverse(step)), dt * np.eye(6)
            self.T, self.P = self.T @ step, F @ self.P @ F.T
            self.P[:12, :12] += W * np.repeat(self.models.motion.velocity_variance(dt)[::-1], 3) @ W.T
        self.stamps.append(float(stamp))
        self.poses.append(self.T)
        self.closed, rows = False, np.flatnonzero(self.rig.left.in_view(transform(inverse(self.T), self.points)))
        z, _, S = self._expected(rows)
        P = self.P[:6, :6].copy()
        return Prediction(float(stamp), self.T.copy(), P, self.marks.ids[rows], z[:, :2], z[:, [2, 1]], S[:, :2, :2])

    def update(self, observations, guess=None):
        seen, rows, m = observations, self._rows(observations.ids), self.models
        require_not_measured("SmallFilter", self.closed)
        require_guess("SmallFilter", guess)
        self.closed, (z, H, S) = True, self._expected(rows)
        nu = np.concatenate([seen.uv_left, seen.uv_right[:, :1]], axis=1) - z
        there = np.isfinite(nu)  # a right pixel may be missing
        nu, H = np.where(there, nu, 0.0), np.where(there[:, :, None], H, 0.0)
        distances = np.einsum("ni,ni->n", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0])
        good = there[:, 0] & (distances < chi_square_limit(3, m.gate_probability))
        if not good.any():
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was seen where it is expected", seen.ids)
        H, nu = H[good][there[good]], nu[good][there[good]]
        S = H @ self.P @ H.T + m.pixel_sigma**2 * np.eye(len(H))
        K = np.linalg.solve(S, H @ self.P).T
        x, P = K @ nu, self.P - K @ S @ K.T
        self.T, self.rate, self.P = self.T @ exp(x[:6]), self.rate + x[6:12], 0.5 * (P + P.T)
        self.points, self.poses[-1] = self.points + x[12:].reshape(-1, 3), self.T
        nis = float(nu @ np.linalg.solve(S, nu))
        return UpdateReport(UpdateStatus.OK, "", seen.ids[good], seen.ids[~good], nis, len(nu))

    def add(self, observations):
        self._rows([])
        self.marks.require_new(observations.ids)
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)
        if not np.isfinite(h).all():
            raise MeasurementError("SmallFilter: a landmark without depth")
        self.closed, R, n = True, self.T[:3, :3], len(self.P)
        A = np.eye(n + 3 * len(h), n)
        A[n:, :6] = -(R @ points_by_pose(h)).reshape(-1, 6)
        self.P = A @ self.P @ A.T
        for i, C in enumerate(R @ self.rig.triangulation_covariance(h, self.models.pixel_sigma) @ R.T):
            self.P[n + 3 * i : n + 3 * i + 3, n + 3 * i : n + 3 * i + 3] += C
        self.points = np.concatenate([self.points, transform(self.T, h)])
        self.marks = self.marks.joined(LandmarkRows(observations.ids))

    def _rows(self, ids):
        if not self.stamps:
            raise MeasurementError("SmallFilter: predict comes first")
        return self.marks.rows_of(ids)

    def remove(self, ids):
        gone = self._rows(ids)
        stay = np.setdiff1d(np.arange(12 + self.points.size), (12 + 3 * gone[:, None] + np.arange(3)).ravel())
        self.P, self.points = self.P[np.ix_(stay, stay)], np.delete(self.points, gone, axis=0)
        self.marks = LandmarkRows(np.delete(self.marks.ids, gone))

    def positions(self, ids):
        return self.points[self._rows(ids)]

    def estimate(self, landmarks=True):
        rows = self.marks.order if landmarks else np.zeros(0, np.intp)
        i = 12 + 3 * rows[:, None] + np.arange(3)
        blocks, P = self.P[i[:, :, None], i[:, None, :]], self.P[:6, :6].copy()
        return Estimate(self.stamps[-1], self.T.copy(), P, self.marks.ids[rows], self.points[rows], blocks)

    def trajectory(self):
        return Trajectory(np.array(self.stamps), np.array(self.poses).reshape(-1, 4, 4))
