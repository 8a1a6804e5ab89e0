"""The assumptions about moving bodies shared by all estimators: motion model, priors, number of points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.bounds import require_not_negative
from slam.errors import ConfigurationError
from slam.geometry.arrays import Array
from slam.object_data import ObjectEstimate, ObjectObservations

#: For whoever reads a configuration from text with pydantic: a key that is not a field is an error.
FORBID_UNKNOWN = {"extra": "forbid"}

_RANGES = {
    "acceleration": (1e-6, 1e6),
    "angular_acceleration": (1e-6, 1e6),
    "initial_velocity_sigma": (1e-7, 1e6),
    "initial_angular_velocity_sigma": (1e-7, 1e3),
    "points": (1, 1000),
    "max_speed": (1e-6, 1e6),
    "max_acceleration": (1e-6, 1e9),
    "max_turn_rate": (1e-6, 1e6),
    "drift": (0.0, 1e3),
}
_SIGMAS = 3.0  # standard deviations allowed to a change of velocity


@dataclass(frozen=True)
class ObjectModels:
    """How bodies move: constant velocity in world axes, disturbed by impulses, as the camera does.

    Pixel noise and gate are those of `slam.models.EstimatorModels`.

    Attributes:
        acceleration: density of the noise of the origin's velocity [m/s / √s].
        angular_acceleration: density of the noise of the angular velocity [rad/s / √s].
        initial_velocity_sigma, initial_angular_velocity_sigma: standard deviations of a new body's velocities [m/s],
            [rad/s], whose mean is zero.
        points: largest number of points estimated per body; those unseen for longest make room for new ones.
        max_speed, max_acceleration, max_turn_rate: limits of any body's motion [m/s], [m/s²], [rad/s]; an estimate
            beyond them is refused. The acceleration is that of a collision.
        drift: density of the random walk of a point's pixel, in both images alike, with the angle from which it is seen
            [px / √rad]: from another viewpoint, a feature is found at another point of the body.

    Raises:
        ConfigurationError: a number is not positive and finite, or fewer than three points are allowed.
    """

    acceleration: float = 1.0
    angular_acceleration: float = 2.0
    initial_velocity_sigma: float = 0.5
    initial_angular_velocity_sigma: float = 1.0
    points: int = 40
    max_speed: float = 3.0
    max_acceleration: float = 100.0
    max_turn_rate: float = 20.0
    drift: float = 0.0

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES, "objects")
        if self.points < 3:
            raise ConfigurationError(f"objects: points must be at least 3, got {self.points}")

    def velocity_variance(self, dt: float) -> tuple[float, float]:
        """Variances of the impulses on the linear [m²/s²] and angular [rad²/s²] velocity over `dt` [s]."""
        return self.acceleration**2 * dt, self.angular_acceleration**2 * dt

    def first_velocity(self, o: ObjectObservations | None) -> tuple[Array, Array]:
        """Mean and standard deviations (6,) of a new body's [ω, v], at least as certain as in general."""
        sigmas = np.repeat([self.initial_angular_velocity_sigma, self.initial_velocity_sigma], 3)
        if o is None or o.velocity is None or o.velocity_sigma is None:
            return np.zeros(6), sigmas
        return o.velocity, np.minimum(o.velocity_sigma, sigmas)

    def possible(self, velocity: Array, covariance: Array, before: Array, covariance_before: Array, dt: float) -> bool:
        """Whether a change of velocity is physically possible.

        Args:
            velocity: [ω, v] (6,) [rad/s], [m/s].
            covariance: of it (6, 6).
            before: the velocity (6,) by `dt` [s] earlier.
            covariance_before: of that (6, 6).
            dt: time between [s].
        """
        noise = _SIGMAS * math.sqrt(np.trace(covariance[3:, 3:]) + np.trace(covariance_before[3:, 3:]))
        change = float(np.linalg.norm(velocity[3:] - before[3:]))
        return bool(
            np.linalg.norm(velocity[3:]) <= self.max_speed
            and np.linalg.norm(velocity[:3]) <= self.max_turn_rate
            and change <= self.max_acceleration * dt + noise
        )

    def known(self, estimate: ObjectEstimate) -> bool:
        """Whether an estimate of a body is more certain than these limits alone.

        Standard deviations are compared: of the position with the largest distance covered in a second, of the
        orientation with π, of the velocities with the largest ones.
        """
        P, V = estimate.covariance, estimate.velocity_covariance
        rotation, position = np.trace(P[:3, :3]), np.trace(P[3:, 3:])
        turning, speed = np.trace(V[:3, :3]), np.trace(V[3:, 3:])
        return bool(
            rotation <= math.pi**2
            and position <= self.max_speed**2
            and turning <= self.max_turn_rate**2
            and speed <= self.max_speed**2
        )
