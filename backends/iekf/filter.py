"""The right-invariant EKF: the filter of `backends.ekf` with another camera, and another error.

The state ``χ = (R, p, v, p_1, …, p_N)`` is an element of SE_{2+N}(3) (Barrau and Bonnabel, 2015; Zhang, Wu, Song, Huang
and Dissanayake, 2017): attitude, position and velocity of the camera, and the landmarks, all in the world. Beside it
stands the body's rate ω. The error of a right-invariant filter is a displacement of the world, ``χ = exp(ξ) χ̂``:

    R = Exp(ξ_R) R̂,   p = p̂ + ξ_R × p̂ + ξ_p,   v = v̂ + ξ_R × v̂ + ξ_v,   p_i = p̂_i + ξ_R × p̂_i + ξ_i,   ω = ω̂ + ξ_ω

to first order. A displacement of camera and map together, which nothing measures, is the same error ``ξ_R = δ,
ξ_p = ξ_i = t, ξ_v = ξ_ω = 0`` whatever the estimate is, and the transition keeps it: no sequence of linearisations can
inform on it. The filter is an imperfect one in the terms of Barrau and Bonnabel: the rate ω is no part of the group, so
other derivatives do depend on the estimate.

The covariance is kept in the state's own coordinates here: ``[δp, θ, δv, δω]`` with ``R = Exp(θ) R̂``, and the
landmarks' inverse depths, with ``ξ = T(χ̂) [δp, θ, …]``. An update that moves the estimate from χ̂ to χ̂⁺ multiplies them
by ``T(χ̂⁺)⁻¹ T(χ̂)``: the transport of `backends.ekf.state.FilterState.corrected`. So the camera's ξ stays, to first
order in a step; what a landmark's has besides the displacement keeps its numbers in inverse depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from backends.ekf.covariance import CAMERA, POSE
from backends.ekf.filter import LandmarkFilter
from backends.ekf.landmarks import InverseDepth
from slam.bounds import from_options, require_not_negative
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels


@dataclass(frozen=True, eq=False)
class InvariantCamera:
    """Pose and velocities, with the error [δp, θ, δv, δω] (12,); see the module and `backends.ekf.camera.Camera`."""

    pose: Array  # T_world_left (4, 4)
    v: Array  # velocity (3,) in the world [m/s]
    rate: Array  # the body's rate ω (3,) [rad/s]
    transports = True
    attitude_jacobian = np.eye(3)

    def plus(self, error: Array) -> InvariantCamera:
        """See `Camera`."""
        T = se3.pose(se3.so3_exp(error[3:6]) @ self.pose[:3, :3], self.pose[:3, 3] + error[:3])
        return replace(self, pose=T, v=self.v + error[6:9], rate=self.rate + error[9:])

    def at(self, T: Array) -> InvariantCamera:
        """See `Camera`."""
        return replace(self, pose=T)

    def minus(self, other: InvariantCamera) -> Array:
        """See `Camera`."""
        turn = se3.so3_log(self.pose[:3, :3] @ other.pose[:3, :3].T)
        shift = self.pose[:3, 3] - other.pose[:3, 3]
        return np.concatenate([shift, turn, self.v - other.v, self.rate - other.rate])

    def advanced(self, dt: float) -> tuple[InvariantCamera, Array, Array]:
        """See `Camera`: ``R ← R Exp(ω Δt)``, ``p ← p + v Δt``, disturbed by the papers' impulses."""
        R, turn = self.pose[:3, :3], self.rate * dt
        after = se3.nearest_rotation(R @ se3.so3_exp(turn))  # products of many rotations lose digits
        T = se3.pose(after, self.pose[:3, 3] + dt * self.v)
        A = np.eye(CAMERA)
        A[:3, 6:9], A[3:6, 9:] = dt * np.eye(3), dt * R @ se3.so3_left_jacobian(turn)
        return replace(self, pose=T), A, A[:, POSE:]

    def stopped(self) -> InvariantCamera:
        """See `Camera`."""
        return replace(self, v=np.zeros(3), rate=np.zeros(3))

    def regular_towards(self, T: Array) -> tuple[InvariantCamera, Array]:
        """See `Camera`: its error is regular everywhere."""
        return self, np.eye(CAMERA)


@dataclass(frozen=True)
class IekfConfig:
    """Options of `IekfBackend`.

    Attributes:
        iterations: most linearisations in an update. More than one are made only where the first is not linear to
            within the noise.
        kept: as that of `backends.ekf.backend.EkfConfig`.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    iterations: int = 20
    kept: int | None = 200

    def __post_init__(self) -> None:
        require_not_negative(self, {"iterations": (1, 1000), "kept": (0, 10**6)}, "iekf")


class IekfBackend(LandmarkFilter):
    """Right-invariant extended Kalman filter over the camera's motion and the landmarks.

    Gate, update, iteration and recovery are those of `backends.ekf`; its own are the motion on SO(3) and the invariant
    error (see the module).

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        options: see `IekfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    name = "iekf"

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.config = from_options(IekfConfig, "iekf", options)
        first = InvariantCamera(models.initial_pose, np.zeros(3), np.zeros(3))
        super().__init__(rig, models, first, InverseDepth(), self.config.iterations, self.config.kept)
