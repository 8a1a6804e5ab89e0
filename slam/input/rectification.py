"""Rectification at the door: behind it there are the pixels and axes of the rectified pair alone, and no lens.

Features are taken to the rectified pair as they come in; poses and features of a result are taken back as they go out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Estimate, FrameResult, Observations, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend
from slam.models import EstimatorModels


class Rectification:
    """The ways between a rig and its rectified pair. Where the rig is rectified, everything passes unchanged.

    Args:
        rig: the cameras.

    Attributes:
        rig: the rectified pair.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._ways, self._none = rig.rectified, rig.is_rectified
        self.rig = self._ways.rig
        self._back = inverse(self._ways.T_left_rectified)
        self._adjoint = adjoint(self._ways.T_left_rectified)

    def require_fits(self, backend: Backend) -> None:
        """Raise ConfigurationError if a back end was made for cameras with lenses or turned axes."""
        rig = getattr(backend, "rig", None)
        if isinstance(rig, StereoRig) and not rig.is_rectified:
            raise ConfigurationError("the back end works behind rectification: make it with rig.rectified.rig")

    def models(self, models: EstimatorModels) -> EstimatorModels:
        """Models for the rectified pair: noise and drift of its pixels, and the first pose of its left camera."""
        if self._none:
            return models
        T, scale = models.initial_pose @ self._ways.T_left_rectified, self._ways.scale
        objects = replace(models.objects, drift=models.objects.drift * scale)
        return replace(models, pixel_sigma=models.pixel_sigma * scale, T_world_left=T.tolist(), objects=objects)

    def features_in(self, features: StereoFeatures) -> StereoFeatures:
        """Features in pixels of the rectified pair; those outside of its left image are left out."""
        if self._none or features.rectified:
            return features
        left = self._ways.rectify_left(features.uv_left)
        moved = replace(features, uv_left=left, uv_right=self._right(features.uv_right))
        inside = self.rig.left.in_image(left)
        return moved if inside.all() else moved.select(np.flatnonzero(inside))

    def observations_in(self, seen: Observations) -> Observations:
        """Observations in pixels of the rectified pair."""
        if self._none:
            return seen
        return Observations(seen.ids, self._ways.rectify_left(seen.uv_left), self._right(seen.uv_right))

    def _right(self, uv: Array) -> Array:
        """Right pixels (N, 2); none where they come to lie farther outside the image than that is large.

        A fisheye sees rays across its axis, whose pixels in the rectified pair lie at infinity.
        """
        right, size = self._ways.rectify_right(uv), np.array([self.rig.width, self.rig.height])
        far = (np.abs(right - 0.5 * size) > 1.5 * size).any(axis=1, keepdims=True)  # NaN compares false
        return np.where(far, np.nan, right)

    def result_out(self, result: FrameResult) -> FrameResult:
        """A result in pixels and axes of the rig's own left camera."""
        if self._none:
            return result
        f, common = result.features, result.common
        left, right = self._ways.unrectify_left(f.uv_left), self._ways.unrectify_right(f.uv_right)
        return replace(
            result,
            estimate=self.estimate_out(result.estimate),
            features=replace(f, uv_left=left, uv_right=right, rectified=False),
            common=replace(common, jacobian=self._adjoint @ common.jacobian),
        )

    def estimate_out(self, estimate: Estimate) -> Estimate:
        """An estimate with the pose of the rig's own left camera."""
        if self._none:
            return estimate
        P = self._adjoint @ estimate.covariance @ self._adjoint.T
        return replace(estimate, T_world_left=estimate.T_world_left @ self._back, covariance=P)

    def path_out(self, path: Trajectory) -> Trajectory:
        """A path of the rig's own left camera."""
        return path if self._none else Trajectory(path.stamps, path.poses @ self._back)
