"""Rotations and rigid motions: SO(3) and SE(3) with exponential, logarithm and adjoint.

A rotation is a (3, 3) float64 matrix, a pose ``T_a_b`` a (4, 4) one taking coordinates in b to coordinates in a.
A tangent vector of SE(3) is ``[rotation (3), translation (3)]`` in radians and metres, and perturbs on the right:
``T ← T exp(ξ)``; so do all pose covariances in this package. Functions accept leading batch dimensions where the
docstring says (..., 3).

Each rotation or pose is worked out in Python's floats, which takes a tenth of the time that NumPy needs for as many
operations on arrays of three numbers.

At the end stand the papers' Euler angles (paper B, below Eq. 2): ``R(φ) = Rz(φz) Ry(φy) Rx(φx)`` takes camera
coordinates to world coordinates; φ = [φx, φy, φz] in radians, singular at φy = ±π/2, where φx and φz turn about the
same axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from slam.geometry.arrays import Array as Array
from slam.geometry.arrays import BoolArray

#: numerics: Variance [rad², m²] that a covariance has at least, or that is added to it, to keep it invertible.
LEAST_VARIANCE = 1e-12

_MINUS_ONE = -np.eye(3)
_SMALL = 1e-5  # numerics: below this angle [rad] series are exact to double precision
_SMALL_CUBIC = 1e-2  # numerics: the same where a difference of third order is taken


def hat(w: Array) -> Array:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): ``hat(a) @ b = a × b``."""
    w = np.asarray(w, float)
    if w.ndim == 1:
        x, y, z = w.tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def _each(function: Callable[[Any], Any], values: Array, shape: tuple[int, ...], result: tuple[int, ...]) -> Array:
    """A function of lists, of one value of some shape after the other."""
    values = np.asarray(values, float)
    if values.shape == shape:
        return np.array(function(values.tolist()))
    batch = values.shape[: values.ndim - len(shape)]
    return np.array([function(value) for value in values.reshape(-1, *shape).tolist()]).reshape(*batch, *result)


def so3_exp(w: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    return _each(lambda one: _polynomial(one, *_coefficients(one)[:2]), w, (3,), (3, 3))


def so3_log(R: Array) -> Array:
    """Rotation vectors (..., 3) [rad], angle in [0, π], of rotation matrices (..., 3, 3)."""
    return _each(_rotation_vector, R, (3, 3), (3,))


def so3_left_jacobian(w: Array) -> Array:
    """Left Jacobian (..., 3, 3) of SO(3): ``exp(w + δ) ≈ exp(J δ) exp(w)``."""
    return _each(lambda one: _polynomial(one, *_coefficients(one)[1:]), w, (3,), (3, 3))


def quaternion(R: Array) -> Array:
    """Unit quaternions (..., 4) as (x, y, z, w), w ≥ 0, of rotation matrices (..., 3, 3)."""
    return _each(_quaternion, R, (3, 3), (4,))


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) as (x, y, z, w), normalised first."""
    q = np.asarray(q, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    V = hat(q[..., :3])
    return np.eye(3) + 2 * q[..., 3, None, None] * V + 2 * (V @ V)


def nearest_rotation(M: Array) -> Array:
    """The rotation (D, D), D = 2 or 3, nearest to a matrix in the Frobenius norm (polar decomposition)."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([*np.ones(len(M) - 1), np.linalg.det(U @ Vt)]) @ Vt)


def is_rotation(R: Array, tolerance: float) -> BoolArray:
    """Which matrices (..., 3, 3) are rotations, to within `tolerance` in the elements of ``R Rᵀ``; none with a NaN."""
    return _each(lambda one: _is_rotation(one, tolerance), R, (3, 3), ()).astype(bool)


def pose(R: Array, t: Array) -> Array:
    """Pose (..., 4, 4) from rotation (..., 3, 3) and translation (..., 3)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    if R.ndim == 2 and t.ndim == 1:
        T = np.zeros((4, 4))
        T[:3, :3], T[:3, 3], T[3, 3] = R, t, 1.0
        return T
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Array) -> Array:
    """Inverse poses (..., 4, 4)."""
    if T.ndim == 2:
        return pose(T[:3, :3].T, -(T[:3, 3] @ T[:3, :3]))
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def transform(T: Array, points: Array) -> Array:
    """Points (N, 3) taken through one pose (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def exp(xi: Array) -> Array:
    """Poses (..., 4, 4) of tangent vectors (..., 6) = [rotation, translation]."""
    return _each(_exp, xi, (6,), (4, 4))


def log(T: Array) -> Array:
    """Tangent vectors (..., 6) = [rotation, translation] of poses (..., 4, 4)."""
    return _each(_log, T, (4, 4), (6,))


def twice(R: Array) -> Array:
    """A rotation (3, 3) of both halves of [rotation, translation] or [ω, v]: ``diag(R, R)`` (6, 6)."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = R
    return both


def adjoint(T: Array) -> Array:
    """Adjoint (..., 6, 6) of T (..., 4, 4): ``T exp(ξ) T⁻¹ = exp(Ad_T ξ)`` with ξ = [rotation, translation]."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out


def points_by_pose(local: Array) -> Array:
    """Derivatives (N, 3, 6) of fixed points, at `local` (N, 3) in a frame, by the frame's pose: ``[hat(p), −1]``."""
    out = np.empty((len(local), 3, 6))
    out[:, :, :3], out[:, :, 3:] = hat(local), _MINUS_ONE
    return out


def rotation_angle(R: Array) -> Array:
    """Geodesic angles (...,) [rad] of rotation matrices (..., 3, 3)."""
    return np.linalg.norm(so3_log(R), axis=-1)


# --- one rotation or pose ---


def _coefficients(w: list[float]) -> tuple[float, float, float]:
    """``sin θ/θ``, ``(1 − cos θ)/θ²`` and ``(θ − sin θ)/θ³`` of a rotation vector, NaN where it is not finite."""
    theta = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if not math.isfinite(theta):
        return math.nan, math.nan, math.nan
    t2 = theta * theta
    if theta < _SMALL:
        return 1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120
    sine, half = math.sin(theta), math.sin(theta / 2)
    c = 1 / 6 - t2 / 120 + t2 * t2 / 5040 if theta < _SMALL_CUBIC else (theta - sine) / (t2 * theta)
    return sine / theta, 2 * half * half / t2, c


def _polynomial(w: list[float], a: float, b: float) -> list[list[float]]:
    """``1 + a W + b W²`` (3, 3) with ``W = hat(w)``."""
    x, y, z = w
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    xx, yy, zz = b * x * x, b * y * y, b * z * z
    ax, ay, az = a * x, a * y, a * z
    return [[1 - yy - zz, xy - az, xz + ay], [xy + az, 1 - xx - zz, yz - ax], [xz - ay, yz + ax, 1 - xx - yy]]


def _is_rotation(R: list[list[float]], tolerance: float) -> bool:
    (a, b, c), (d, e, f), (g, h, i) = R
    return (  # false for NaN, too
        abs(a * a + b * b + c * c - 1) <= tolerance and abs(a * d + b * e + c * f) <= tolerance
        and abs(d * d + e * e + f * f - 1) <= tolerance and abs(d * g + e * h + f * i) <= tolerance
        and abs(g * g + h * h + i * i - 1) <= tolerance and abs(g * a + h * b + i * c) <= tolerance
        and a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0
    )  # fmt: skip


def _quaternion(R: list[list[float]]) -> tuple[float, float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = R
    trace = a + e + i
    largest = max(a, e, i, trace)
    if largest == a:
        q = (1 + a - e - i, d + b, g + c, h - f)
    elif largest == e:
        q = (b + d, 1 + e - a - i, h + f, c - g)
    elif largest == i:
        q = (c + g, f + h, 1 + i - a - e, d - b)
    else:
        q = (h - f, c - g, d - b, 1 + trace)
    scale = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0:
        scale = -scale
    return q[0] / scale, q[1] / scale, q[2] / scale, q[3] / scale


def _rotation_vector(R: list[list[float]]) -> tuple[float, float, float]:
    x, y, z, w = _quaternion(R)
    sine2 = x * x + y * y + z * z
    sine = math.sqrt(sine2)
    factor = 2.0 + sine2 / 3 if sine < _SMALL else 2 * math.atan2(sine, w) / sine
    return factor * x, factor * y, factor * z


def _exp(xi: list[float]) -> list[list[float]]:
    x, y, z, u, v, w = xi
    a, b, c = _coefficients([x, y, z])
    first, second, third = _polynomial([x, y, z], a, b)
    along, t2 = x * u + y * v + z * w, x * x + y * y + z * z
    first.append(u + b * (y * w - z * v) + c * (x * along - u * t2))
    second.append(v + b * (z * u - x * w) + c * (y * along - v * t2))
    third.append(w + b * (x * v - y * u) + c * (z * along - w * t2))
    return [first, second, third, [0.0, 0.0, 0.0, 1.0]]


def _log(T: list[list[float]]) -> tuple[float, float, float, float, float, float]:
    """The inverse of the left Jacobian is ``1 − W/2 + k W²``."""
    x, y, z = _rotation_vector([row[:3] for row in T[:3]])
    u, v, w = T[0][3], T[1][3], T[2][3]
    t2 = x * x + y * y + z * z
    half = math.sqrt(t2) / 2
    k = 1 / 12 + t2 / 720 + t2 * t2 / 30240 if 2 * half < _SMALL_CUBIC else (1 - half / math.tan(half)) / t2
    along = x * u + y * v + z * w
    return (
        x, y, z,
        u - (y * w - z * v) / 2 + k * (x * along - u * t2),
        v - (z * u - x * w) / 2 + k * (y * along - v * t2),
        w - (x * v - y * u) / 2 + k * (z * along - w * t2),
    )  # fmt: skip


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
