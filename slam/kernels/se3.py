"""Rigid motions, as in `slam.geometry.se3`: tangent vectors are [rotation, translation] and perturb on the right.

Of poses (4, 4) only the upper three rows are read and written, so that they may also be (3, 4).
"""

from __future__ import annotations

import numpy as np

from slam.kernels.linear import row_times
from slam.runtime.compilation import helper


@helper
def transform(T, point, out):
    """``R p + t`` of a point (3,)."""
    for i in range(3):
        out[i] = row_times(T, i, point) + T[i, 3]


@helper
def transform_back(T, point, out):
    """``Rᵀ (p − t)`` of a point (3,): by the inverse pose."""
    x, y, z = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
    for i in range(3):
        out[i] = T[0, i] * x + T[1, i] * y + T[2, i] * z


@helper
def compose(A, B, out):
    """``A B``; `out` is neither of them."""
    for i in range(3):
        for j in range(4):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
        out[i, 3] += A[i, 3]


@helper
def between(A, B, out):
    """``A⁻¹ B``; `out` is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
        out[i, 3] = A[0, i] * (B[0, 3] - A[0, 3]) + A[1, i] * (B[1, 3] - A[1, 3]) + A[2, i] * (B[2, 3] - A[2, 3])


@helper
def exp(step, out):
    """``exp ξ`` of a tangent vector (6,) = [θ, τ]: rotation ``1 + a W + b W²`` and translation ``(1 + b W + c W²) τ``.

    W = hat(θ), a = sin θ/θ, b = (1 − cos θ)/θ², c = (θ − sin θ)/θ³.
    """
    t2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    t = np.sqrt(t2)
    a, b, c = 1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120 + t2 * t2 / 5040
    if t >= 1e-5:  # 1e-5: below this angle [rad] series are exact to double precision
        a, b = np.sin(t) / t, 2 * np.sin(0.5 * t) ** 2 / t2
    if t >= 1e-2:  # 1e-2: the same where a difference of third order is taken
        c = (t - np.sin(t)) / (t * t2)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] = 1 + b * (step[i] * step[i] - t2)
        out[i, j] = b * step[i] * step[j] - a * step[k]
        out[i, k] = b * step[i] * step[k] + a * step[j]
        out[i, 3] = (1 + c * (step[i] * step[i] - t2)) * step[3 + i]
        out[i, 3] += (c * step[i] * step[j] - b * step[k]) * step[3 + j]
        out[i, 3] += (c * step[i] * step[k] + b * step[j]) * step[3 + k]


@helper
def move(T, step):
    """``T ← T exp ξ`` by a tangent vector (6,)."""
    change, before = np.empty((3, 4)), np.empty((4, 4))
    exp(step, change)
    for i in range(4):  # `copy` takes longer to compile
        for j in range(4):
            before[i, j] = T[i, j]
    compose(before, change, T)


@helper
def rotation_vector(R, w, inverse_J):
    """Rotation vector w (3,) of a turn by less than a half, and its inverse left Jacobian (3, 3).

    ``J⁻¹ = 1 − W/2 + k W²`` with k = (1 − θ/2 cot θ/2)/θ²; the right Jacobian's inverse is its transpose. The logarithm
    of a pose is [w, J⁻¹ t].
    """
    a, b, c = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = np.sqrt(a * a + b * b + c * c)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1))
    scale, bend = 1.0, 1 / 12
    if not sine < 1e-6:  # 1e-6: sine of an angle below which the logarithm's series are exact
        scale, half = angle / sine, 0.5 * angle
        bend = (1 - half / np.tan(half)) / (4 * half * half)
    x, y, z = scale * a, scale * b, scale * c
    w[0], w[1], w[2] = x, y, z
    square = x * x + y * y + z * z
    for i in range(3):
        for j in range(3):
            inverse_J[i, j] = bend * w[i] * w[j]
        inverse_J[i, i] += 1 - bend * square
    inverse_J[0, 1] += 0.5 * z
    inverse_J[0, 2] -= 0.5 * y
    inverse_J[1, 0] -= 0.5 * z
    inverse_J[1, 2] += 0.5 * x
    inverse_J[2, 0] += 0.5 * y
    inverse_J[2, 1] -= 0.5 * x


@helper
def log(T, w, inverse_J, out):
    """Tangent vector (6,) of a pose that turns by less than a half; w (3,) and inverse_J as in `rotation_vector`."""
    rotation_vector(T, w, inverse_J)
    for i in range(3):
        out[i] = w[i]
        out[3 + i] = inverse_J[i, 0] * T[0, 3] + inverse_J[i, 1] * T[1, 3] + inverse_J[i, 2] * T[2, 3]


@helper
def adjoint(T, out):
    """``Ad_T`` (6, 6) = [[R, 0], [hat(t) R, R]]: ``T exp(ξ) T⁻¹ = exp(Ad_T ξ)``."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            out[i, c] = out[3 + i, 3 + c] = T[i, c]
            out[i, 3 + c] = 0.0
            out[3 + i, c] = T[j, 3] * T[k, c] - T[k, 3] * T[j, c]


@helper
def point_by_motion(y, scale, out):
    """Derivatives (3, 6) of ``exp(scale ξ) y`` of a point (3,) by ξ at 0: ``scale [−hat(y), 1]``."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] = 0.0
        out[i, j], out[i, k] = scale * y[k], -scale * y[j]
        out[i, 3 + i], out[i, 3 + j], out[i, 3 + k] = scale, 0.0, 0.0
