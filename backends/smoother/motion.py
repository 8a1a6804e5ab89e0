"""The papers' motion model on poses alone: prediction, its Jacobians, and the residual of three successive poses.

Paper B, section 2 prints ``r_k = r_{k−1} + (v_{k−1} + w_v) Δt``, ``v_k = v_{k−1} + w_v``, and the same for the angles:
the velocity jumps at the start of the interval and then stays. So a velocity is the difference of two successive
poses, exactly, and needs no variable of its own. What is left of the model is that two successive velocities differ
by white noise w. As in the papers the linear velocity is one in world axes; the angular velocity is a body rate
(rotation vectors instead of Euler angles: equal to first order, and without their singularity).

Poses are ``T_world_left``; perturbations are on the right, [rotation, translation].
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam.geometry.se3 import Array, pose
from slam.models import EstimatorModels

_inverse_right = gtsam.Rot3.LogmapDerivative  # inverse of SO(3)'s right Jacobian

_LONGEST = 1000.0  # guard: time [s] after which a camera can be anywhere; more would only exhaust the digits
_STANDS = 1e-5  # numerics: step [rad], [m] of a camera that stands; none at all would leave no information matrix


def bounded(dt: float) -> float:
    """The time between two poses [s] that the motion model counts."""
    return min(dt, _LONGEST)


def motion_sigmas(models: EstimatorModels, dt: float) -> Array:
    """Standard deviations (6,) of w = [w_ω, w_v] over `dt` [s]."""
    linear, angular = models.motion.velocity_variance(dt)
    return np.sqrt(np.repeat([angular, linear], 3))


def rest_sigmas() -> Array:
    """Standard deviations (6,) of a step of a camera that stands [rad], [m]."""
    return np.full(6, _STANDS)


def first_velocity_sigmas(models: EstimatorModels, dt: float) -> Array:
    """Standard deviations (6,) of [ω, v] in the first interval: the prior of the velocity and its first jump."""
    prior = np.repeat([models.initial_angular_velocity_sigma, models.initial_velocity_sigma], 3)
    return np.hypot(prior, motion_sigmas(models, dt))


def predict(T0: Array, T1: Array, dt01: float, dt12: float) -> tuple[Array, Array, Array, Array]:
    """The pose after T1 at the velocity between T0 and T1.

    Returns:
        T2 (4, 4), its Jacobians (6, 6) by the perturbations of T0 and T1, and by w = [w_ω, w_v].
    """
    s = dt12 / dt01
    R0, R1 = T0[:3, :3], T1[:3, :3]
    a = _log(R0.T @ R1)
    step = gtsam.Rot3.Expmap(s * a).matrix()
    R2 = R1 @ step
    T2 = pose(R2, T1[:3, 3] + s * (T1[:3, 3] - T0[:3, 3]))
    right = gtsam.Rot3.ExpmapDerivative(s * a)
    J0, J1, Jw = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    J0[:3, :3] = -s * right @ _inverse_right(-a)
    J1[:3, :3] = step.T + s * right @ _inverse_right(a)
    J0[3:, 3:] = -s * R2.T @ R0
    J1[3:, 3:] = (1 + s) * R2.T @ R1
    Jw[:3, :3] = dt12 * right
    Jw[3:, 3:] = dt12 * R2.T
    return T2, J0, J1, Jw


def predict_from_rest(T0: Array, dt: float) -> tuple[Array, Array, Array]:
    """The pose after the first one, whose velocity is unknown with mean zero.

    Returns:
        T1 (4, 4), its Jacobian (6, 6) by the perturbation of T0, and by the velocity [ω, v].
    """
    Jw = np.zeros((6, 6))
    Jw[:3, :3] = dt * np.eye(3)
    Jw[3:, 3:] = dt * T0[:3, :3].T
    return T0.copy(), np.eye(6), Jw


def velocity_change(R: Sequence[Array], t: Sequence[Array], dt01: float, dt12: float) -> Array:
    """Residual (6,) = [ω12 − ω01, v12 − v01] of three successive poses."""
    a, b = _log(R[0].T @ R[1]), _log(R[1].T @ R[2])
    return np.concatenate([b / dt12 - a / dt01, (t[2] - t[1]) / dt12 - (t[1] - t[0]) / dt01])


def velocity_change_jacobians(R: Sequence[Array], dt01: float, dt12: float) -> Array:
    """Derivatives (3, 6, 6) of `velocity_change` by each pose."""
    a, b = _log(R[0].T @ R[1]), _log(R[1].T @ R[2])
    J = np.zeros((3, 6, 6))
    J[0, :3, :3] = _inverse_right(-a) / dt01
    J[1, :3, :3] = -_inverse_right(a) / dt01 - _inverse_right(-b) / dt12
    J[2, :3, :3] = _inverse_right(b) / dt12
    J[0, 3:, 3:] = R[0] / dt01
    J[1, 3:, 3:] = -R[1] * (1 / dt01 + 1 / dt12)
    J[2, 3:, 3:] = R[2] / dt12
    return J


def _log(R: Array) -> Array:
    """Rotation vector (3,) of a rotation matrix (3, 3)."""
    return np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(R)))
