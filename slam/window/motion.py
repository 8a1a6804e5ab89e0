"""The papers' motion model on poses alone: the next pose, and its derivatives.

Paper B, section 2 prints ``r_k = r_{k−1} + (v_{k−1} + w_v) Δt``, ``v_k = v_{k−1} + w_v``, and the same for the angles:
the velocity jumps at the start of the interval and then stays. So a velocity is the difference of two successive poses,
and what is left of the model is that two successive velocities differ by white noise w. The linear velocity is one in
world axes, the angular velocity a body rate.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.arrays import BoolArray
from slam.geometry.se3 import Array, pose, so3_exp, so3_left_jacobian, so3_log
from slam.models import EstimatorModels

LONGEST = 1000.0  # guard: time [s] after which a camera can be anywhere; more would only exhaust the digits
STANDS = 1e-5  #: numerics: step [rad], [m] of a camera that stands; none at all would leave no information matrix
RATIO = 1e4  #: numerics: of an interval to the one before it, from which on the earlier velocity tells nothing


def velocity_sigmas(models: EstimatorModels, dt: float | Array, first: bool | BoolArray) -> Array:
    """Standard deviations (…, 6) of the change of [ω, v] over `dt` [s]; in the first interval, of the velocity."""
    linear, angular = models.motion.velocity_variance(1.0)  # they grow as time does
    jump = np.asarray(dt)[..., None] * np.array([angular, linear])
    start = np.asarray(first)[..., None] * [models.initial_angular_velocity_sigma, models.initial_velocity_sigma]
    return np.asarray(np.sqrt(np.repeat(jump + start**2, 3, axis=-1)))


def is_first(before: float | None, dt: float) -> bool:
    """Whether the velocity over `dt` [s] is taken for unknown: no interval is before it, or one that is far shorter."""
    return before is None or dt > RATIO * before


def predicted(
    models: EstimatorModels, poses: Array, before: float | None, dt: float, rests: bool = False
) -> tuple[Array, Array, Array, bool]:
    """The next pose by the motion model, after the time `dt` [s]; where the camera `rests`, it is the last one.

    Of the last two `poses` (2, 4, 4), `before` [s] apart, only the last counts where `before` is None. Returns the pose
    (4, 4), its Jacobian (6, 12) by the perturbations of the last two, the noise (6, 6) that is added, and whether the
    velocity was unknown, with mean zero.
    """
    J: Array = np.zeros((6, 12))
    T: Array = poses[-1].copy()
    if rests:
        return T, np.eye(6, 12, 6), STANDS**2 * np.eye(6), True
    first, by_velocity = is_first(before, dt), np.zeros_like(J[:, :6])
    if before is None or first:
        J[:, 6:] = np.eye(6)
        by_velocity[:3, :3], by_velocity[3:, 3:] = dt * np.eye(3), dt * T[:3, :3].T
    else:
        T, J[:, :6], J[:, 6:], by_velocity = predict(poses[0], poses[1], before, dt)
    return T, J, (by_velocity * velocity_sigmas(models, dt, first) ** 2) @ by_velocity.T, first


def predict(T0: Array, T1: Array, dt01: float, dt12: float) -> tuple[Array, Array, Array, Array]:
    """The pose T2 (4, 4) after T1 at the velocity between T0 and T1.

    And its Jacobians (6, 6) by the perturbations of T0 and T1, and by w = [w_ω, w_v].
    """
    s = dt12 / dt01
    R0, R1 = T0[:3, :3], T1[:3, :3]
    a = so3_log(R0.T @ R1)
    step = so3_exp(s * a)
    R2 = R1 @ step
    right, inverse_left = so3_left_jacobian(-s * a), np.linalg.inv(so3_left_jacobian(a))
    J0, J1, Jw = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    J0[:3, :3] = -s * right @ inverse_left
    J1[:3, :3] = step.T + s * right @ inverse_left.T
    J0[3:, 3:] = -s * R2.T @ R0
    J1[3:, 3:] = (1 + s) * R2.T @ R1
    Jw[:3, :3] = dt12 * right
    Jw[3:, 3:] = dt12 * R2.T
    return pose(R2, T1[:3, 3] + s * (T1[:3, 3] - T0[:3, 3])), J0, J1, Jw
