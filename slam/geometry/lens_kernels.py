"""Compiled loops of lens distortion by Brown and Conrady."""

from __future__ import annotations

import numpy as np

from slam.runtime.compilation import helper, kernel


@kernel
def distort(ab, coefficients, limit, jacobian):
    """Distorted normalised coordinates (N, 2), and derivatives (N, 2, 2), or (0, 2, 2) if they are not asked for.

    Args:
        ab: normalised coordinates (N, 2).
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6 (8,): three radial, two tangential, three rational.
        limit: radius beyond which the polynomial folds rays back into the image: NaN there.
        jacobian: whether derivatives are asked for.
    """
    out, D, one = np.empty_like(ab), np.empty((len(ab) if jacobian else 0, 2, 2)), np.empty((2, 2))
    for i in range(len(ab)):
        a, b = ab[i, 0], ab[i, 1]
        if np.sqrt(a * a + b * b) > limit:
            a = b = np.nan
        x, y = _distorted(coefficients, a, b, one)
        out[i, 0], out[i, 1] = x, y
        if jacobian:
            D[i, 0, 0], D[i, 0, 1], D[i, 1, 0], D[i, 1, 1] = one[0, 0], one[0, 1], one[1, 0], one[1, 1]
    return out, D


@kernel
def undistort(target, coefficients, limit):
    """Normalised coordinates (N, 2) of distorted ones, by Newton's method; NaN where no ray leads there."""
    out, D = np.empty_like(target), np.empty((2, 2))
    for i in range(len(target)):
        a, b, step = target[i, 0], target[i, 1], np.inf
        for _ in range(50):  # 50: Newton steps at most
            x, y = _distorted(coefficients, a, b, D)
            x, y = x - target[i, 0], y - target[i, 1]
            det = D[0, 0] * D[1, 1] - D[0, 1] * D[1, 0]
            da, db = (D[1, 1] * x - D[0, 1] * y) / det, (D[0, 0] * y - D[1, 0] * x) / det
            a, b, step = a - da, b - db, max(abs(da), abs(db))
            if not step > 1e-13:  # 1e-13: a step below it is the last
                break
        # 1e-9: a last step above it means that no ray leads to the pixel
        if not (step < 1e-9 and np.sqrt(a * a + b * b) <= limit):
            a = b = np.nan
        out[i, 0], out[i, 1] = a, b
    return out


@helper
def _distorted(coefficients, a, b, D):
    """One pair of coordinates, distorted, and its derivatives D (2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = a * a + b * b
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
    slope *= 2 / denominator  # d radial / d a = slope · a
    D[0, 0] = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
    D[0, 1] = D[1, 0] = a * b * slope + 2 * p1 * a + 2 * p2 * b
    D[1, 1] = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
    x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    return x, b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
