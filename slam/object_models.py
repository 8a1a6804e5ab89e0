"""The one place for what every estimator assumes of moving bodies: motion model, priors, how many points."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_positive
from slam.errors import ConfigurationError

#: For whoever reads a configuration from text with pydantic: a key that is not a field is an error.
FORBID_UNKNOWN = {"extra": "forbid"}

_RANGES = {
    "acceleration": (1e-6, 1e6),
    "angular_acceleration": (1e-6, 1e6),
    "initial_velocity_sigma": (1e-7, 1e6),
    "initial_angular_velocity_sigma": (1e-7, 1e3),
    "points": (1, 1000),
}


@dataclass(frozen=True)
class ObjectModels:
    """How bodies move: constant velocity in world axes, disturbed by impulses, as the camera does.

    Pixel noise and gate are those of `slam.models.EstimatorModels`.

    Attributes:
        acceleration: density of the noise of the origin's velocity [m/s / √s].
        angular_acceleration: density of the noise of the angular velocity [rad/s / √s].
        initial_velocity_sigma, initial_angular_velocity_sigma: standard deviations of a new body's velocities [m/s],
            [rad/s], whose mean is zero.
        points: so many points of a body are estimated at most; those unseen for longest make room for new ones.

    Raises:
        ConfigurationError: a number is not positive and finite, or fewer than three points are allowed.
    """

    acceleration: float = 1.0
    angular_acceleration: float = 2.0
    initial_velocity_sigma: float = 0.5
    initial_angular_velocity_sigma: float = 1.0
    points: int = 40

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_positive(self, _RANGES, "objects")
        if self.points < 3:
            raise ConfigurationError(f"objects: points must be at least 3, got {self.points}")

    def velocity_variance(self, dt: float) -> tuple[float, float]:
        """Variances of the impulses on the linear [m²/s²] and angular [rad²/s²] velocity over `dt` [s]."""
        return self.acceleration**2 * dt, self.angular_acceleration**2 * dt
