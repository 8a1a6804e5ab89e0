"""The smoother's estimates with covariances: the newest pose, the poses of the window, and the landmarks.

All follow from the factor graph; results are cached until the graph changes.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from backends.smoother import uncertainty
from backends.smoother.factor_graph import FactorGraph
from backends.smoother.pose_set import PoseSet, sound
from backends.smoother.prediction import (
    PredictedPoints,
    PredictedPose,
    first_pose,
    predict_points,
    predict_pose,
    propagated_covariance,
)
from backends.smoother.solver import SolverError
from backends.smoother.uncertainty import WindowJacobians
from backends.smoother.variables import pose_key
from slam.data import IndexArray
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window import recovery
from slam.window.agreement import MIN_CONSENSUS


class Belief:
    """Poses and landmarks of a factor graph with covariances.

    Args:
        graph: the factor graph.
        models: priors and motion.
    """

    def __init__(self, graph: FactorGraph, models: EstimatorModels) -> None:
        self._graph = graph
        self._models = models
        self._log = graph.log
        self._window: PoseSet | None = None  # the last one that was worked out
        self._window_at = -1  # `graph.solutions` then
        self._jacobians: WindowJacobians | None = None
        self._jacobians_at = -1  # `graph.placements` then

    def predicted(self, stamp: float) -> PredictedPose:
        """The pose at a later time [s], by the motion model, or by the prior where there is no pose yet."""
        if not self._log.path.count:
            return first_pose(self._models, stamp)
        return predict_pose(self._models, self._log.path, self.window(), stamp)

    def newest(self) -> tuple[float, Array, Array]:
        """Stamp [s], pose (4, 4) and covariance (6, 6) of the newest pose, predicted or measured."""
        path, window = self._log.path, self.window()
        if path.predicted is not None:
            return path.predicted.stamp, path.predicted.T.copy(), path.predicted.covariance
        return float(path.stamps[-1]), path.poses[-1].copy(), window.covariance[-6:, -6:].copy()

    # --- poses ---

    def window(self) -> PoseSet:
        """The newest poses with their joint covariance."""
        if self._window is None or self._window_at != self._graph.solutions:
            count = self._log.path.count
            frames = self._log.window(self._graph.config.window)
            P = sound(self._joint_covariance(frames)) if count else np.zeros((0, 0))
            self._window = PoseSet(frames, self._log.path.poses[frames], P)
            self._window_at = self._graph.solutions
        return self._window

    def last_poses(self, count: int) -> PoseSet:
        """The window; or the last `count` poses if it lacks some of them, as it skips those without measurements."""
        window, path = self.window(), self._log.path
        frames = np.arange(max(self._log.history.first, path.count - count), path.count)
        if np.isin(frames, window.frames).all():
            return window
        try:
            return PoseSet(frames, path.poses[frames], self._graph.joint_covariance(_keys(frames)))
        except SolverError:
            return window

    def _joint_covariance(self, frames: IndexArray) -> Array:
        """Joint covariance of poses; where the solver cannot give it, the last one propagated by the motion model."""
        with suppress(SolverError):
            return self._graph.joint_covariance(_keys(frames))
        self._graph.recover()
        with suppress(SolverError):
            return self._graph.joint_covariance(_keys(frames))
        last = self._window if self._window is not None and len(self._window) else None
        return propagated_covariance(self._models, self._log.path, last, frames)

    def last_measured(self) -> int:
        """Place in the window of the newest pose that measured landmarks; of the last one where none did."""
        frames, measured = self.window().frames, self._log.path.measured
        return int(np.searchsorted(frames, measured[-1])) if measured else len(frames) - 1

    def lost(self) -> bool:
        """Whether the orientation in the world of the newest pose that measured landmarks is unknown.

        The landmarks that it measured cannot be linearised then.
        """
        window, path = self.window(), self._log.path
        if not len(window) or not path.measured or not recovery.unknown_turn(window.covariance[-6:, -6:]):
            return False
        newest = path.measured[-1]
        if np.count_nonzero(self._log.measurements.frame == newest) < MIN_CONSENSUS:
            return False
        with suppress(SolverError):  # the oldest pose, where it is held, may be turned in the world by any angle
            return recovery.unknown_turn(self._graph.solver.joint_covariance([pose_key(newest)]))
        return False

    # --- landmarks ---

    def landmarks_by_window(self, slots: IndexArray) -> Array:
        """Jacobians (M, 3, 6 W) of landmark positions by the poses of the window."""
        window, placements = self.window(), self._graph.placements
        if self._jacobians is None or self._jacobians_at != placements or self._jacobians.window is not window:
            self._jacobians = WindowJacobians(window, len(self._log.landmarks.ids))
            self._jacobians_at = placements
        return self._jacobians.of(self._log.measurements, self._log.landmarks, slots)

    def landmark_covariances(self, slots: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmark positions.

        Exact for variables that were measured lately, which the solver gives quickly. For the others, poses older than
        the window are taken as fixed to its oldest pose; these covariances are a little too large.
        """
        marks, path = self._log.landmarks, self._log.path
        if not path.count:  # a map that is known, and no pose in it yet
            return marks.covariance[slots]
        P = uncertainty.quadratic(self.landmarks_by_window(slots), self.window().covariance) + marks.covariance[slots]
        variables = marks.variable[slots].tolist()
        try:
            exact = self._graph.solver.point_covariances(
                variables, pose_key(path.count - 1), self._log.history.reference
            )
        except SolverError:
            return P
        for row, key in enumerate(variables):
            if key in exact:
                P[row] = exact[key]
        return P

    def covariances_from_measured(self) -> Array:
        """Covariances (N, 3, 3) of all landmarks, by slot, relative to the newest pose that measured any.

        In world axes.
        """
        window, marks, place = self.window(), self._log.landmarks, self.last_measured()
        slots = marks.used()
        J = self.landmarks_by_window(slots).copy()
        J[:, :, 6 * place : 6 * place + 6] -= uncertainty.moved_with_pose(window.poses[place], marks.position[slots])
        return uncertainty.quadratic(J, window.covariance) + marks.covariance[slots]

    def points(self, predicted: PredictedPose, slots: IndexArray) -> PredictedPoints:
        """Landmarks as seen from a predicted pose."""
        marks, by_window = self._log.landmarks, self.landmarks_by_window(slots)
        return predict_points(predicted, marks.position[slots], marks.covariance[slots], by_window)


def _keys(frames: IndexArray) -> list[int]:
    return [pose_key(i) for i in frames.tolist()]
