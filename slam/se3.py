"""Rotations and rigid motions: SO(3) and SE(3) with exponential, logarithm and adjoint.

A rotation is a (3, 3) float64 matrix, a pose ``T_a_b`` a (4, 4) one taking coordinates in b to coordinates in a.
A tangent vector of SE(3) is ``[rotation (3), translation (3)]`` in radians and metres, and perturbs on the right:
``T ← T exp(ξ)``; so do all pose covariances in this package. Functions accept leading batch dimensions where the
docstring says (..., 3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: An array of real numbers; computed in float64.
Array = NDArray[np.floating[Any]]

_SMALL = 1e-5  # below this angle [rad] series are exact to double precision


def hat(w: Array) -> Array:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): ``hat(a) @ b = a × b``."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def _coefficients(theta: Array) -> tuple[Array, Array, Array]:
    """``sin θ/θ``, ``(1 − cos θ)/θ²`` and ``(θ − sin θ)/θ³``, accurate down to θ = 0."""
    small = theta < _SMALL
    t = np.where(small, 1.0, theta)
    t2 = theta**2
    a = np.where(small, 1 - t2 / 6, np.sin(t) / t)
    b = np.where(small, 0.5 - t2 / 24, 2 * np.sin(t / 2) ** 2 / t**2)
    c = np.where(theta < 1e-2, 1 / 6 - t2 / 120 + t2**2 / 5040, (t - np.sin(t)) / t**3)
    return a, b, c


def so3_exp(w: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    w = np.asarray(w, float)
    a, b, _ = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def so3_log(R: Array) -> Array:
    """Rotation vectors (..., 3) [rad], angle in [0, π], of rotation matrices (..., 3, 3)."""
    q = quaternion(R)
    vector, scalar = q[..., :3], q[..., 3]
    sine = np.linalg.norm(vector, axis=-1)
    small = sine < _SMALL
    factor = np.where(small, 2.0 + sine**2 / 3, 2 * np.arctan2(sine, scalar) / np.where(small, 1.0, sine))
    return factor[..., None] * vector


def so3_left_jacobian(w: Array) -> Array:
    """Left Jacobian (..., 3, 3) of SO(3): ``exp(w + δ) ≈ exp(J δ) exp(w)``."""
    w = np.asarray(w, float)
    _, b, c = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def quaternion(R: Array) -> Array:
    """Unit quaternions (..., 4) as (x, y, z, w), w ≥ 0, of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, float)
    m = R.reshape(-1, 3, 3)
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    # The largest of x², y², z², w² is found first: dividing by it never loses accuracy.
    choice = np.argmax(np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2], trace], axis=1), axis=1)
    q = np.empty((len(m), 4))
    for i in range(3):
        rows = choice == i
        j, k = (i + 1) % 3, (i + 2) % 3
        r = m[rows]
        q[rows, i] = 1 + r[:, i, i] - r[:, j, j] - r[:, k, k]
        q[rows, j] = r[:, j, i] + r[:, i, j]
        q[rows, k] = r[:, k, i] + r[:, i, k]
        q[rows, 3] = r[:, k, j] - r[:, j, k]
    rows = choice == 3
    r = m[rows]
    q[rows, 0] = r[:, 2, 1] - r[:, 1, 2]
    q[rows, 1] = r[:, 0, 2] - r[:, 2, 0]
    q[rows, 2] = r[:, 1, 0] - r[:, 0, 1]
    q[rows, 3] = 1 + trace[rows]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q[q[:, 3] < 0] *= -1
    return q.reshape(*R.shape[:-2], 4)


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) as (x, y, z, w), normalised first."""
    q = np.asarray(q, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    V = hat(q[..., :3])
    return np.eye(3) + 2 * q[..., 3, None, None] * V + 2 * (V @ V)


def nearest_rotation(M: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix in the Frobenius norm (polar decomposition)."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def pose(R: Array, t: Array) -> Array:
    """Pose (..., 4, 4) from rotation (..., 3, 3) and translation (..., 3)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Array) -> Array:
    """Inverse poses (..., 4, 4)."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def transform(T: Array, points: Array) -> Array:
    """Points (N, 3) taken through one pose (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def exp(xi: Array) -> Array:
    """Poses (..., 4, 4) of tangent vectors (..., 6) = [rotation, translation]."""
    xi = np.asarray(xi, float)
    V = so3_left_jacobian(xi[..., :3])
    return pose(so3_exp(xi[..., :3]), (V @ xi[..., 3:, None])[..., 0])


def log(T: Array) -> Array:
    """Tangent vectors (..., 6) = [rotation, translation] of poses (..., 4, 4)."""
    w = so3_log(T[..., :3, :3])
    t = np.linalg.solve(so3_left_jacobian(w), T[..., :3, 3, None])[..., 0]
    return np.concatenate([w, t], axis=-1)


def adjoint(T: Array) -> Array:
    """Adjoint (6, 6): ``T exp(ξ) T⁻¹ = exp(Ad_T ξ)`` with ξ = [rotation, translation]."""
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(T[:3, 3]) @ R
    return out


def rotation_angle(R: Array) -> Array:
    """Geodesic angles (...,) [rad] of rotation matrices (..., 3, 3)."""
    return np.linalg.norm(so3_log(R), axis=-1)
