"""The assumptions shared by all estimators: motion of camera and bodies, pixel noise, priors, gate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slam.bounds import LEAST, require_not_negative
from slam.checks import is_rigid
from slam.chi_square import SIGMAS
from slam.errors import ConfigurationError
from slam.geometry.se3 import Array
from slam.naming import unknown
from slam.object_data import ObjectEstimate, ObjectObservations

ANYWHERE = 1e3  # numerics: standard deviation of an unknown position [m]

_DENSITIES = (1e-6, 1e6)  # of velocity noise
_SIGMAS = (1e-7, 1e6)  # of the initial state
_RANGES = {
    "pixel_sigma": (1e-3, 1e3),
    "gate_probability": (LEAST, 1 - LEAST),
    "initial_position_sigma": _SIGMAS,
    "initial_rotation_sigma": (1e-7, 10.0),
    "initial_velocity_sigma": _SIGMAS,
    "initial_angular_velocity_sigma": (1e-7, 1e3),
}
_BODY_RANGES = {
    "acceleration": _DENSITIES,
    "angular_acceleration": _DENSITIES,
    "initial_velocity_sigma": _SIGMAS,
    "initial_angular_velocity_sigma": (1e-7, 1e3),
    "points": (3, 1000),
    "max_speed": (1e-6, 1e6),
    "max_acceleration": (1e-6, 1e9),
    "max_turn_rate": (1e-6, 1e6),
    "drift": (0.0, 1e3),
}


@dataclass(frozen=True)
class MotionModel:
    """Constant velocity, disturbed by impulse accelerations (paper B, section 2).

    The velocity changes of two steps are independent, so their variance grows with time: over Δt the velocity noise
    w of paper B has standard deviation ``density · √Δt``, whatever the frame rate.

    Attributes:
        acceleration: density of the linear velocity noise [m/s / √s].
        angular_acceleration: density of the angular velocity noise [rad/s / √s].
        wheels: the camera is on a vehicle, which does not move sideways, and looks ahead.
    """

    acceleration: float = 1.0
    angular_acceleration: float = 1.0
    wheels: bool = False

    def __post_init__(self) -> None:
        require_not_negative(self, {"acceleration": _DENSITIES, "angular_acceleration": _DENSITIES})

    def velocity_variance(self, dt: float) -> tuple[float, float]:
        """Variances of w_v [m²/s²] and w_ω [rad²/s²] over `dt` [s]."""
        return self.acceleration**2 * dt, self.angular_acceleration**2 * dt


@dataclass(frozen=True)
class ObjectModels:
    """How bodies move: constant velocity in world axes, disturbed by impulses, as the camera does.

    Pixel noise and gate are those of `EstimatorModels`.

    Attributes:
        acceleration: density of the noise of the origin's velocity [m/s / √s].
        angular_acceleration: density of the noise of the angular velocity [rad/s / √s].
        initial_velocity_sigma, initial_angular_velocity_sigma: standard deviations of a new body's velocities [m/s],
            [rad/s], whose mean is zero.
        points: largest number of points estimated per body; those unseen for longest make room for new ones.
        max_speed, max_acceleration, max_turn_rate: limits of any body's motion [m/s], [m/s²], [rad/s]; an estimate
            beyond them is refused. The acceleration is that of a collision.
        drift: density of the random walk of a feature's pixel, in both images alike, with the angle from which it is
            seen [px / √rad]: from another viewpoint it is at another point of the surface, of the world or of a body.

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

    def __post_init__(self) -> None:
        require_not_negative(self, _BODY_RANGES, "objects")

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
        """Whether a change of velocity [ω, v] (6,), with covariances (6, 6), is physically possible within `dt` [s]."""
        noise = SIGMAS * math.sqrt(np.trace(covariance[3:, 3:]) + np.trace(covariance_before[3:, 3:]))
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


@dataclass(frozen=True)
class SlideModel:
    """How a landmark's feature slides over its surface, for back ends that model it.

    A feature is found where the image looks like it; from another viewpoint that is another point of the surface. Its
    pixel walks at random, in both images alike. To back ends without this model the slide is a part of the noise.

    Attributes:
        density: of that walk with the angle from which the landmark is seen [px / √rad]; 0 for none.
        share: of `EstimatorModels.pixel_sigma` that is left as noise beside the slide.

    Raises:
        ConfigurationError: a number is negative or not finite, or the share above 1.
    """

    density: float = 0.0
    share: float = 1.0

    def __post_init__(self) -> None:
        require_not_negative(self, {"density": (0.0, 1e3), "share": (LEAST, 1.0)}, "slide")


@dataclass(frozen=True)
class EstimatorModels:
    """Noise, priors and gate shared by all back ends.

    Attributes:
        motion: the motion model.
        pixel_sigma: standard deviation of uL, vL and uR [px].
        slide: how landmarks' features slide; to back ends without it this is a part of `pixel_sigma`.
        gate_probability: an observation is rejected if its innovation lies outside this quantile of χ².
        initial_position_sigma, initial_rotation_sigma: standard deviations of the first pose [m], [rad]; tiny if it
            defines the world frame.
        initial_velocity_sigma, initial_angular_velocity_sigma: standard deviations of the first velocities [m/s],
            [rad/s].
        T_world_left: first pose (4, 4) of the left camera; null (in Python None) for the identity.
        objects: how moving bodies move.
    """

    motion: MotionModel = field(default_factory=MotionModel)
    pixel_sigma: float = 1.0
    slide: SlideModel = field(default_factory=SlideModel)
    gate_probability: float = 0.999
    initial_position_sigma: float = 1e-4
    initial_rotation_sigma: float = 1e-5
    initial_velocity_sigma: float = 1.0
    initial_angular_velocity_sigma: float = 1.0
    T_world_left: Sequence[Sequence[float]] | None = None
    objects: ObjectModels = field(default_factory=ObjectModels)

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES)
        if self.T_world_left is not None:
            try:
                T = np.array(self.T_world_left, float)
            except (TypeError, ValueError, OverflowError):
                T = np.zeros(0)
            if T.shape != (4, 4) or not is_rigid(T, 1e-6):  # to within the rounding of six digits
                raise ConfigurationError("T_world_left must be a (4, 4) pose: a rotation and a translation")
            object.__setattr__(self, "T_world_left", tuple(map(tuple, T.tolist())))

    def with_slide(self) -> EstimatorModels:
        """For a back end that models the slide: the noise of pixels is what is left beside it."""
        share = self.slide.share if self.slide.density else 1.0
        return replace(self, pixel_sigma=share * self.pixel_sigma)

    @property
    def initial_pose(self) -> Array:
        """The first pose (4, 4)."""
        return np.eye(4) if self.T_world_left is None else np.array(self.T_world_left, float)


#: Models by kind of motion; every sequence of a kind runs with the same.
KINDS = {
    "handheld": EstimatorModels(pixel_sigma=0.3, objects=ObjectModels(drift=0.7)),
    "driving": EstimatorModels(
        MotionModel(acceleration=1.0, angular_acceleration=0.3, wheels=True),
        pixel_sigma=0.7,
        slide=SlideModel(3.0, 0.4),
        initial_velocity_sigma=15.0,
        initial_angular_velocity_sigma=0.3,
        objects=ObjectModels(
            acceleration=2.0,
            angular_acceleration=0.5,
            initial_velocity_sigma=15.0,
            initial_angular_velocity_sigma=0.5,
            max_speed=50.0,
            max_turn_rate=3.0,
            drift=0.7,
        ),
    ),
}


def models_for(kind: str) -> EstimatorModels:
    """The models of a kind of motion, ``"handheld"`` or ``"driving"``.

    Raises:
        ConfigurationError: the kind is not known.
    """
    try:
        return KINDS[kind]
    except (KeyError, TypeError):
        raise ConfigurationError(unknown("kind of motion", kind, KINDS)) from None
