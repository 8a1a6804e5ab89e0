"""The camera's attitude in the papers' Euler angles, kept away from their singularity.

The papers' ``R(φ) = Rz(φz) Ry(φy) Rx(φx)`` (paper B, below Eq. 2) takes camera coordinates to a world whose axes may
be chosen; it is singular at φy = ±90°. With z forward, y down and the first camera as the world, turning 90° about the
vertical would be that. So the angles refer to a world of their own, turned against the user's by a constant rotation:
its x is where the camera looks at the start, its y the camera's right, its z down. Heading is then φz, looking up and
down φx, and φy a roll about the optical axis: only a camera held on its side comes near the singularity. There the
angles' world is chosen again (`reanchor`), exactly for the state, to first order for the covariance.

What the Euler model costs: a constant ω is a constant rate of the angles, which is a constant body rate only for turns
about one axis. Turning at w [rad/s] while another angle changes at u, the predicted body rate is off by about u w Δt
in every frame, to be compared with the model's own noise, density · √Δt: at 10 frames a second that is no matter for
0.5 rad/s and takes part in every prediction at 2 rad/s. And white noise on the angles' rates has, about the body's
axes, between √(1 − |sin φy|) and √(1 + |sin φy|) of its deviation: 0.54 to 1.31 where a new world is chosen.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array, angles, body_rate_matrix, rotation

#: Camera axes (right, down, forward) in an angles' world chosen for it: forward is x, right is y, down is z.
CANONICAL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])

#: |φy| beyond which a new angles' world is chosen.
LIMIT = np.pi / 4


def anchor(R_world_left: Array) -> tuple[Array, Array]:
    """The angles' world for an attitude: ``R_world_angles`` (3, 3) and the angles φ (3,) in it."""
    return R_world_left @ CANONICAL.T, angles(CANONICAL)


def attitude(R_world_angles: Array, phi: Array) -> Array:
    """``R_world_left`` (3, 3)."""
    return R_world_angles @ rotation(phi)


def pose_jacobian(R_world_left: Array, phi: Array) -> Array:
    """Derivative (6, 6) of the pose's right perturbation [rotation, translation] by [r, φ]."""
    J = np.zeros((6, 6))
    J[:3, 3:] = body_rate_matrix(phi)
    J[3:, :3] = R_world_left.T
    return J


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


def reanchor(R_world_angles: Array, camera: Array) -> tuple[Array, Array, Array]:
    """A new angles' world for the attitude of a camera state [r, φ, v, ω] (12,), at present ``R_world_angles`` (3, 3).

    Returns the same state in it, the new ``R_world_angles``, and the Jacobian (12, 12) of the new state by the old.
    """
    phi, omega = camera[3:6], camera[9:12]
    R_new, phi_new = anchor(attitude(R_world_angles, phi))
    inverse = np.linalg.inv(body_rate_matrix(phi_new))  # the angles' world is made so that this is orthonormal
    G = inverse @ body_rate_matrix(phi)
    omega_new = G @ omega
    J = np.eye(12)
    J[3:6, 3:6] = J[9:12, 9:12] = G
    J[9:12, 3:6] = inverse @ (body_rate_derivative(phi, omega) - body_rate_derivative(phi_new, omega_new) @ G)
    state = camera.copy()
    state[3:6], state[9:12] = phi_new, omega_new
    return state, R_new, J
