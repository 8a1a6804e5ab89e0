"""Pairs of views of the same still points, and the likelihood that they give: flow and disparity fit one rigid motion.

In coordinates (x, y, D), D the true disparity, a rigid motion is a homography. Each error of the rig violates that in a
way of its own, whatever the motion was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.calibration import kernels
from slam.calibration.model import RigModel
from slam.calibration.posterior import Evidence
from slam.chi_square import chi_square_limit
from slam.data import StereoFeatures
from slam.geometry.arrays import median
from slam.geometry.se3 import Array, inverse
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Matches, match_everywhere
from slam.window.consensus import find_consensus

_RATIO = 0.8  # largest ratio of the best to the second best descriptor distance
_MEDIAN_1, _MEDIAN_3 = chi_square_limit(1, 0.5), chi_square_limit(3, 0.5)  # derived: medians of χ²
_AGREES = 2.5  # largest reprojection error of a match that agrees with the motion [px]
_EACH = _AGREES / np.sqrt(2)  # the same of each coordinate in each of the two views, all equally exact


@dataclass(frozen=True, eq=False)
class View:
    """The stereo features of one frame, as measured."""

    points: Array  # ``(x, y, d)`` (N, 3), rectified pixel from the principal point and disparity [px]
    vertical: Array  # right row less left row (N,) [px]
    features: StereoFeatures
    T_world_left: Array  # pose of the rectified left camera (4, 4) as the system has it

    @classmethod
    def of(cls, model: RigModel, features: StereoFeatures, T_world_left: Array, most: int) -> View:
        """Of the strongest features, `most` at the most, in rectified pixels."""
        rows = np.flatnonzero(features.has_stereo)
        if len(rows) > most:
            rows = np.sort(rows[np.argsort(-features.response[rows], kind="stable")[:most]])
        seen = features.select(rows)
        points = model.points(np.column_stack([seen.uv_left, seen.uv_right[:, 0]]))
        return cls(points, seen.uv_right[:, 1] - seen.uv_left[:, 1], seen, T_world_left)


def match(first: View, second: View) -> Matches:
    """Rows of features of two views that look alike; those of the first are the tracks."""
    looks = first.features
    return match_everywhere(looks.descriptors, looks.laplacian, second.features, AssociationConfig.wide_d_match, _RATIO)


class Pair(NamedTuple):
    """The same still points in two views, corrected by what is known of the rig, and a first guess of the motion."""

    first: Array  # ``(x, y, d)`` (N, 3) [px], d the disparity
    second: Array
    R: Array  # (3, 3), (3,) [baselines]: takes the first view's points to the second's
    t: Array


def pair_of(
    model: RigModel, first: View, second: View, parameters: Array, noise: Array, seed: int, matched: Matches
) -> Pair:
    """Matches of two views that agree on one motion, and that motion.

    The motion of the system's poses is tried first; others are tried only if most matches disagree with it. The rig is
    corrected by `parameters` (n,). Of the `noise`, a point's covariance (3, 3) [px²], only the form matters. `seed` is
    of the random choice in the geometric check.
    """
    seen = first.points[matched.tracks], second.points[matched.features]
    one, two = (points + model.shift(points, parameters)[:, :3] for points in seen)
    rig = model.rig.rectified.rig
    T: Array = inverse(second.T_world_left) @ first.T_world_left
    R, t = T[:3, :3], T[:3, 3] / rig.baseline
    agree = _agreeing(model, one, two, R, t)
    near = (one[:, 2] > 1.0) & (two[:, 2] > 1.0)  # 1.0: least disparity of a point that helps to find the motion [px]
    if 2 * agree.sum() < len(agree) and near.sum() >= 3:
        before, after = model.rows(one[near]), model.rows(two[near])
        local = rig.triangulate(before[:, :2], before[:, [2, 1]])
        # 100: poses tried in the geometric check of a pair of views
        found = find_consensus(rig, local, after, inverse(T), _AGREES, 100, seed)
        T = np.asarray(inverse(found.T_world_left))
        R, t = T[:3, :3], T[:3, 3] / rig.baseline
        agree = _agreeing(model, one, two, R, t)
    for _ in range(2):  # 2: times that motion and inliers are recomputed
        fitted = fit_motion(one[agree], two[agree], R, t, model.focal, noise) if agree.sum() >= 3 else None
        if fitted is None:
            break
        R, t = fitted.R, fitted.t
        distance = _fitted(one, two, R, t, model.focal, noise, 0)[0].squared
        # 16.3: χ²(3) at 99.9 %, largest squared distance of a match that agrees
        agree = distance <= 16.3 * median(distance[agree]) / _MEDIAN_3
    return Pair(one[agree], two[agree], R, t)


def _agreeing(model: RigModel, first: Array, second: Array, R: Array, t: Array) -> NDArray[np.bool_]:
    """Which points (N,) of two views agree with a motion."""
    moved, J, _ = move(first, R, t, model.focal)
    with np.errstate(invalid="ignore"):
        return (np.abs(moved - second) <= _EACH * np.sqrt(1 + np.square(J).sum(axis=2))).all(axis=1)


class Fit(NamedTuple):
    """The motion that takes one view's points to the other's, linearised at estimates of the first view's points.

    The residuals carry the points' own corrections to first order. The motion amplifies the disparity errors of near
    points, so that a limit in pixels would keep only points whose errors happen to be small.
    """

    R: Array  # the motion
    t: Array
    points: Array  # the first view's, estimated from both views (N, 3) [px]
    moved: Array  # where the motion takes the points, in the last step (N, 3) [px]
    J_point: Array  # derivatives of `moved` by the points (N, 3, 3)
    J_motion: Array  # and by ``[rotation (left), t]`` (N, 3, 6)
    residual: Array  # second view less its prediction from the first (N, 3) [px]
    information: Array  # of the residuals (N, 3, 3), up to a common factor
    weights: Array  # of the points (N,)

    @property
    def squared(self) -> Array:
        """Squared Mahalanobis distances of the residuals (N,)."""
        weighted = self.information @ self.residual[:, :, None]
        return np.asarray((self.residual * weighted[:, :, 0]).sum(axis=1))


def fit_motion(first: Array, second: Array, R: Array, t: Array, focal: float, noise: Array) -> Fit | None:
    """Fit the motion and the first view's true points by Gauss-Newton; None if it does not converge.

    `first` and `second` are the same points ``(x, y, d)`` (N, 3) [px] of an ideal rig with a focal length `focal` [px],
    `R` (3, 3) and `t` (3,) [baselines] a first guess. Points are weighted by Student's t distribution, whose scale is
    estimated, so that of the `noise`, a point's covariance (3, 3) [px²], only the form matters.
    """
    fitted, last = _fitted(first, second, R, t, focal, noise, 20)  # 20: iterations at most
    # 3e-3: change of a predicted point [px] in the last iteration: in some pairs single points oscillate
    return fitted if last < 3e-3 else None


def pair_evidence(model: RigModel, pair: Pair, parameters: Array, noise: Array) -> Evidence | None:
    """The likelihood of the parameters from two views, with motion and points eliminated; None without a solution.

    The problem is linearised at `parameters` (n,), of which the pair was corrected, and at the motion and the points of
    `fit_motion`: at measured points, the noise would be correlated with the Jacobian, and the result biased. Of the
    `noise`, a point's covariance (3, 3) [px²], only the form matters.
    """
    fit = fit_motion(*pair, model.focal, noise)
    if fit is None:
        return None
    by_rig = fit.J_point @ model.field(fit.points)[:, :3] - model.field(fit.moved)[:, :3]
    J = np.concatenate([fit.J_motion, by_rig], axis=2)
    by_moved = fit.weights[:, None, None] * fit.information @ J
    rows = by_moved.reshape(-1, J.shape[2])
    normal, gradient = rows.T @ J.reshape(rows.shape), rows.T @ fit.residual.ravel()
    by_fields = fit.J_point @ model.residual_field(fit.points)[:, :3] - model.residual_field(fit.moved)[:, :3]
    cross = rows.T @ by_fields.reshape(len(rows), -1)
    H = normal[:6, :6] + 1e-12 * np.trace(normal[:6, :6]) * np.eye(6)  # invertible
    motion = np.linalg.solve(H, normal[:6, 6:])  # Schur complement
    S = normal[6:, 6:] - motion.T @ normal[:6, 6:]
    return Evidence(S, S @ parameters + gradient[6:] - motion.T @ gradient[:6], cross[6:] - motion.T @ cross[:6])


def noise_variances(pair: Pair, focal: float, noise: Array) -> Array:
    """Variances (2,) [px²] of a pixel and of a disparity, from the scatter of two views about their motion.

    A feature shifts over the surface from view to view, equally in both images, so pixels are often less exact than
    disparities. Both variances are needed, else the motion and with it the rig's parameters are biased. Scatter to
    which both contribute is divided according to `noise` (3, 3) [px²].
    """
    moved, J, _ = move(pair.first, pair.R, pair.t, focal)
    growth = 1 + np.square(J) @ np.diag(noise) / np.diag(noise)
    squares = np.square(pair.second - moved) / growth
    squares = squares[np.isfinite(squares).all(axis=1)]
    found = np.array([median(squares[:, :2]), median(squares[:, 2])]) / _MEDIAN_1
    return np.maximum(found, 1e-3**2)  # 1e-3: least noise of pixels and disparities [px]


def parallax(model: RigModel, pair: Pair) -> float:
    """Median displacement of the points in the image by translation [px]."""
    there, turned = (move(pair.first, pair.R, t, model.focal)[0] for t in (pair.t, 0 * pair.t))
    return float(np.median(np.linalg.norm((there - turned)[:, :2], axis=1)))


def move(points: Array, R: Array, t: Array, focal: float) -> tuple[Array, Array, Array]:
    """Transform points ``(x, y, D)`` (N, 3) of one view to another by ``R, t`` [baselines].

    In these coordinates a rigid motion is a homography: ``(x, y, f)ᵀ ← R (x, y, f)ᵀ + D t`` up to the scale that ``D``
    shares, with D the true disparity. It has no singularity at infinity, where D = 0. Returns moved points (N, 3),
    Jacobians by the points (N, 3, 3), and by ``[rotation (left), t]`` (N, 3, 6).
    """
    at = _fitted(points, points, R, t, focal, np.eye(3), 0)[0]
    return at.moved, at.J_point, at.J_motion


def _fitted(
    first: Array, second: Array, R: Array, t: Array, focal: float, noise: Array, steps: int
) -> tuple[Fit, float]:
    """The motion after `steps` at most, and the last change of a predicted point [px], infinite without a solution."""
    arrays = (np.ascontiguousarray(a, float) for a in (first, second, R, t))
    found, last = kernels.fit(*arrays, focal, noise, _MEDIAN_3, steps)
    return Fit(*found), float(last)
