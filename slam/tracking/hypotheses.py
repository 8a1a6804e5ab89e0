"""Detects a kidnapped camera (moved while it saw nothing) by poses far from the prediction that agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.chi_square import SIGMAS
from slam.geometry.se3 import Array, inverse, log
from slam.models import EstimatorModels

_SLACK = 0.05  # error of two poses found independently [m], [rad]


@dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """Poses far from the predictions, on which landmarks agreed in successive frames.

    Attributes:
        count: number of successive poses that agree with each other.
        stamp: of the last one [s].
        T_world_left: the last one (4, 4).
    """

    count: int = 0
    stamp: float = float("nan")
    T_world_left: Array | None = None

    def after(self, T_world_left: Array, stamp: float, models: EstimatorModels) -> PoseHypotheses:
        """A copy with one more pose, which agrees with the last one if the camera may have moved that far meanwhile."""
        if self.T_world_left is None:
            return PoseHypotheses(1, stamp, T_world_left)
        step, dt = log(inverse(self.T_world_left) @ T_world_left), stamp - self.stamp
        turn = np.linalg.norm(step[:3]) < _SLACK + SIGMAS * models.initial_angular_velocity_sigma * dt
        way = np.linalg.norm(step[3:]) < _SLACK + SIGMAS * models.initial_velocity_sigma * dt
        return PoseHypotheses(self.count + 1 if turn and way else 1, stamp, T_world_left)
