"""What a filter asks of its camera, and what all cameras share: the prior, and the noise of a motion.

An error is what is true less what is estimated: adding it corrects. The camera's (12,) is of its pose (6), velocity (3)
and rate (3), in coordinates that each camera chooses. What no measurement tells (the gauge) are displacements of the
world with the camera and all landmarks: a small shift, and a turn about the origin. `gauge_by_error` says which one is
an error of the pose, ``gauge`` of `backends.ekf.landmarks.FilterLandmarks` what it changes in a landmark's coordinates.
Their product N says how landmarks change with an error of the pose, if they stay where they are relative to the camera.
"""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np

from backends.ekf.covariance import CAMERA, POSE
from slam.geometry.se3 import Array, hat
from slam.models import ANYWHERE, EstimatorModels

_ANY_ATTITUDE = 2 * np.pi  # standard deviation of angles that say nothing of an attitude [rad]

_AT_REST = np.diag(np.repeat([1.0, 0.0], POSE))  # of a camera's error (12,)


class Camera(Protocol):
    """A camera's pose and velocities, and what an error of them means."""

    @property
    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""

    @property
    def v(self) -> Array:
        """Velocity (3,) in the world [m/s]."""

    @property
    def attitude_jacobian(self) -> Array:
        """Derivative (3, 3) of a turn about the world's axes by the error's three coordinates of the attitude."""

    @property
    def transports(self) -> bool:
        """Whether the covariance is transported to a corrected state; see `FilterState.corrected`."""

    def plus(self, error: Array) -> Self:
        """With an error (12,) added: ⊞."""

    def minus(self, other: Self) -> Array:
        """The error (12,) that, added to the other camera, gives this one: ⊟."""

    def at(self, T: Array) -> Self:
        """At another pose (4, 4), with the same velocities."""

    def regular_towards(self, T: Array) -> tuple[Self, Array]:
        """The same camera, with an error that is regular from here to a pose T; its derivative (12, 12) by this one's.

        The camera itself where its error is regular there as it is.
        """

    def advanced(self, dt: float) -> tuple[Self, Array, Array]:
        """After `dt` [s] of constant velocity: its error is A (12, 12) times what it was and W (12, 6) impulses."""

    def stopped(self) -> Self:
        """With the same pose, and no velocity."""


def pose_by_error(camera: Camera) -> Array:
    """Derivative (6, 6) of the pose's right perturbation [rotation, translation] by the pose's error."""
    J, back = np.zeros((POSE, POSE)), camera.pose[:3, :3].T
    J[:3, 3:], J[3:, :3] = back @ camera.attitude_jacobian, back
    return J


def gauge_by_error(camera: Camera) -> Array:
    """Derivative W (6, 6) of the displacement of the world [shift, turn about its origin] by the pose's error."""
    W, J = np.eye(POSE), camera.attitude_jacobian
    W[:3, 3:], W[3:, 3:] = hat(camera.pose[:3, 3]) @ J, J
    return W


def transport(camera: Camera, to: Camera) -> Array:
    """Jacobian J (12, 12) of an error written at another camera: the same displacement of the world, ``W(to) J = W``.

    The identity if the camera does not transport.
    """
    J = np.eye(CAMERA)
    if camera.transports:
        turn, shift = camera.attitude_jacobian, camera.pose[:3, 3] - to.pose[:3, 3]
        J[3:6, 3:6] = np.linalg.solve(to.attitude_jacobian, turn)
        J[:3, 3:6], J[6:9, 3:6] = hat(shift) @ turn, hat(camera.v - to.v) @ turn
    return J


def from_body_axes(camera: Camera, P: Array) -> Array:
    """A covariance (12, 12) with turns and rates about the body's axes, the same about all, as one of the error."""
    E = np.eye(CAMERA)
    E[3:6, 3:6] = E[9:, 9:] = np.linalg.solve(camera.attitude_jacobian, camera.pose[:3, :3])
    return np.asarray(E @ P @ E.T)


def predicted(camera: Camera, models: EstimatorModels, P: Array, dt: float, rests: bool) -> tuple[Camera, Array, Array]:
    """A camera with the error's covariance P (12, 12), after `dt` [s]; A (12, 12), and ``W Q Wᵀ`` (paper B, section 2).

    One that rests keeps its pose, and its velocity is zero for certain. One that may have turned anyhow meanwhile stays
    where it is, as uncertain as the prior of the speed makes it, by `ANYWHERE` at most: more, in one gap, would mean
    nothing, and leave a double too few digits for the map. The error of the pose before stays part of its own: camera
    and map go on to share what nobody knows of the world's place, and the map does not tell it.
    """
    if rests:
        return camera.stopped(), _AT_REST, np.zeros_like(P)
    if _any_attitude(models, P, dt):
        pose = min(models.initial_velocity_sigma * dt, ANYWHERE), np.pi / np.sqrt(3)
        return camera.stopped(), _AT_REST, from_body_axes(camera, prior(models, pose))
    camera, A, W = camera.advanced(dt)
    return camera, A, (W * np.repeat(models.motion.velocity_variance(dt), 3)) @ W.T


def prior(models: EstimatorModels, pose: tuple[float, float] | None = None) -> Array:
    """Covariance (12, 12) of the first camera, or of one with other standard deviations of the pose [m], [rad]."""
    pose = pose or (models.initial_position_sigma, models.initial_rotation_sigma)
    sigmas = *pose, models.initial_velocity_sigma, models.initial_angular_velocity_sigma
    return np.diag(np.repeat(np.square(sigmas), 3))


def _any_attitude(models: EstimatorModels, P: Array, dt: float) -> bool:
    """Whether a camera with the error's covariance P (12, 12) may have turned anyhow in the last `dt` [s]."""
    attitude, rate = np.arange(3, 6), np.arange(9, 12)
    variance = P[attitude, attitude] + 2 * dt * P[attitude, rate] + dt * dt * P[rate, rate]
    return bool(variance.max() + dt * dt * models.motion.velocity_variance(dt)[1] > _ANY_ATTITUDE**2)
