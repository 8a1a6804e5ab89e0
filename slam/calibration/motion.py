"""What two views of the same still points say: flow and disparity of an ideal rig fit one rigid motion.

In coordinates (x, y, D), D the true disparity, a rigid motion is a homography. What the rig is off by spoils that in a
way of its own for each parameter, whatever the motion was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.model import RigModel
from slam.calibration.robust import student_weights
from slam.geometry.se3 import Array, hat, so3_exp

_ITERATIONS = 20  # of Gauss-Newton at most
_CONVERGED = 0.02  # largest last change of a predicted point [px]
_LEAST_NOISE = 0.2  # least noise, as a part of the configured one


@dataclass(frozen=True)
class Pair:
    """The same still points in two views.

    Attributes:
        first, second: ``(x, y, d)`` (N, 3) [px], d the disparity, as measured.
        R, t: first guess of the motion (3, 3), (3,) [baselines] that takes the first view's points to the second's.
    """

    first: Array
    second: Array
    R: Array
    t: Array


def pair_evidence(
    model: RigModel, pair: Pair, parameters: Array, pixel_sigma: float, disparity_sigma: float
) -> Evidence | None:
    """The likelihood of the parameters from two views, with motion and points eliminated; None without a solution.

    Motion and the first view's true points are found by Gauss-Newton at the given parameters; there the problem is
    linearised in all of them. Fields are taken at the estimated points, not at the measured ones: else the noise would
    be correlated with the Jacobian, and the result biased. Points are weighted by Student's t distribution, whose
    scale is estimated.

    Args:
        model: the parameters' meaning.
        pair: the views.
        parameters: where to linearise (n,).
        pixel_sigma: noise of x and y [px]; only its ratio to the next matters.
        disparity_sigma: noise of d [px].
    """
    noise = np.diag(np.square([pixel_sigma, pixel_sigma, disparity_sigma]))
    first = pair.first + model.shift(pair.first, parameters)
    second = pair.second + model.shift(pair.second, parameters)
    points, R, t = first, pair.R, pair.t
    for _ in range(_ITERATIONS):
        moved, J_point, J_motion = move(points, R, t, model.focal)
        # The second view less its prediction from the first, the points' own corrections carried to first order.
        residual = second - moved - (J_point @ (first - points)[..., None])[..., 0]
        back = noise @ np.swapaxes(J_point, 1, 2)
        covariance = noise + J_point @ back
        if not np.isfinite(covariance).all():
            return None
        W = np.linalg.inv(covariance)
        weighted = W * _weights(residual, W)[:, None, None]
        WJ = weighted @ J_motion
        normal = np.tensordot(J_motion, WJ, axes=((0, 1), (0, 1)))
        normal += 1e-12 * np.trace(normal) * np.eye(6)
        step = np.linalg.solve(normal, np.tensordot(WJ, residual, axes=((0, 1), (0, 1))))
        if not np.isfinite(step).all():
            return None
        change = J_motion @ step
        R, t = so3_exp(step[:3]) @ R, t + step[3:]
        points = first + (back @ W @ (residual - change)[..., None])[..., 0]
        if np.abs(change).max() < _CONVERGED:
            J_rig, J_residual = (f(moved) - J_point @ f(points) for f in (model.field, model.residual_field))
            return _eliminated(J_motion, -J_rig, -J_residual, weighted, residual, parameters)
    return None


def parallax(model: RigModel, pair: Pair) -> float:
    """Median of what translation moves the points by in the image [px]."""
    there = move(pair.first, pair.R, pair.t, model.focal)[0]
    turned = move(pair.first, pair.R, 0 * pair.t, model.focal)[0]
    return float(np.median(np.linalg.norm((there - turned)[:, :2], axis=1)))


def _eliminated(
    J_motion: Array, J_rig: Array, J_residual: Array, weights: Array, residual: Array, parameters: Array
) -> Evidence:
    """The likelihood of the parameters with the motion marginalised out (Schur complement)."""
    root = np.swapaxes(np.linalg.cholesky(weights), 1, 2)
    n = 6 + J_rig.shape[2]
    J = (root @ np.concatenate([J_motion, J_rig, J_residual], axis=2)).reshape(-1, n + J_residual.shape[2])
    normal, gradient = J[:, :n].T @ J, J[:, :n].T @ (root @ residual[..., None]).ravel()
    motion = np.linalg.solve(normal[:6, :6] + 1e-12 * np.trace(normal[:6, :6]) * np.eye(6), normal[:6, 6:n])
    reduced = normal[6:] - motion.T @ normal[:6]
    S = reduced[:, 6:n]
    return Evidence(S, S @ parameters + gradient[6:] - motion.T @ gradient[:6], reduced[:, n:])


def move(points: Array, R: Array, t: Array, focal: float) -> tuple[Array, Array, Array]:
    """Points ``(x, y, D)`` (N, 3) of one view in another, which ``R, t`` [baselines] take them to.

    In these coordinates a rigid motion is a homography: ``(x, y, f)ᵀ ← R (x, y, f)ᵀ + D t`` up to the scale that
    ``D`` shares, with D the true disparity. It has no singularity at infinity, where D = 0.

    Returns:
        Moved points (N, 3), Jacobians by the points (N, 3, 3), and by ``[rotation (left), t]`` (N, 3, 6).
    """
    turned = np.column_stack([points[:, :2], np.full(len(points), focal)]) @ R.T
    q = turned + points[:, 2:] * t
    scale = focal / q[:, 2]
    moved = np.column_stack([q[:, :2], points[:, 2]]) * scale[:, None]
    J_q = np.zeros((len(points), 3, 3))
    J_q[:, 0, 0] = J_q[:, 1, 1] = scale
    J_q[:, :, 2] -= moved / q[:, 2:]
    J_point = J_q @ np.column_stack([R[:, :2], t])
    J_point[:, 2, 2] += scale
    J_motion = J_q @ np.concatenate([-hat(turned), points[:, 2, None, None] * np.eye(3)], axis=2)
    return moved, J_point, J_motion


def _weights(residual: Array, W: Array) -> Array:
    """Weights (N,) of residuals (N, 3) with information W (N, 3, 3) for a noise whose scale is estimated."""
    distance = np.einsum("ni,nij,nj->n", residual, W, residual)
    return student_weights(distance, 3, _LEAST_NOISE)
