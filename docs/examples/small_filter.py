"""A whole back end: an extended Kalman filter of the camera's pose and velocity and of all landmarks."""

import numpy as np
from scipy.linalg import block_diag

from slam.data import Estimate, Prediction, UpdateReport, UpdateStatus
from slam.geometry.arrays import LandmarkRows
from slam.geometry.se3 import adjoint, exp, inverse, points_by_pose, transform
from slam.guarded import guarded
from slam.window.gating import squared_distances
from slam.window.motion import velocity_sigmas
from slam.window.stereo import RectifiedMeasurement


@guarded
class SmallFilter:
    def __init__(self, rig, models):
        self.measure, self.map = RectifiedMeasurement(rig, models), LandmarkRows(np.zeros(0, np.int64))
        self.stamp, self.T, self.rate, self.points = np.nan, models.initial_pose, np.zeros(6), np.zeros((0, 3))
        sigmas = [models.initial_rotation_sigma, models.initial_position_sigma, 0, 0]
        self.P = np.diag(np.repeat(sigmas, 3) ** 2)  # of [turn, shift], of their rates, and of points in the world

    def seen(self, rows):  # landmarks as seen from the camera (M, 3), and their derivatives (M, 3, n)
        local, R_left_world = transform(inverse(self.T), self.points[rows]), self.T[:3, :3].T
        by_pose, by_points = points_by_pose(local).reshape(-1, 6), np.kron(np.eye(len(self.points))[rows], R_left_world)
        return local, np.hstack([by_pose, 0 * by_pose, by_points]).reshape(len(rows), 3, len(self.P))

    def predict(self, stamp):  # an impulse changes the velocity, which then stays, for ten seconds at most
        dt, F = min(np.nan_to_num(stamp - self.stamp), 10.0), np.eye(len(self.P))
        F[:6, :12] = np.hstack([adjoint(exp(-dt * self.rate)), dt * np.eye(6)])
        self.P[6:12, 6:12] += np.diag(velocity_sigmas(self.measure.models, dt, np.isnan(self.stamp)) ** 2)
        self.stamp, self.T, self.P = stamp, self.T @ exp(dt * self.rate), F @ self.P @ F.T
        rows = self.measure.visible(self.T, self.points)
        local, A = self.seen(rows)
        pixels = self.measure.pixels(local, A @ self.P @ A.transpose(0, 2, 1))
        return Prediction(stamp, self.T, self.P[:6, :6], self.map.ids[rows], *pixels)

    def update(self, observations, guess=None):
        ids, variance = observations.ids, self.measure.models.pixel_sigma**2
        local, A = self.seen(self.map.rows_of(ids))
        h, D = self.measure.stereo.project(local)
        nu, H = self.measure.stereo.measure(observations) - h, D @ A
        distances = squared_distances(nu, H @ self.P @ H.transpose(0, 2, 1) + variance * np.eye(3))
        good = distances <= self.measure.limits(nu)
        there = good[:, None] & np.isfinite(nu)  # a right pixel may be missing
        nu, H = nu[there], H[there]
        S = H @ self.P @ H.T + variance * np.eye(len(H))
        K = np.linalg.solve(S, H @ self.P).T
        x, L = K @ nu, np.eye(len(self.P)) - K @ H  # Joseph's form stays definite, however large P was
        self.T, self.rate, self.P = self.T @ exp(x[:6]), self.rate + x[6:12], L @ self.P @ L.T + variance * K @ K.T
        self.points = self.points + x[12:].reshape(-1, 3)
        return UpdateReport(UpdateStatus.OK, "", ids[good], ids[~good], nu @ np.linalg.solve(S, nu), len(nu))

    def add(self, observations):
        local, noise, _ = self.measure.first_sight(observations.ids, self.measure.stereo.measure(observations))
        R, J = self.T[:3, :3], np.eye(len(self.P) + 3 * len(local), len(self.P))
        J[len(self.P) :, :6] = -(R @ points_by_pose(local)).reshape(-1, 6)
        self.P = J @ self.P @ J.T + block_diag(0 * self.P, *(R @ noise @ R.T))
        self.points = np.concatenate([self.points, transform(self.T, local)])
        self.map = self.map.joined(LandmarkRows(observations.ids))

    def remove(self, ids):
        stay = ~np.isin(self.map.ids, ids)
        kept = np.append(np.full(12, True), np.repeat(stay, 3))
        self.P, self.points, self.map = self.P[kept][:, kept], self.points[stay], self.map.select(stay)

    def estimate(self, landmarks=True):
        rows, n = self.map.order if landmarks else [], len(self.points)
        blocks = self.P[12:, 12:].reshape(n, 3, n, 3)[rows, :, rows]
        return Estimate(self.stamp, self.T, self.P[:6, :6], self.map.ids[rows], self.points[rows], blocks)
