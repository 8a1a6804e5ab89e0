"""A camera that was carried off: it is found again where the prediction, however vague, would not have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry.se3 import Array, inverse, log
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend, MapBackend
from slam.models import EstimatorModels

_SIGMAS = 3.0
_LEAST_VARIANCE = 1e-12  # of a landmark's place along any direction [m²]
_SLACK = 0.05  # between two poses found one by one [m], [rad]


@dataclass(frozen=True)
class PoseHypotheses:
    """Poses, all far from the predicted ones, on which landmarks agreed in frame after frame.

    Attributes:
        count: how many in a row agree with each other.
        stamp: of the last one [s].
        T_world_left: the last one (4, 4).
    """

    count: int = 0
    stamp: float = float("nan")
    T_world_left: Array | None = None

    def after(self, T_world_left: Array, stamp: float, models: EstimatorModels) -> PoseHypotheses:
        """With one more pose, which agrees with the last one if a camera may have moved so far meanwhile."""
        if self.T_world_left is None:
            return PoseHypotheses(1, stamp, T_world_left)
        step, dt = log(inverse(self.T_world_left) @ T_world_left), stamp - self.stamp
        turn = np.linalg.norm(step[:3]) < _SLACK + _SIGMAS * models.initial_angular_velocity_sigma * dt
        way = np.linalg.norm(step[3:]) < _SLACK + _SIGMAS * models.initial_velocity_sigma * dt
        return PoseHypotheses(self.count + 1 if turn and way else 1, stamp, T_world_left)


def transfer_landmarks(old: Backend, new: Backend) -> Trajectory:
    """Give a new back end the landmarks of an old one.

    What the landmarks' errors have in common is lost, as with a map from a file.

    Returns:
        the path that the old one leaves, but for its newest pose.
    """
    assert isinstance(new, MapBackend)
    whole = old.estimate()
    covariances = 0.5 * (whole.covariances + np.swapaxes(whole.covariances, 1, 2))
    short = np.maximum(_LEAST_VARIANCE - np.linalg.eigvalsh(covariances)[:, 0], 0)  # by rounding
    covariances = covariances + short[:, None, None] * np.eye(3)
    new.insert(whole.ids, whole.positions, covariances)
    path = old.trajectory()
    return Trajectory(path.stamps[:-1], path.poses[:-1])
