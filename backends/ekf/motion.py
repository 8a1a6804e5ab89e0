"""The camera's prior and motion noise, as covariances of [r, φ, v, ω] (paper B, section 2)."""

from __future__ import annotations

import math

import numpy as np

from backends.ekf.covariance import CAMERA, POSE
from slam.geometry.euler import body_rate_matrix
from slam.geometry.se3 import Array
from slam.models import ANYWHERE, EstimatorModels


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
