"""Linearised factors between a body's recent poses, the camera's, and the body's points.

Unknown are, for each of the n frames of the window, the right perturbation of the body's pose and that of the camera's
(6 + 6), then the positions of the p points in body coordinates (3 each).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from backends.smoother import objects_kernels as kernels
from slam.data import IndexArray
from slam.geometry.se3 import Array
from slam.object_models import ObjectModels
from slam.window.stereo import RectifiedStereo


@dataclass(eq=False)
class System:
    """Normal equations ``information · step = vector``; changed in place while they are put together."""

    information: Array
    vector: Array

    @classmethod
    def empty(cls, size: int) -> System:
        """Nothing known of `size` unknowns."""
        return cls(np.zeros((size, size)), np.zeros(size))

    def eliminated(self, gone: IndexArray) -> System:
        """Without the unknowns `gone` (G,), which are marginalised."""
        left = np.ones(len(self.vector), bool)
        left[gone] = False
        rest, rows = np.flatnonzero(left), self.information[gone]
        cross = np.linalg.solve(rows[:, gone], rows[:, rest])
        information = self.information[rest][:, rest] - rows[:, rest].T @ cross
        return System(0.5 * (information + information.T), self.vector[rest] - self.vector[gone] @ cross)

    def diffused(self, unknowns: IndexArray, roots: Array) -> System:
        """With independent noise added to triples of unknowns (3M,), given symmetric roots (M, 3, 3) of covariances."""
        count, size = len(unknowns), len(self.vector)
        M = (roots @ self.information[unknowns].reshape(-1, 3, size)).reshape(count, size)
        inner = np.eye(count) + (roots @ M.T[unknowns].reshape(-1, 3, count)).reshape(count, count)
        right = (roots @ self.vector[unknowns].reshape(-1, 3, 1)).reshape(-1)
        L, failed = dpotrf(inner, lower=1)
        if failed:
            raise np.linalg.LinAlgError("the equations are not finite")
        W = dtrtrs(L, np.column_stack([M, right]), lower=1)[0]
        return System(self.information - W[:, :-1].T @ W[:, :-1], self.vector - W[:, :-1].T @ W[:, -1])


def add_measurements(
    system: System, stereo: RectifiedStereo, sigma: float, z: Array, Y: Array, points: Array, first_point: int
) -> None:
    """Measurements of the points in the first n frames of the window.

    Args:
        system: takes the factors.
        stereo: the projection.
        sigma: pixel noise [px].
        z: (n, p, 3), NaN where there is none.
        Y: poses (n, 4, 4) of the body in the camera.
        points: in body coordinates (p, 3).
        first_point: where the points' unknowns begin.
    """
    kernels.add_measurements(
        system.information, system.vector, stereo.intrinsics, stereo.rectified_rig.R_left, sigma,
        np.ascontiguousarray(z), Y, points, first_point,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class VelocityPrior:
    """What is known beforehand of a body's first [ω, v] in world axes [rad/s], [m/s].

    Attributes:
        mean: (6,).
        sigmas: standard deviations (6,), of independent errors.
    """

    mean: Array
    sigmas: Array


def velocities(T: Array, stamps: Array) -> tuple[Array, Array, Array]:
    """Velocities [ω, v] (n − 1, 6) in world axes between successive poses (n, 4, 4) at `stamps` (n,).

    Returns them with their derivatives (n − 1, 6, 6) by the earlier and by the later pose.
    """
    velocity, before, after = kernels.velocities(T, stamps)
    return velocity, before, after


def impulse_sigmas(models: ObjectModels, dt: float, scale: float) -> Array:
    """Standard deviations (6,) of the change of [ω, v] at the beginning of a step of `dt` [s]; `scale` widens them."""
    linear, angular = models.velocity_variance(dt)
    return scale * np.sqrt(np.repeat([angular, linear], 3))


def first_sigmas(prior: VelocityPrior, models: ObjectModels, dt: float, scale: float) -> Array:
    """Standard deviations (6,) of [ω, v] in the first step: the prior of the velocity, and its first impulse."""
    return np.hypot(prior.sigmas, impulse_sigmas(models, dt, scale))


def add_motion(
    system: System, models: ObjectModels, T: Array, stamps: Array, scales: Array, first_velocity: VelocityPrior | None,
    steps: range,
) -> None:  # fmt: skip
    """Constant velocity but for an impulse before each step (paper B, section 2).

    Args:
        system: takes the factors.
        models: the impulses.
        T: poses (n, 4, 4).
        stamps: their times (n,) [s].
        scales: factors (n,) on the impulse before the step that leads to each pose.
        first_velocity: prior of the first velocity; None where the first pose is not the body's first.
        steps: which of the n − 1 steps.
    """
    if len(T) < 2 or not len(steps):
        return
    sigmas = scales[1:, None] * impulse_sigmas(models, 1.0, 1.0) * np.sqrt(np.diff(stamps))[:, None]  # a random walk
    first = steps.start
    mean: Array = np.zeros(6)
    if first_velocity is not None:
        dt, mean = float(stamps[1] - stamps[0]), first_velocity.mean
        sigmas[0] = first_sigmas(first_velocity, models, dt, float(scales[1]))
    else:
        first = max(1, first)
    kernels.add_motion(system.information, system.vector, *velocities(T, stamps), mean, sigmas, first, steps.stop)
