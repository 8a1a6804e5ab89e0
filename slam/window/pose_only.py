"""The newest pose alone, by robust Gauss-Newton on reprojection errors: where the estimators of many poses start from.

They take one Gauss-Newton step or two for all variables together and have no defence against a poor start; so the new
pose is brought close first, with the landmarks held where they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.data import BoolArray
from slam.geometry import kernels
from slam.geometry.pnp import STEPS
from slam.geometry.se3 import Array, inverse, log
from slam.window.gating import chi_square_gate, whiteners
from slam.window.stereo import RectifiedStereo

_HUBER = 1.5  # whitened residual from which on a measurement's pull no longer grows
_ROUNDS = 3  # numerics: of solving and gating
_CONVERGED = 1e-5  # numerics: [rad, m]; the steps shrink quadratically, so what is left is far smaller


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """Landmarks, what was measured of them, and what was predicted."""

    stereo: RectifiedStereo  # the projection
    points: Array  # landmark positions (M, 3) in world coordinates
    z: Array  # measurements (M, 3), NaN where missing
    noise: Array  # covariances (M, 3, 3) of the residuals for a known pose: pixel noise and landmark uncertainty [px²]
    predicted: Array  # pose (4, 4)
    information: Array  # of the predicted pose (6, 6)
    probability: float  # share of good measurements that the gate shall let pass


def solve(problem: PoseProblem, start: Array) -> tuple[Array, BoolArray]:
    """Pose (4, 4) and which measurements (M,) agree with it: first robust, then least squares on what agrees."""
    whitener = _whiteners(problem.noise, problem.z)
    T = _gauss_newton(problem, whitener, start, None)
    used = _gate(problem, T)
    for _ in range(_ROUNDS):
        T = _gauss_newton(problem, whitener, T, used)
        again = _gate(problem, T)
        if (again == used).all():
            break
        used = again
    return T, used


def whitened(problem: PoseProblem, T: Array) -> tuple[Array, Array, Array]:
    """What scales to unit variance (M, 3, 3), and `residuals`."""
    return _whiteners(problem.noise, problem.z), *residuals(problem, T)


def residuals(problem: PoseProblem, T: Array) -> tuple[Array, Array]:
    """Measured less predicted (M, 3), NaN where missing, and the prediction's Jacobians (M, 3, 6) by the pose."""
    stereo = problem.stereo
    r, J = kernels.residuals(stereo.intrinsics, problem.points, problem.z, T)
    return r, J


def _gate(problem: PoseProblem, T: Array) -> BoolArray:
    """Which measurements agree with a pose."""
    r, _ = residuals(problem, T)
    return chi_square_gate(r, problem.noise, problem.probability)


def _whiteners(noise: Array, z: Array) -> Array:
    """Inverse Cholesky factors (M, 3, 3); the third row is zero where there is no right pixel."""
    W = whiteners(noise)
    W[np.isnan(z[:, 2]), 2] = 0
    return W


def _gauss_newton(problem: PoseProblem, whitener: Array, start: Array, used: BoolArray | None) -> Array:
    """Pose by Gauss-Newton with the prediction as prior; with Huber weights where `used` is None."""
    stereo, T = problem.stereo, start[None].copy()
    rows = np.arange(len(problem.points)) if used is None else np.flatnonzero(used)
    kernels.gauss_newton(
        stereo.intrinsics, problem.points, problem.z, whitener, rows[None], problem.information,
        log(inverse(problem.predicted) @ start), T, _HUBER if used is None else np.inf, STEPS, _CONVERGED,
    )  # fmt: skip
    return np.asarray(T[0])


def seen_from(T: Array, points: Array, own: Array) -> tuple[Array, Array]:
    """Points (M, 3) and their covariances (M, 3, 3) in the coordinates of a camera at T (4, 4)."""
    R = T[:3, :3]
    return (points - T[:3, 3]) @ R, R.T @ own @ R


def residual_noise(stereo: RectifiedStereo, sigma: float, local: Array, own: Array, z: Array) -> Array:
    """Covariances (M, 3, 3) of the residuals of measurements (M, 3) for a known pose [px²].

    The landmarks are at `local` (M, 3) in the camera's coordinates, with covariances `own` (M, 3, 3) where all poses
    are known. Pixel noise and the landmark's own uncertainty, linearised at the estimated or at the measured position,
    whichever gives the smaller covariance: close to the camera a small error of depth would explain any pixel.
    """
    return np.asarray(kernels.residual_noise(stereo.intrinsics, local, np.ascontiguousarray(own), z, sigma))
