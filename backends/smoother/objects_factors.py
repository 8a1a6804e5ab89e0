"""What ties a body's recent poses, the camera's, and the body's points together, linearised.

Unknown are, for each of the n frames of the window, the right perturbation of the body's pose and that of the camera's
(6 + 6), then the positions of the p points in body coordinates (3 each).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.smoother.records import IndexArray
from backends.smoother.stereo import RectifiedStereo
from slam.objects.models import ObjectModels
from slam.se3 import Array, hat

FRAME = 12  #: unknowns of a frame: body pose (6), camera pose (6)


@dataclass
class System:
    """Normal equations ``information · step = vector``; changed in place while they are put together."""

    information: Array
    vector: Array

    @classmethod
    def empty(cls, size: int) -> System:
        """Nothing known of `size` unknowns."""
        return cls(np.zeros((size, size)), np.zeros(size))

    def add(self, unknowns: IndexArray, J: Array, residual: Array) -> None:
        """A factor with whitened residual (K,) and its derivatives (K, U), with opposite sign, by `unknowns` (U,)."""
        self.information[np.ix_(unknowns, unknowns)] += J.T @ J
        self.vector[unknowns] += J.T @ residual

    def eliminated(self, gone: IndexArray) -> System:
        """Without the unknowns `gone` (G,), which are marginalised."""
        left = np.ones(len(self.vector), bool)
        left[gone] = False
        rest, rows = np.flatnonzero(left), self.information[gone]
        cross = np.linalg.solve(rows[:, gone], rows[:, rest])
        information = self.information[rest][:, rest] - rows[:, rest].T @ cross
        return System(0.5 * (information + information.T), self.vector[rest] - self.vector[gone] @ cross)


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
    n, p = z.shape[:2]
    R = Y[:, :3, :3]
    h = points @ np.swapaxes(R, 1, 2) + Y[:, None, :3, 3]
    predicted, J = stereo.project(h.reshape(-1, 3))
    r, J = (z - predicted.reshape(n, p, 3)) / sigma, J.reshape(n, p, 3, 3) / sigma
    missing = ~np.isfinite(r)
    r[missing], J[missing] = 0, 0
    by_point = J @ R[:, None]
    G = np.concatenate([-by_point @ hat(points), by_point, J @ hat(h), -J], axis=3)  # (n, p, 3, FRAME)
    frames, start = n * FRAME, np.arange(n)[:, None] * FRAME + np.arange(FRAME)
    H, g = system.information, system.vector
    flat = np.swapaxes(G.reshape(n, 3 * p, FRAME), 1, 2)
    H[start[:, :, None], start[:, None, :]] += flat @ np.swapaxes(flat, 1, 2)
    g[:frames] += (flat @ r.reshape(n, 3 * p, 1)).reshape(-1)
    cross = (np.swapaxes(G, 2, 3) @ by_point).transpose(0, 2, 1, 3).reshape(frames, 3 * p)
    H[:frames, first_point:] += cross
    H[first_point:, :frames] += cross.T
    E = by_point.transpose(1, 0, 2, 3).reshape(p, 3 * n, 3)
    own = first_point + np.arange(3 * p).reshape(p, 3)
    H[own[:, :, None], own[:, None, :]] += np.swapaxes(E, 1, 2) @ E
    g[first_point:] += (np.swapaxes(E, 1, 2) @ r.transpose(1, 0, 2).reshape(p, 3 * n, 1)).reshape(-1)


def velocities(T: Array, stamps: Array) -> tuple[Array, Array, Array]:
    """Velocities [ω, v] (n − 1, 6) in world axes between successive poses (n, 4, 4) at `stamps` (n,).

    Returns them with their derivatives (n − 1, 6, 6) by the earlier and by the later pose.
    """
    dt = np.diff(stamps)[:, None]
    R = T[:, :3, :3]
    a, inverse_J = _turns(R[1:] @ np.swapaxes(R[:-1], 1, 2))
    velocity = np.concatenate([a, np.diff(T[:, :3, 3], axis=0)], axis=1) / dt
    before, after = np.zeros((len(a), 6, 6)), np.zeros((len(a), 6, 6))
    before[:, :3, :3] = -np.swapaxes(inverse_J, 1, 2) @ R[:-1]  # the right Jacobian is the transposed left one
    after[:, :3, :3] = inverse_J @ R[1:]
    before[:, 3:, 3:], after[:, 3:, 3:] = -R[:-1], R[1:]
    return velocity, before / dt[:, :, None], after / dt[:, :, None]


def _turns(R: Array) -> tuple[Array, Array]:
    """Rotation vectors (M, 3) of rotations by less than a half turn, and their inverse left Jacobians (M, 3, 3).

    Many times faster than by way of `so3_log`, whose care at half turns no body needs within a frame.
    """
    odd = 0.5 * (R - np.swapaxes(R, 1, 2))
    axis = odd[:, (2, 0, 1), (1, 2, 0)]
    sine = np.sqrt((axis * axis).sum(axis=1))
    angle = np.arctan2(sine, 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1))
    small = sine < 1e-6
    scale = np.where(small, 1.0, angle / np.where(small, 1.0, sine))
    half = 0.5 * np.where(small, 1.0, angle)
    bend = np.where(small, 1 / 12, (1 - half / np.tan(half)) / (4 * half * half))
    K = scale[:, None, None] * odd
    return scale[:, None] * axis, np.eye(3) - 0.5 * K + bend[:, None, None] * (K @ K)


def impulse_sigmas(models: ObjectModels, dt: float, scale: float) -> Array:
    """Standard deviations (6,) of the change of [ω, v] at the beginning of a step of `dt` [s]; `scale` widens them."""
    linear, angular = models.velocity_variance(dt)
    return scale * np.sqrt(np.repeat([angular, linear], 3))


def first_sigmas(models: ObjectModels, dt: float, scale: float) -> Array:
    """Standard deviations (6,) of [ω, v] in the first step: the prior of the velocity, and its first impulse."""
    prior = np.repeat([models.initial_angular_velocity_sigma, models.initial_velocity_sigma], 3)
    return np.hypot(prior, impulse_sigmas(models, dt, scale))


def add_motion(
    system: System, models: ObjectModels, T: Array, stamps: Array, scales: Array, fresh: bool, steps: range
) -> None:
    """Constant velocity but for an impulse before each step (paper B, section 2).

    Args:
        system: takes the factors.
        models: the impulses.
        T: poses (n, 4, 4).
        stamps: their times (n,) [s].
        scales: factors (n,) on the impulse before the step that leads to each pose.
        fresh: whether the first pose is the body's first; then the first velocity has its prior.
        steps: which of the n − 1 steps.
    """
    if len(T) < 2 or not len(steps):
        return
    velocity, before, after = velocities(T, stamps)
    for i in steps:
        if i == 0 and not fresh:
            continue
        dt, at = stamps[i + 1] - stamps[i], np.arange(6)
        if i == 0:
            weight = 1 / first_sigmas(models, dt, scales[1])[:, None]
            J = np.concatenate([before[0], after[0]], axis=1)
            unknowns, change = np.concatenate([at, FRAME + at]), velocity[0]
        else:
            weight = 1 / impulse_sigmas(models, dt, scales[i + 1])[:, None]
            J = np.concatenate([-before[i - 1], before[i] - after[i - 1], after[i]], axis=1)
            unknowns = np.concatenate([FRAME * (i - 1) + at, FRAME * i + at, FRAME * (i + 1) + at])
            change = velocity[i] - velocity[i - 1]
        system.add(unknowns, weight * J, -weight[:, 0] * change)
