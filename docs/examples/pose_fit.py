"""The least that makes a back end: landmarks stay where they were first seen, each pose is fitted to them alone."""

import numpy as np

from slam.data import Estimate, Prediction, UpdateReport, UpdateStatus
from slam.geometry.rig import measurement_rows
from slam.geometry.se3 import inverse, transform
from slam.guarded import guarded
from slam.window.consensus import find_consensus


@guarded
class PoseFit:
    def __init__(self, rig, models):
        self.rig, self.models = rig, models
        self.T, self.P = models.initial_pose, 1e-4 * np.eye(6)  # T_world_left, and its covariance: guessed
        self.points, self.stamp = {}, None

    def predict(self, stamp):
        self.stamp = stamp  # the camera stays where it is: no model of motion
        ids = np.array(sorted(self.points), np.int64)
        local = transform(inverse(self.T), self._places(ids))
        view = self.rig.left.in_view(local)
        left, right = self.rig.project(local[view])
        innovation = np.tile(100.0 * np.eye(2), (int(view.sum()), 1, 1))  # landmarks may lie 10 px off
        return Prediction(stamp, self.T, self.P, ids[view], left, right, innovation)

    def update(self, observations, guess=None):
        seen, sigma = observations, self.models.pixel_sigma
        if len(seen) < 3:
            return UpdateReport.nothing(UpdateStatus.EMPTY, "fewer than 3 landmarks")
        measured = measurement_rows(seen.uv_left, seen.uv_right)
        start = self.T if guess is None else guess
        found = find_consensus(self.rig, self._places(seen.ids), measured, start, 4 * sigma, 64, seed=0)
        self.T = found.T_world_left
        used, rejected = seen.ids[found.inliers], seen.ids[~found.inliers]
        return UpdateReport(UpdateStatus.OK, "", used, rejected, float("nan"), 0)

    def add(self, observations):
        local = self.rig.triangulate(observations.uv_left, observations.uv_right)
        self.points.update(zip(observations.ids.tolist(), transform(self.T, local)))

    def remove(self, ids):
        for i in np.asarray(ids).tolist():
            del self.points[i]

    def _places(self, ids):  # `positions`, for others, is guarded's
        return np.array([self.points[int(i)] for i in ids]).reshape(-1, 3)

    def estimate(self, landmarks=True):
        ids = np.array(sorted(self.points) if landmarks else [], np.int64)
        spread = np.tile(0.01 * np.eye(3), (len(ids), 1, 1))
        return Estimate(self.stamp, self.T, self.P, ids, self._places(ids), spread)
