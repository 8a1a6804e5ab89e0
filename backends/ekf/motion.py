"""How the camera moves and what is known of it at first, for [r, φ, v, ω] (paper B, section 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from backends.ekf.angles import LIMIT, reanchor
from backends.ekf.covariance import CAMERA, POSE
from slam.geometry.euler import body_rate_matrix, rotation
from slam.geometry.se3 import Array, hat
from slam.models import ANYWHERE, EstimatorModels

_ANY_ATTITUDE = 2 * np.pi  # standard deviation of angles that say nothing of an attitude [rad]
_PIECES = 64  # numerics: at most, of one step through the angles' singularity
_SMALL_TURN = 0.2  # numerics: of a step whose error may be carried as a turn about the world's axes [rad]


@dataclass(frozen=True, eq=False)
class Motion:
    """A camera that has moved.

    Attributes:
        camera: its state [r, φ, v, ω] (12,).
        R_world_angles: the angles' world (3, 3), see `backends.ekf.angles`.
        J: its error is J (12, 12) times what it was before,
        noise: plus a Gaussian of this covariance (12, 12).
    """

    camera: Array
    R_world_angles: Array
    J: Array = field(default_factory=lambda: np.eye(CAMERA))
    noise: Array = field(default_factory=lambda: np.zeros((CAMERA, CAMERA)))

    def then(self, camera: Array, R_world_angles: Array, J: Array, noise: Array | float = 0.0) -> Motion:
        """Followed by another one."""
        return Motion(camera, R_world_angles, J @ self.J, J @ self.noise @ J.T + noise)


def advanced(models: EstimatorModels, start: Motion, P: Array, dt: float, consistent: bool) -> Motion:
    """The printed transition (paper B, section 2), in pieces where it would run into the angles' singularity.

    Args:
        models: how the camera moves.
        start: where it is.
        P: its covariance (12, 12).
        dt: how long [s].
        consistent: see `_transition`.
    """
    if attitude_deviation(models, P, dt) > _ANY_ATTITUDE:  # it may be turned anyhow: it stays, independent of the map
        noise = covariance_after_gap(models, start.camera[3:6], P[:3, :3], dt)
        camera = np.concatenate([start.camera[:POSE], np.zeros(POSE)])
        return start.then(camera, start.R_world_angles, np.zeros((CAMERA, CAMERA)), noise)
    turn = float(start.camera[10]) * dt
    if abs(float(start.camera[4]) + turn) > LIMIT:
        start = start.then(*reanchor(start.R_world_angles, start.camera))
        turn = float(start.camera[10]) * dt
    pieces = max(1, math.ceil(min(abs(turn) / LIMIT, _PIECES)))
    for _ in range(pieces):
        start = reanchored_if_needed(_transition(models, start, dt / pieces, consistent))
    return start


def at_rest(start: Motion) -> Motion:
    """A step of a camera that stands: the pose stays, and the velocity is zero for certain."""
    camera = np.concatenate([start.camera[:POSE], np.zeros(POSE)])
    return start.then(camera, start.R_world_angles, np.diag(np.repeat([1.0, 0.0], POSE)))


def _transition(models: EstimatorModels, start: Motion, dt: float, consistent: bool) -> Motion:
    """``x ← f(x)`` and ``P ← A P Aᵀ + W Q Wᵀ`` with the printed A and W.

    `consistent`: the attitude's error is carried as a turn about the world's axes, not as one of the angles φ. The
    printed transition has constant rates of the angles, which is not the same in another world. The difference is of
    second order; in long steps, where it would not be, the transition is left as printed.
    """
    before, camera, A = start.camera, start.camera.copy(), np.eye(CAMERA)
    camera[:POSE] += dt * before[POSE:]
    A[:POSE, POSE:] = dt * np.eye(POSE)
    if consistent and np.abs(camera[3:6] - before[3:6]).max() < _SMALL_TURN:
        J, R = np.eye(CAMERA), start.R_world_angles
        J[3:6, 3:6] = np.linalg.solve(turning(R, camera), turning(R, before))
        A = A @ J
    return start.then(camera, start.R_world_angles, A, motion_noise(models, dt))


def reanchored_if_needed(motion: Motion) -> Motion:
    """With a new angles' world where φy is near its singularity."""
    phi_y = float(motion.camera[4])
    if abs(math.sin(phi_y)) > math.sin(LIMIT) or math.cos(phi_y) < 0:
        return motion.then(*reanchor(motion.R_world_angles, motion.camera))
    return motion


def turning(R_world_angles: Array, camera: Array) -> Array:
    """Derivative (3, 3) of the attitude, turned about the world's axes, by the angles φ of a camera (12,)."""
    return np.asarray(R_world_angles @ rotation(camera[3:6]) @ body_rate_matrix(camera[3:6]))


def transport(R_world_angles: Array, before: Array, after: Array) -> tuple[Array, Array]:
    """What becomes of the error when the camera's state (12,) is moved and the displacement of the world kept.

    Returns:
        the camera's error is multiplied by (12, 12); (6, 6) takes an error of [r, φ] after that to the displacement.
    """
    A, A_before, change, J = turning(R_world_angles, after), turning(R_world_angles, before), after - before, np.eye(12)
    J[:3, 3:6] = -hat(change[:3]) @ A_before
    J[3:6, 3:6] = np.linalg.solve(A, A_before)
    J[6:9, 3:6] = -hat(change[6:9]) @ A_before
    world = np.eye(POSE)
    world[:3, 3:], world[3:, 3:] = hat(after[:3]) @ A, A
    return J, world


def initial_covariance(models: EstimatorModels, phi: Array) -> Array:
    """The camera's prior (12, 12) at angles φ (3,): isotropic in body axes, hence through the angles' rate matrix."""
    P = np.zeros((CAMERA, CAMERA))
    E = np.linalg.inv(body_rate_matrix(phi))
    P[0:3, 0:3] = models.initial_position_sigma**2 * np.eye(3)
    P[3:6, 3:6] = models.initial_rotation_sigma**2 * E @ E.T
    P[6:9, 6:9] = models.initial_velocity_sigma**2 * np.eye(3)
    P[9:12, 9:12] = models.initial_angular_velocity_sigma**2 * E @ E.T
    return P


def motion_noise(models: EstimatorModels, dt: float) -> Array:
    """``W Q Wᵀ`` (12, 12) of a step of `dt` [s]."""
    noise, each = np.zeros((2, POSE, 2, POSE)), np.arange(POSE)
    variances = np.repeat(models.motion.velocity_variance(dt), 3)
    noise[:, each, :, each] = variances[:, None, None] * np.array([[dt * dt, dt], [dt, 1.0]])
    return noise.reshape(CAMERA, CAMERA)


def attitude_deviation(models: EstimatorModels, P: Array, dt: float) -> float:
    """Largest standard deviation [rad] of the angles after a step of `dt` [s] from a covariance P (12, 12)."""
    phi, omega = np.arange(3, 6), np.arange(9, 12)
    variance = P[phi, phi] + 2 * dt * P[phi, omega] + dt * dt * P[omega, omega]
    return math.sqrt(max(variance.max() + dt * dt * models.motion.velocity_variance(dt)[1], 0.0))


def covariance_after_gap(models: EstimatorModels, phi: Array, position: Array, dt: float) -> Array:
    """Covariance (12, 12) of a camera at angles φ (3,) that may have turned anyhow in the last `dt` [s].

    `position` (3, 3) is the covariance of its position before. The position is as uncertain as the prior of the speed
    makes it meanwhile. Larger numbers would mean nothing, and would leave a double too few digits for the map.
    """
    P, E = initial_covariance(models, phi), np.linalg.inv(body_rate_matrix(phi))
    P[:3, :3] = position + (models.initial_velocity_sigma * dt) ** 2 * np.eye(3)
    P[:3, :3] *= min(1.0, ANYWHERE**2 / P[:3, :3].diagonal().max())
    P[3:6, 3:6] = np.pi**2 / 3 * E @ E.T
    return P
