"""A whole back end: an extended Kalman filter of the camera's pose and velocity and of all landmarks."""

import numpy as np

from slam.chi_square import chi_square_limit
from slam.data import Estimate, Prediction, UpdateReport, UpdateStatus
from slam.geometry.rig import measurement_rows
from slam.geometry.se3 import adjoint, exp, inverse, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.guarded import guarded


@guarded
class SmallFilter:
    def __init__(self, rig, models):
        self.rig, self.models, self.T, self.rate = rig, models, models.initial_pose, np.zeros(6)
        pose, rates = ("rotation", "position"), ("angular_velocity", "velocity")
        sigmas = [getattr(models, f"initial_{what}_sigma") for what in (*pose, *rates)]
        self.P = np.diag(np.repeat(sigmas, 3) ** 2)  # of [turn, shift] and their rates, in camera axes, then of points
        self.points, self.ids, self.stamps, self.poses = np.zeros((0, 3)), np.zeros(0, np.int64), [], []

    def _rows(self, ids):
        return np.flatnonzero(ids[:, None] == self.ids) % max(len(self.ids), 1)

    def _expected(self, rows):  # pixels (uL, vL, uR) of landmarks, their derivatives, and covariances with noise
        h, n, R = transform(inverse(self.T), self.points[rows]), np.arange(len(rows)), self.T[:3, :3]
        z, J = self.rig.project_stereo(h)
        H = np.zeros((len(rows), 3, len(self.P)))
        H[:, :, :6] = J @ points_by_pose(h)
        for k in range(3):
            H[n, :, 12 + 3 * rows + k] = J @ R[k]
        return z, H, H @ self.P @ H.transpose(0, 2, 1) + self.models.pixel_sigma**2 * np.eye(3)

    def predict(self, stamp):
        if self.stamps:  # constant velocity, disturbed by impulses
            dt, F = stamp - self.stamps[-1], np.eye(len(self.P))
            step, W = exp(dt * self.rate), np.concatenate([dt * np.eye(6), np.eye(6)])
            F[:6, :6], F[:6, 6:12] = adjoint(inverse(step)), dt * np.eye(6)
            self.T, self.P = self.T @ step, F @ self.P @ F.T
            self.P[:12, :12] += W * np.repeat(self.models.motion.velocity_variance(dt)[::-1], 3) @ W.T
        self.stamps, self.poses = [*self.stamps, stamp], [*self.poses, self.T]
        rows = np.flatnonzero(self.rig.left.in_view(transform(inverse(self.T), self.points)))
        z, _, S = self._expected(rows)
        return Prediction(stamp, self.T, self.P[:6, :6], self.ids[rows], z[:, :2], z[:, [2, 1]], S[:, :2, :2])

    def update(self, observations, guess=None):
        ids, (z, H, S) = observations.ids, self._expected(self._rows(observations.ids))
        nu = measurement_rows(observations.uv_left, observations.uv_right) - z
        there = np.isfinite(nu)  # a right pixel may be missing
        nu, H = np.where(there, nu, 0.0), np.where(there[:, :, None], H, 0.0)
        distances = np.einsum("ni,ni->n", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0])
        good = there[:, 0] & (distances < chi_square_limit(3, self.models.gate_probability))
        if not good.any():
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was seen where it is expected", ids)
        H, nu = H[good][there[good]], nu[good][there[good]]
        S = H @ self.P @ H.T + self.models.pixel_sigma**2 * np.eye(len(H))
        K = np.linalg.solve(S, H @ self.P).T
        x, P = K @ nu, self.P - K @ S @ K.T
        self.T, self.rate, self.P = self.T @ exp(x[:6]), self.rate + x[6:12], 0.5 * (P + P.T)
        self.points, self.poses = self.points + x[12:].reshape(-1, 3), [*self.poses[:-1], self.T]
        return UpdateReport(UpdateStatus.OK, "", ids[good], ids[~good], float(nu @ np.linalg.solve(S, nu)), len(nu))

    def add(self, observations):
        h, R, n = self.rig.triangulate(observations.uv_left, observations.uv_right), self.T[:3, :3], len(self.P)
        A = np.eye(n + 3 * len(h), n)
        A[n:, :6] = -(R @ points_by_pose(h)).reshape(-1, 6)
        self.P = A @ self.P @ A.T
        for i, C in enumerate(R @ self.rig.triangulation_covariance(h, self.models.pixel_sigma) @ R.T):
            self.P[n + 3 * i : n + 3 * i + 3, n + 3 * i : n + 3 * i + 3] += C
        self.points = np.concatenate([self.points, transform(self.T, h)])
        self.ids = np.concatenate([self.ids, observations.ids])

    def remove(self, ids):
        stay = ~np.isin(self.ids, ids)
        numbers = np.flatnonzero(np.append(np.ones(12, bool), np.repeat(stay, 3)))
        self.P, self.points, self.ids = self.P[np.ix_(numbers, numbers)], self.points[stay], self.ids[stay]

    def positions(self, ids):
        return self.points[self._rows(ids)]

    def estimate(self, landmarks=True):
        rows = np.argsort(self.ids) if landmarks else np.zeros(0, np.intp)
        i = 12 + 3 * rows[:, None] + np.arange(3)
        blocks = self.P[i[:, :, None], i[:, None, :]]
        return Estimate(self.stamps[-1], self.T, self.P[:6, :6], self.ids[rows], self.points[rows], blocks)

    def trajectory(self):
        return Trajectory(np.array(self.stamps), np.array(self.poses).reshape(-1, 4, 4))
