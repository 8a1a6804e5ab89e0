"""Poses far from the prediction on which landmarks agree: is the camera kidnapped (moved while it saw nothing)?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.chi_square import SIGMAS
from slam.geometry.se3 import Array, inverse, log
from slam.models import EstimatorModels

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
        turn = np.linalg.norm(step[:3]) < _SLACK + SIGMAS * models.initial_angular_velocity_sigma * dt
        way = np.linalg.norm(step[3:]) < _SLACK + SIGMAS * models.initial_velocity_sigma * dt
        return PoseHypotheses(self.count + 1 if turn and way else 1, stamp, T_world_left)
