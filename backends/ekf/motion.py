"""How the camera moves, for [r, φ, v, ω] and its transition (paper B, section 2).

The papers' ``R(φ) = Rz(φz) Ry(φy) Rx(φx)`` (paper B, below Eq. 2) takes camera coordinates to a world whose axes may
be chosen; it is singular at φy = ±90°. With z forward, y down and the first camera as the world, turning 90° about the
vertical would be that. So the angles refer to a world of their own, turned against the user's by a constant rotation:
its x is where the camera looks at the start, its y the camera's right, its z down. Heading is then φz, looking up and
down φx, and φy a roll about the optical axis: only a camera held on its side comes near the singularity. Where a motion
or an update leads there, the angles' world is chosen again, exactly for the state, to first order for the covariance.

What the Euler model costs: a constant ω is a constant rate of the angles, which is a constant body rate only for turns
about one axis. Turning at w [rad/s] while another angle changes at u, the predicted body rate is off by about u w Δt
in every frame, to be compared with the model's own noise, density · √Δt: at 10 frames a second that is no matter for
0.5 rad/s and takes part in every prediction at 2 rad/s. And white noise on the angles' rates has, about the body's
axes, between √(1 − |sin φy|) and √(1 + |sin φy|) of its deviation: 0.54 to 1.31 where a new world is chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from backends.ekf.covariance import CAMERA, POSE
from slam.geometry import se3
from slam.geometry.se3 import Array, angles, body_rate_matrix, rotation
from slam.models import EstimatorModels

_ACROSS = 0.1  # numerics: sine of an angle between two axes above which it is known what is across both
_PIECES = 64  # numerics: at most, of one step through the angles' singularity


#: Camera axes (right, down, forward) in an angles' world chosen for it: forward is x, right is y, down is z.
CANONICAL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])

#: |φy| beyond which a new angles' world is chosen.
LIMIT = np.pi / 4


@dataclass(frozen=True, eq=False)
class EulerCamera:
    """The papers' [r, φ, v, ω]: position, Euler angles, and their rates; the error is that of these 12."""

    x: Array  # (12,) [m], [rad], [m/s], [rad/s]
    R_world_angles: Array  # the angles' world (3, 3), see the module
    transports: bool  # keep the error of the attitude as a turn about the world's axes, and the covariance with it

    @classmethod
    def first(cls, models: EstimatorModels, consistent: bool) -> EulerCamera:
        """Before the first prediction."""
        x = np.concatenate([models.initial_pose[:3, 3], angles(CANONICAL), np.zeros(6)])
        return cls(x, models.initial_pose[:3, :3] @ CANONICAL.T, consistent)

    @cached_property
    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""
        return se3.pose(self.R_world_angles @ rotation(self.x[3:6]), self.x[:3])

    @property
    def v(self) -> Array:
        """See `Camera`."""
        return self.x[6:9]

    @cached_property
    def attitude_jacobian(self) -> Array:
        """See `Camera`."""
        return np.asarray(self.pose[:3, :3] @ body_rate_matrix(self.x[3:6]))

    def plus(self, error: Array) -> EulerCamera:
        """See `Camera`."""
        return replace(self, x=self.x + error)

    def at(self, T: Array) -> EulerCamera:
        """See `Camera`."""
        phi, before = angles(self.R_world_angles.T @ T[:3, :3]), self.x[3:6]
        other = np.array([phi[0] + np.pi, np.pi - phi[1], phi[2] + np.pi])  # the same rotation
        changes = np.stack([phi, other]) - before
        changes -= 2 * np.pi * np.round(changes / (2 * np.pi))
        nearest = before + changes[np.argmin(np.linalg.norm(changes, axis=1))]
        return replace(self, x=np.concatenate([T[:3, 3], nearest, self.x[POSE:]]))

    def minus(self, other: EulerCamera) -> Array:
        """See `Camera`."""
        return self.x - other.x

    def advanced(self, dt: float) -> tuple[EulerCamera, Array, Array]:
        """See `Camera`: in pieces through the angles' singularity.

        Impulses at the beginning change the velocities, after the first new world, and A carries them on.
        """
        turn = np.linalg.norm(body_rate_matrix(self.x[3:6]) @ self.x[9:]) * dt  # φy turns by no more
        pieces = math.ceil(np.clip(turn / LIMIT, 1, _PIECES))
        camera, J, W = self, np.eye(CAMERA), np.eye(CAMERA)[:, POSE:]
        for piece in range(pieces):
            phi_y, rate = camera.x[[4, 10]]
            if max(abs(phi_y), abs(phi_y + rate * dt / pieces)) > LIMIT:
                camera, G = camera.with_new_angles(camera.pose)
                J = G @ J
                W = G @ W if piece else W
            camera, A = camera._transition(dt / pieces)
            J, W = A @ J, A @ W
        return camera, J, W

    def _transition(self, dt: float) -> tuple[EulerCamera, Array]:
        """``x ← f(x)`` as printed, and A: as printed if the covariance is not transported.

        If the covariance is transported, the attitude's error is carried as a turn about the world's axes, not as one
        of the angles φ, and the rates' error is that of the body's rate, as rates of the angles: a turn of the
        world leaves it as it is. The printed transition has constant rates of the angles, which is not the same in
        another world. As printed, A is the derivative of f, but the covariance would shrink along turns of the world,
        which nothing measures, in every step.
        """
        A = np.eye(CAMERA)
        A[:POSE, POSE:] = dt * np.eye(POSE)
        after = replace(self, x=A @ self.x)
        if self.transports:
            A[3:6, 3:6] = np.linalg.solve(after.attitude_jacobian, self.attitude_jacobian)
        return after, A

    def stopped(self) -> EulerCamera:
        """See `Camera`."""
        return replace(self, x=np.concatenate([self.x[:POSE], np.zeros(POSE)]))

    def regular_towards(self, T: Array) -> tuple[EulerCamera, Array]:
        """See `Camera`."""
        sine = self.R_world_angles[:, 2] @ T[:3, 0]  # −sin φy
        return self.with_new_angles(T) if abs(sine) > math.sin(LIMIT) else (self, np.eye(CAMERA))

    def with_new_angles(self, T: Array) -> tuple[EulerCamera, Array]:
        """In a new angles' world, chosen for its attitude; and the Jacobian (12, 12) of its error by the old.

        Its y is the camera's right, its z across the right of both this and a pose T (4, 4): φy is zero there, too; or,
        where both look alike, the camera's down.
        """
        phi, omega, J, x = self.x[3:6], self.x[9:12], np.eye(CAMERA), self.x.copy()
        R = self.pose[:3, :3]
        across = np.cross(R[:, 0], T[:3, 0])
        size = np.linalg.norm(across)
        down = across / size if size > _ACROSS else R[:, 1]
        world = np.stack([np.cross(R[:, 0], down), R[:, 0], down], axis=1)
        new = angles(world.T @ R)
        inverse = np.linalg.inv(body_rate_matrix(new))  # the angles' world is made so that this is orthonormal
        G = inverse @ body_rate_matrix(phi)
        x[3:6], x[9:12] = new, G @ omega
        J[3:6, 3:6] = J[9:12, 9:12] = G
        if not self.transports:  # else the rates' error is that of the body's rate
            J[9:12, 3:6] = inverse @ (body_rate_derivative(phi, omega) - body_rate_derivative(new, x[9:12]) @ G)
        return replace(self, x=x, R_world_angles=world), J


def body_rate_derivative(phi: Array, omega: Array) -> Array:
    """``∂(E(φ) ω)/∂φ`` (3, 3) for angle rates ω (3,)."""
    sx, sy, _ = np.sin(phi)
    cx, cy, _ = np.cos(phi)
    _, wy, wz = omega
    return np.array(
        [
            [0, -cy * wz, 0],
            [-sx * wy + cx * cy * wz, -sx * sy * wz, 0],
            [-cx * wy - sx * cy * wz, -cx * sy * wz, 0],
        ]
    )
