"""Poses with their joint covariance: those of the window, and the next one as predicted from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.data import IndexArray
from slam.geometry.se3 import Array, adjoint, inverse


@dataclass(frozen=True)
class PoseSet:
    """Poses with their joint covariance.

    Attributes:
        frames: their frames (W,), ascending.
        poses: (W, 4, 4).
        covariance: (6 W, 6 W).
    """

    frames: IndexArray
    poses: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True)
class PredictedPose:
    """The newest pose before its measurements.

    Attributes:
        stamp: time [s].
        T: predicted pose (4, 4).
        by_window: its Jacobian (6, 6 W) by the poses of the window.
        noise: covariance (6, 6) of what the motion adds.
        window: the poses that it is predicted from.
    """

    stamp: float
    T: Array
    by_window: Array
    noise: Array
    window: PoseSet

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6)."""
        P = self.by_window @ self.window.covariance @ self.by_window.T + self.noise
        return np.asarray(0.5 * (P + P.T))

    def covariance_to(self, place: int) -> Array:
        """Covariance (6, 6) where one pose of the window is known: what all have in common moves the landmarks too."""
        if not len(self.window):
            return self.noise
        J = self.by_window.copy()
        J[:, 6 * place : 6 * place + 6] -= adjoint(inverse(self.T) @ self.window.poses[place])
        return J @ self.window.covariance @ J.T + self.noise
