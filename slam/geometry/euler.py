"""The papers' Euler angles: roll-pitch-yaw about fixed axes (paper B, below Eq. 2).

``R(φ) = Rz(φz) Ry(φy) Rx(φx)`` takes camera coordinates to world coordinates; φ = [φx, φy, φz] in radians.
Singular at φy = ±π/2, where φx and φz turn about the same axis.
"""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array


def rotation(phi: Array) -> Array:
    """Rotation matrix (3, 3) of the angles (3,): ``R_C^W`` of paper B, below Eq. 2."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(phi).tolist(), np.cos(phi).tolist()  # Python's floats are the faster ones
    return np.array(
        [
            [cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz],
            [cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz],
            [-sy, sx * cy, cx * cy],
        ]
    )


def angles(R: Array) -> Array:
    """Angles (3,) [rad] of a rotation matrix, φy in [−π/2, π/2] (paper B, step d, the printed atan2 formulas).

    At the singularity φx is undetermined and set to 0.
    """
    cos_y = np.hypot(R[2, 1], R[2, 2])
    if cos_y < 1e-12:
        return np.array([0.0, np.arctan2(-R[2, 0], cos_y), np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), np.arctan2(-R[2, 0], cos_y), np.arctan2(R[1, 0], R[0, 0])])


def body_rate_matrix(phi: Array) -> Array:
    """``E(φ)`` (3, 3) with body angular rate ``ω = E(φ) φ̇``; singular at φy = ±π/2."""
    (sx, sy, _), (cx, cy, _) = np.sin(phi).tolist(), np.cos(phi).tolist()
    return np.array([[1, 0, -sy], [0, cx, sx * cy], [0, -sx, cx * cy]])


def about(angle: Array, axis: int) -> Array:
    """Rotations (N, 3, 3) by angles (N,) [rad] about one coordinate axis."""
    angle = np.atleast_1d(np.asarray(angle, float))
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i], R[:, i, j] = np.sin(angle), -np.sin(angle)
    return R
