"""The likelihood from two views of the same still points: flow and disparity of an ideal rig fit one rigid motion.

In coordinates (x, y, D), D the true disparity, a rigid motion is a homography. What the rig is off by spoils that in a
way of its own for each parameter, whatever the motion was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.calibration.evidence import Evidence
from slam.calibration.model import RigModel
from slam.calibration.robust import chi_square_median, student_weights
from slam.geometry.se3 import Array, hat, so3_exp

_ITERATIONS = 20  # of Gauss-Newton at most
_CONVERGED = 1e-3  # largest last change of a predicted point [px]; 0.02 let focal lengths be wrong by percents
_NEARLY = 3e-3  # the same after all iterations: single points that jump to and fro keep some pairs from coming to rest
_EXACT = 1e-3  # least noise of pixels and disparities [px]
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


@dataclass(frozen=True)
class Fit:
    """The motion that takes one view's points to the other's, and the linear problem about it.

    Attributes:
        R, t: the motion.
        points: the first view's, estimated from both views (N, 3) [px].
        moved: where they are in the second view (N, 3) [px].
        J_point, J_motion: derivatives of `moved` (N, 3, 3), (N, 3, 6).
        residual: second view less its prediction from the first (N, 3) [px].
        weights: information of the residuals (N, 3, 3).
    """

    R: Array
    t: Array
    points: Array
    moved: Array
    J_point: Array
    J_motion: Array
    residual: Array
    weights: Array


def fit_motion(first: Array, second: Array, R: Array, t: Array, focal: float, noise: Array) -> Fit | None:
    """Motion and the first view's true points by Gauss-Newton; None where it does not converge.

    Points are weighted by Student's t distribution, whose scale is estimated.

    Args:
        first: points ``(x, y, d)`` (N, 3) [px] of an ideal rig.
        second: the same points in the second view.
        R: first guess of the rotation (3, 3).
        t: of the translation (3,) [baselines].
        focal: focal length [px].
        noise: covariance of a point (3, 3) [px²]; only its form matters.
    """
    points = first
    for _ in range(_ITERATIONS):
        moved, J_point, J_motion = move(points, R, t, focal)
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
        fit, last = Fit(R, t, points, moved, J_point, J_motion, residual, weighted), float(np.abs(change).max())
        if last < _CONVERGED:
            break
    return fit if last < _NEARLY else None


def pair_evidence(model: RigModel, pair: Pair, parameters: Array, noise: Array) -> Evidence | None:
    """The likelihood of the parameters from two views, with motion and points eliminated; None without a solution.

    The problem is linearised in all of them at the motion and the points of `fit_motion`. Fields are taken at the
    estimated points, not at the measured ones: else the noise would be correlated with the Jacobian, and the result
    biased.

    Args:
        model: the parameters' meaning.
        pair: the views.
        parameters: where to linearise (n,).
        noise: covariance of a point (3, 3) [px²]; only its form matters, the scale is estimated.
    """
    first = pair.first + model.shift(pair.first, parameters)
    second = pair.second + model.shift(pair.second, parameters)
    fit = fit_motion(first, second, pair.R, pair.t, model.focal, noise)
    if fit is None:
        return None
    fields = (model.field, model.residual_field)
    J_rig, J_residual = (field(fit.moved) - fit.J_point @ field(fit.points) for field in fields)
    return _eliminated(fit.J_motion, -J_rig, -J_residual, fit.weights, fit.residual, parameters)


def squared_distance(first: Array, second: Array, R: Array, t: Array, focal: float, noise: Array) -> Array:
    """How far points (N, 3) of two views are from the motion, over the noise of both, squared (N,); NaN for never.

    The error of a near point's disparity grows with the motion. A limit of so many pixels would keep those points alone
    whose errors happen to be small, and favour what was believed of the motion before.
    """
    with np.errstate(all="ignore"):
        moved, J, _ = move(first, R, t, focal)
        covariance = noise + J @ noise @ np.swapaxes(J, 1, 2)
        off = second - moved
        good = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(off).all(axis=1)
        out = np.full(len(first), np.nan)
        out[good] = np.einsum("ni,ni->n", off[good], np.linalg.solve(covariance[good], off[good][..., None])[..., 0])
        return out


def noise_variances(pair: Pair, focal: float, noise: Array) -> Array:
    """Variances (2,) [px²] of a pixel and of a disparity, as two views scatter about their motion.

    A feature's place slides over the surface from view to view, in both images alike: pixels are often less exact than
    disparities. Which is which has to be known, else the motion and with it the rig's parameters are biased. `noise`
    (3, 3) [px²] shares the scatter out where it comes from both.
    """
    moved, J, _ = move(pair.first, pair.R, pair.t, focal)
    growth = 1 + np.square(J) @ np.diag(noise) / np.diag(noise)
    squares = np.square(pair.second - moved) / growth
    squares = squares[np.isfinite(squares).all(axis=1)]
    found = np.array([np.median(squares[:, :2]), np.median(squares[:, 2])]) / chi_square_median(1)
    return np.maximum(found, _EXACT**2)


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
