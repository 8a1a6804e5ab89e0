"""Keyframes: features in camera coordinates and the motion since the keyframe before; loops between keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import Correction, IdArray
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, log

_ROUNDING = 1e-14  # numerics: variances below this share of the largest are rounding


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that is kept."""

    frame: int  # index of the step
    stamp: float  # [s]
    T_odom_left: Array  # pose (4, 4) that the back end estimated then
    covariance: Array  # of that pose (6, 6), without the common errors
    # covariance (6, 6) by noise of the motion since the keyframe before, perturbing this pose on the right
    step_covariance: Array
    # derivative (6, m) of the pose by the errors that all poses share, see `slam.data.CommonError`
    jacobian: Array
    travelled: float  # length of the path up to here [m]
    depth: float  # median depth of the features [m]
    points: NDArray[np.float32]  # features in coordinates of the rectified left camera (F, 3) [m]
    descriptors: NDArray[np.float16]  # (F, D)
    laplacian: NDArray[np.int8]  # signs of the Laplacian (F,)
    landmarks: IdArray  # ids of the landmarks that the features showed (F,), −1 for none
    # of the rig's error, with which the points were triangulated; None in a map of an earlier run
    correction: Correction | None = None

    def __len__(self) -> int:
        return len(self.points)

    def corrected(self, correction: Correction | None, rig: StereoRig) -> Keyframe:
        """The same keyframe, its points triangulated again with the present correction of the rectified rig's error."""
        if self.correction is None or correction is None or self.correction is correction:
            return self
        pixels, _ = rig.project_stereo(self.points.astype(float), jacobian=False)
        pixels = correction.rows(self.correction.undone(pixels))
        points = rig.triangulate(pixels[:, :2], pixels[:, [2, 1]])
        points = np.where(np.isfinite(points).all(axis=1, keepdims=True), points, self.points).astype(np.float32)
        return replace(self, points=points, correction=correction)


@dataclass(frozen=True, eq=False)
class Loop:
    """Two keyframes that show the same place."""

    first: int  # their numbers, the older one first
    second: int
    T_first_second: Array  # the second one's pose in the first one's coordinates (4, 4)
    covariance: Array  # its covariance (6, 6), perturbing on the right
    inliers: int  # number of features that agree

    @property
    def pair(self) -> tuple[int, int]:
        """Numbers of both keyframes."""
        return self.first, self.second


def distance(expected: Array, found: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of two poses (4, 4)."""
    xi = log(inverse(expected) @ found)
    return float(xi @ np.linalg.solve(covariance, xi))


def step_covariance(before: Keyframe, T_odom_left: Array, covariance: Array) -> Array:
    """Covariance (6, 6) by noise of the motion since a keyframe, from the covariances of both poses.

    The motion's error is taken to be independent of the first pose's: then ``P = Ad P₀ Adᵀ + Q`` with the adjoint of
    the motion's inverse, and Q is the motion's covariance. If the back end has become more certain meanwhile, because
    it saw earlier landmarks again, Q has no positive part and is set to zero.

    A pose's error has two parts: the path's drift, and an error of its own frame, which the next frame forgets. Q
    holds the drift alone, so that Q of successive steps can be added; loops carry the error of the frames they end at.
    """
    back = adjoint(inverse(T_odom_left) @ before.T_odom_left)
    return covariance_growth(covariance, back @ before.covariance @ back.T)


def covariance_growth(after: Array, before: Array) -> Array:
    """The positive semidefinite part (…, n, n) of the difference `after` − `before` of covariances (…, n, n).

    Rotations and translations are made comparable by dividing by the standard deviations of `after`.
    """
    variances = np.diagonal(after, axis1=-2, axis2=-1)
    least = np.maximum(_ROUNDING * variances.max(axis=-1, keepdims=True), np.finfo(float).tiny)
    deviations = np.sqrt(np.maximum(variances, least))[..., :, None]
    values, vectors = np.linalg.eigh((after - before) / (deviations * np.swapaxes(deviations, -1, -2)))
    root = deviations * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return np.asarray(root @ np.swapaxes(root, -1, -2))
