"""Poses with their joint covariance: those of the window, and the next one as predicted from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.data import IndexArray
from slam.geometry.se3 import Array, adjoint, inverse

_ROUNDING = 1e-7  # numerics: of correlations
_TINY = 1e-150  # numerics: standard deviation that keeps a division possible


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
        return sound(0.5 * (P + P.T))

    def covariance_to(self, place: int) -> Array:
        """Covariance (6, 6) where one pose of the window is known: what all have in common moves the landmarks too."""
        if not len(self.window):
            return self.noise
        J = self.by_window.copy()
        J[:, 6 * place : 6 * place + 6] -= adjoint(inverse(self.T) @ self.window.poses[place])
        return J @ self.window.covariance @ J.T + self.noise


def sound(P: Array) -> Array:
    """A covariance (n, n) as it is; where rounding has spoilt it, the nearest one.

    After hours without a frame variances are so large that their inverse holds no digit of the smallest.
    """
    scale = np.sqrt(np.abs(np.diag(P))) + _TINY
    C = P / scale / scale[:, None]
    try:
        np.linalg.cholesky(C + _ROUNDING * np.eye(len(C)))
        if (np.abs(C - C.T) < _ROUNDING).all():
            return P
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(0.5 * (C + C.T))
    return np.asarray((vectors * np.maximum(values, _ROUNDING)) @ vectors.T * scale * scale[:, None])
