"""The twist on which the velocities of a rigid body's points agree: ``V_i = v + ω × (p_i − c)``, linear in (ω, v).

A weak prior on ω keeps fits of few, close points from turning wildly; depth noise makes that the rule.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array, hat

_TURN_SIGMA = 1.0  # of the angular velocity, before anything is known [rad/s]


def fit_twist(positions: Array, velocities: Array, information: Array, centre: Array) -> tuple[Array, Array]:
    """Twist [ω, v] (6,) at `centre` of points with velocities (K, 3) and information (K, 3, 3), and its covariance."""
    J = _twist_jacobian(positions, centre)
    JA = np.swapaxes(J, 1, 2) @ information
    prior = np.diag([1 / _TURN_SIGMA**2] * 3 + [1e-9] * 3)
    covariance = np.linalg.inv((JA @ J).sum(axis=0) + prior)
    return covariance @ (JA @ velocities[:, :, None]).sum(axis=0)[:, 0], covariance


def _twist_jacobian(positions: Array, centre: Array) -> Array:
    """``∂V/∂[ω, v]`` (K, 3, 6): ``ω × r = −[r]× ω``."""
    J = np.zeros((len(positions), 3, 6))
    J[:, :, :3] = -hat(positions - centre)
    J[:, :, 3:] = np.eye(3)
    return J
