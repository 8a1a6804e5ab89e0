"""A constant error of the stereo disparity, found from the images alone while the system runs.

A small turn of the right camera after calibration (or an error of rectification) makes every disparity too large or too
small by the same few tenths of a pixel. Far points suffer most, and paths come out too long or too short. Between two
frames the flow of a still point, less the part that rotation makes, is proportional to its true disparity: where the
flow vanishes, the measured disparity is the offset. docs/selfcalibration.md derives the estimator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.bounds import require_positive
from slam.data import IdArray, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, hat, so3_exp
from slam.models import FORBID_UNKNOWN

_ITERATIONS = 10
_CONVERGED = 0.05  # largest last change of a predicted point [px]
_DEGREES = 4.0  # of Student's t, the weight of a landmark's residual
_MEDIAN = 2.366  # of χ² with three degrees of freedom
_SURPRISING = 2.0  # deviation of a pair from the posterior, in standard deviations, at which it counts half
_LEAST_NOISE = 0.2  # least noise, as a part of the configured one

_SIGMAS = (1e-4, 1e4)  # [px]
_RANGES = {
    "prior_sigma": _SIGMAS,
    "pixel_sigma": _SIGMAS,
    "disparity_sigma": _SIGMAS,
    "strongest_pair": _SIGMAS,
    "weakest_pair": _SIGMAS,
    "max_radius": (1e-3, 1e3),
    "inflation": (1e-3, 1e3),
}


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """Settings of the self-calibration.

    Attributes:
        enabled: False leaves all measurements as they are.
        prior_probability: probability that there is an offset, before anything is seen; 1 always believes in one.
        prior_sigma: standard deviation of such an offset [px].
        pixel_sigma: noise of a left pixel [px]; only its ratio to `disparity_sigma` matters, the scale is estimated.
        disparity_sigma: noise of a disparity [px].
        max_radius: largest distance from the principal point in focal lengths; further out, what calibration has
            left of the lenses' distortion looks like an offset.
        kept_share: two views are compared once less than this share of the first view's landmarks is still seen.
        minimum_common: least number of landmarks in both views.
        strongest_pair, weakest_pair: standard deviations of the offset from one pair of views [px]: no pair counts for
            more than the first, and a pair that says less than the second is not used.
        inflation: factor on the standard deviation of each pair, for what the model leaves out.
    """

    enabled: bool = True
    prior_probability: float = 0.1
    prior_sigma: float = 0.3
    pixel_sigma: float = 0.5
    disparity_sigma: float = 0.3
    max_radius: float = 0.6
    kept_share: float = 0.5
    minimum_common: int = 20
    strongest_pair: float = 0.1
    weakest_pair: float = 0.35
    inflation: float = 1.25

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_positive(self, _RANGES, "self_calibration")
        if not self.strongest_pair <= self.weakest_pair:
            raise ConfigurationError("self_calibration: strongest_pair <= weakest_pair is required")
        if not 0 < self.kept_share <= 1:
            raise ConfigurationError(f"self_calibration: kept_share must lie in (0, 1], got {self.kept_share}")
        if not 0 < self.prior_probability <= 1:
            raise ConfigurationError(
                f"self_calibration: prior_probability must lie in (0, 1], got {self.prior_probability}"
            )
        if self.minimum_common < 4:
            raise ConfigurationError("self_calibration: minimum_common >= 4 is required (a pose and the offset)")


class SelfCalibration:
    """The disparity offset: its posterior, and the view that waits for a partner.

    The model is ``measured disparity = true disparity + offset`` in rectified pixels. With `prior_probability` the
    offset was drawn once from ``N(0, prior_sigma²)``; else it is zero, and the calibration is as good as it claims.

    Args:
        rig: the cameras.
        config: settings.
    """

    def __init__(self, rig: StereoRig, config: SelfCalibrationConfig) -> None:
        self.rig = rig
        self.config = config
        self._information = config.prior_sigma**-2  # of the offset, given that there is one
        self._mean = 0.0
        self._first: _View | None = None
        self.applied = 0.0  # the offset that features are corrected by [px]

    def apply(self, least: float = 0.0) -> float:
        """Correct features by the offset as it is known now; returns by how much it changes [px].

        Where it would be by less than `least` standard deviations, features are corrected as before.
        """
        change = self.offset - self.applied
        if not self.config.enabled or abs(change) <= least * self.sigma:
            return 0.0
        self.applied = self.offset
        return change

    @property
    def probability(self) -> float:
        """Posterior probability that there is an offset at all."""
        c = self.config
        evidence = 0.5 * self._mean**2 * self._information
        odds = c.prior_probability * np.exp(min(evidence, 100.0)) / (c.prior_sigma * self._information**0.5)
        return float(odds / (odds + 1 - c.prior_probability))

    @property
    def offset(self) -> float:
        """Posterior mean of the offset, with the chance that there is none [px]."""
        return self.probability * self._mean

    @property
    def sigma(self) -> float:
        """Posterior standard deviation of the offset, given that there is one [px]."""
        return float(self._information**-0.5)

    def correct(self, features: StereoFeatures) -> StereoFeatures:
        """Features with right pixels moved along the rectified row, so that disparities lose the applied offset."""
        if not self.config.enabled or self.applied == 0.0:
            return features
        shift = np.array([self.applied, 0.0])
        if self.rig.is_rectified:
            return replace(features, uv_right=features.uv_right + shift)
        rectified_rig = self.rig.rectified
        return replace(
            features, uv_right=rectified_rig.unrectify_right(rectified_rig.rectify_right(features.uv_right) + shift)
        )

    def observe(self, ids: IdArray, uv_left: Array, uv_right: Array) -> None:
        """Learn from one frame.

        Args:
            ids: landmarks recognised in the frame (K,), which agree with one camera pose.
            uv_left: their left pixels (K, 2).
            uv_right: their right pixels (K, 2) as measured, not corrected; NaN where there is none.
        """
        if not self.config.enabled:
            return
        view = _View.of(self.rig, ids, uv_left, uv_right, self.config.max_radius)
        if self._first is None:
            self._first = view
            return
        _, rows, rows_now = np.intersect1d(self._first.ids, view.ids, assume_unique=True, return_indices=True)
        if len(rows) > max(self.config.kept_share * len(self._first.ids), self.config.minimum_common):
            return
        if len(rows) >= self.config.minimum_common:
            self._learn(self._first.points[rows], view.points[rows_now])
        self._first = view

    def _learn(self, first: Array, second: Array) -> None:
        """Bayes' rule with what a pair of views says; the more a pair surprises, the less it counts (Cauchy)."""
        c = self.config
        focal = self.rig.rectified.rig.left.fu
        offset, information = offset_from_pair(first, second, focal, self._mean, c.pixel_sigma, c.disparity_sigma)
        information /= c.inflation**2
        if information < c.weakest_pair**-2:
            return
        information = min(information, c.strongest_pair**-2)
        step = offset - self._mean
        surprise = step / np.sqrt(1 / information + 1 / self._information)
        information /= 1 + (surprise / _SURPRISING) ** 2
        self._information += information
        self._mean += step * information / self._information


@dataclass(frozen=True)
class _View:
    """Landmarks in a frame: ids (K,) and ``(x, y, d)`` (K, 3): rectified pixel from the principal point, disparity."""

    ids: IdArray
    points: Array

    @classmethod
    def of(cls, rig: StereoRig, ids: IdArray, uv_left: Array, uv_right: Array, max_radius: float) -> _View:
        rectified_rig = rig.rectified
        left, right = rectified_rig.rig.left, rectified_rig.rig.right
        a = rectified_rig.rectify_left(uv_left) - [left.u0, left.v0]
        c = rectified_rig.rectify_right(uv_right) - [right.u0, right.v0]
        points = np.column_stack([a, a[:, 0] - c[:, 0]])
        good = np.hypot(a[:, 0], a[:, 1]) <= max_radius * left.fu  # NaN compares false
        good &= np.isfinite(points[:, 2])
        return cls(ids[good], points[good])


def offset_from_pair(
    first: Array, second: Array, focal: float, offset: float, pixel_sigma: float, disparity_sigma: float
) -> tuple[float, float]:
    """The disparity offset from two views of the same still points, whatever the motion between them was.

    Maximum likelihood by Gauss-Newton over the motion, the first view's true points and the offset. Landmarks are
    weighted by Student's t distribution, whose scale is estimated.

    Args:
        first: ``(x, y, d)`` (N, 3) of the landmarks in one view [px], d the measured disparity.
        second: the same landmarks in the other view (N, 3).
        focal: focal length [px].
        offset: first guess [px].
        pixel_sigma: noise of x and y [px].
        disparity_sigma: noise of d [px].

    Returns:
        The offset [px], and its information with all else marginalised out [1/px²]: zero where there is no solution.
    """
    noise = np.diag(np.square([pixel_sigma, pixel_sigma, disparity_sigma]))
    along_d = np.array([0.0, 0.0, 1.0])
    points, R, t = first - offset * along_d, np.eye(3), np.zeros(3)
    for _ in range(_ITERATIONS):
        moved, J_point, J_motion = _move(points, R, t, focal)
        # The second view less its prediction from the first, the points' own corrections carried to first order.
        correction = first - offset * along_d - points
        residual = second - offset * along_d - moved - (J_point @ correction[..., None])[..., 0]
        back = noise @ np.swapaxes(J_point, 1, 2)
        W = np.linalg.inv(noise + J_point @ back)
        J = np.concatenate([J_motion, (along_d - J_point[:, :, 2])[..., None]], axis=2)
        WJ = (W @ J) * _weights(residual, W)[:, None, None]
        normal = np.tensordot(J, WJ, axes=((0, 1), (0, 1)))
        normal += 1e-12 * np.trace(normal) * np.eye(7)
        step = np.linalg.solve(normal, np.tensordot(WJ, residual, axes=((0, 1), (0, 1))))
        if not np.isfinite(step).all():
            break
        change = J @ step
        R, t, offset = so3_exp(step[:3]) @ R, t + step[3:6], offset + float(step[6])
        points = first - offset * along_d + (back @ W @ (residual - change)[..., None])[..., 0]
        if np.abs(change).max() < _CONVERGED:
            return offset, float(1 / np.linalg.inv(normal)[6, 6])
    return offset, 0.0


def _move(points: Array, R: Array, t: Array, focal: float) -> tuple[Array, Array, Array]:
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
    """Weights (N,) of Student's t over the noise's scale, which the median of the squared distances gives."""
    distance = np.einsum("ni,nij,nj->n", residual, W, residual)
    scale = max(float(np.median(distance)) / _MEDIAN, _LEAST_NOISE**2)
    return np.asarray((_DEGREES + 3) / (_DEGREES + distance / scale) / scale)
