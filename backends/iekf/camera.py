"""The camera of the invariant filter: a motion on the group of the camera and its map, and an error of that group.

The state ``χ = (R, p, v, p_1, …, p_N)`` is an element of SE_{2+N}(3) (Barrau and Bonnabel, 2015; Zhang, Wu, Song, Huang
and Dissanayake, 2017): attitude, position and velocity of the camera, and the landmarks, all in the world. Beside it
stands the body's rate ω. The error is right-invariant, ``χ = exp(ξ) χ̂``: a displacement of the world,

    R = Exp(ξ_R) R̂,   p = Exp(ξ_R) (p̂ + ξ_p),   v = Exp(ξ_R) (v̂ + ξ_v),   p_i = Exp(ξ_R) (p̂_i + ξ_i),   ω = ω̂ + ξ_ω.

(The group's own exponential has ``J_l(ξ_R) ξ_p`` for ``Exp(ξ_R) ξ_p``: the same to first order; with this one a
measurement is a function of ξ_i − ξ_p, however large they are.) Prediction, with constant v and ω:

    R ← R Exp(ω Δt),   p ← p + v Δt,   θ = R J_l(ω Δt) Δt ξ_ω,
    ξ_R ← ξ_R + θ,   ξ_p ← ξ_p + Δt ξ_v + p × θ,   ξ_v ← ξ_v + v × θ,   ξ_i ← ξ_i + p_i × θ.

Measurement ``z_i = π(R̂ᵀ (p̂_i − p̂ + ξ_i − ξ_p))``, correction ``χ ← exp(K ν) χ̂`` and ``P ← P − K S Kᵀ``.

In the state a landmark's error is ``e_i = D_i⁻¹ (ξ_i − ξ_p)``, in the inverse depth that `backends.ekf.landmarks` has
(D_i are its derivatives; the anchor belongs to the world that is displaced): a linear map of the above, in which a far
point's error is Gaussian. The Jacobian of a measurement is then ``J R̂ᵀ D_i`` by e_i, and zero by all else.

Why nothing is transported: a displacement (δ, t) of camera and map together, which nothing measures, is the error
``ξ_R = δ, ξ_p = t, ξ_v = 0, e_i = 0`` whatever the state is. Every Jacobian is zero along it wherever it is taken, the
transition leaves it as it is, and a correction of the state does not change which errors it is. So no information on
it can arise, from no sequence of linearisations. In the Euler angles and world coordinates of `backends.ekf` that
direction depends on the estimate (a turn moves a landmark by ``δ × p̂_i``); there the covariance has to be carried from
the old estimate's direction to the new one's, by the Jacobian of that displacement, after each update.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backends.ekf.covariance import CAMERA, POSE
from backends.ekf.motion import Motion, after_gap, motion_noise, prior
from slam.geometry import se3
from slam.geometry.se3 import Array, hat
from slam.models import EstimatorModels


@dataclass(frozen=True, eq=False)
class InvariantCamera:
    """Pose and velocities, with the error [ξ_p, ξ_R, ξ_v, ξ_ω] (12,); see the module, and `backends.ekf.motion.Camera`.

    Positions are taken from `origin`, so that turns of a world far from zero lose no digits.

    Attributes:
        pose: ``T_world_left`` (4, 4).
        v: velocity (3,) in the world [m/s].
        rate: the body's rate ω (3,) [rad/s].
        origin: where the displacement turns about (3,) [m]: the first position.
    """

    pose: Array
    v: Array
    rate: Array
    origin: Array
    invariant = True
    transports = False

    @classmethod
    def first(cls, models: EstimatorModels) -> tuple[InvariantCamera, Array]:
        """Before the first prediction, with its covariance."""
        T = models.initial_pose
        camera = cls(T, np.zeros(3), np.zeros(3), T[:3, 3].copy())
        return camera, prior(models)  # at the origin and at rest: position and velocity do not turn

    def by_error(self) -> Array:
        """See `Camera`: ``[R̂ᵀ ξ_R, R̂ᵀ (ξ_p + ξ_R × p̂)]``."""
        R, J = self.pose[:3, :3], np.zeros((POSE, POSE))
        J[:3, 3:], J[3:, :3] = R.T, R.T
        J[3:, 3:] = -R.T @ hat(self.pose[:3, 3] - self.origin)
        return J

    def world(self) -> Array:
        """See `Camera`: the error of the pose is one, about another origin."""
        W = np.eye(POSE)
        W[:3, 3:] = hat(self.origin)
        return W

    def plain(self) -> Array:
        """See `Camera`: ``ξ_p = δp + p̂ × ξ_R`` and ``ξ_v = δv + v̂ × ξ_R``."""
        S = np.eye(CAMERA)
        S[:3, 3:6], S[6:9, 3:6] = hat(self.pose[:3, 3] - self.origin), hat(self.v)
        return S

    def moved(self, error: Array) -> InvariantCamera:
        """See `Camera`: ``χ ← exp(ξ) χ̂``."""
        turn = se3.so3_exp(error[3:6])
        T = se3.pose(turn @ self.pose[:3, :3], self.origin + turn @ (self.pose[:3, 3] - self.origin + error[:3]))
        return replace(self, pose=T, v=turn @ (self.v + error[6:9]), rate=self.rate + error[9:])

    def at(self, T: Array) -> InvariantCamera:
        """See `Camera`."""
        return replace(self, pose=T)

    def seen_from(self, other: InvariantCamera) -> Array:
        """See `Camera`; to first order, as the covariance is."""
        plain = np.zeros(CAMERA)
        plain[:3] = self.pose[:3, 3] - other.pose[:3, 3]
        plain[3:6] = se3.so3_log(self.pose[:3, :3] @ other.pose[:3, :3].T)
        plain[6:9], plain[9:] = self.v - other.v, self.rate - other.rate
        return np.asarray(other.plain() @ plain)

    def transport(self, to: InvariantCamera) -> Array:
        """See `Camera`: an error is the same displacement of the world, seen from wherever."""
        return np.eye(CAMERA)

    def advanced(self, models: EstimatorModels, P: Array, dt: float) -> Motion:
        """See `Camera`; constant velocity and body rate, disturbed by the papers' impulses."""
        back = np.linalg.inv(self.plain())
        plain = back @ P @ back.T
        gap = after_gap(models, plain, dt)
        if gap is not None:  # it may be turned anyhow: it stays, independent of the map
            still = replace(self, v=np.zeros(3), rate=np.zeros(3))
            S = still.plain()
            return Motion(still, np.zeros((CAMERA, CAMERA)), S @ gap @ S.T)
        R, turn = self.pose[:3, :3], self.rate * dt
        T = se3.pose(R @ se3.so3_exp(turn), self.pose[:3, 3] + dt * self.v)
        after, A, G = replace(self, pose=T), np.eye(CAMERA), np.eye(CAMERA)
        A[:3, 6:9], A[3:6, 9:] = dt * np.eye(3), dt * R @ se3.so3_left_jacobian(turn)
        G[3:6, 3:6] = A[3:6, 9:] / dt
        S = after.plain()
        return Motion(after, S @ A @ back, S @ G @ motion_noise(models, dt) @ G.T @ S.T)

    def at_rest(self) -> Motion:
        """See `Camera`."""
        still = replace(self, v=np.zeros(3), rate=np.zeros(3))
        rest = np.diag(np.repeat([1.0, 0.0], POSE))
        return Motion(still, still.plain() @ rest @ np.linalg.inv(self.plain()))

    def settled(self) -> Motion:
        """See `Camera`: nothing is singular; a rotation is made orthonormal again."""
        R = self.pose[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() <= 1e-12:
            return Motion(self)
        return Motion(replace(self, pose=se3.pose(se3.nearest_rotation(R), self.pose[:3, 3])))
