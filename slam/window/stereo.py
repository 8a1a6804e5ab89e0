"""Stereo measurements in the rectified rig, in which estimators work.

A measurement is (uL, vL, uR) in rectified pixels, uR shifted so that both cameras share one u0; uR is NaN where there
is no right pixel. The body frame is the rig's own left camera, the sensor its rectified rig.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.data import Observations
from slam.geometry.rig import RectifiedRig, StereoRig
from slam.geometry.rig_kernels import project_rectified, triangulate_rectified
from slam.geometry.se3 import Array
from slam.models import EstimatorModels


@dataclass(frozen=True, eq=False)
class RectifiedStereo:
    """Projection by a rectified rig, and the way from the original rig's pixels to its.

    Attributes:
        rectified_rig: the rectified rig.
        f, u0, v0, baseline: of the rectified rig [px], [m].
        doffs: u0 of the right camera less that of the left [px].
        scale: rectified pixels per original pixel, on average over the image.
    """

    rectified_rig: RectifiedRig
    f: float
    u0: float
    v0: float
    baseline: float
    doffs: float
    scale: float

    @cached_property
    def intrinsics(self) -> Array:
        """Of the rectified rig (7,), as `StereoRig.rectified_parameters`, where both cameras have one u0."""
        return np.array([self.f, self.f, self.u0, self.v0, self.f, self.u0, -self.baseline])

    @cached_property
    def R_left(self) -> Array:
        """Rotation (3, 3) from left-camera to rectified axes."""
        return np.ascontiguousarray(self.rectified_rig.R_left)

    @classmethod
    def of(cls, rig: StereoRig) -> RectifiedStereo:
        """For a rig as calibrated."""
        rectified_rig = rig.rectified
        left, right = rectified_rig.rig.left, rectified_rig.rig.right
        return cls(
            rectified_rig,
            left.fu,
            left.u0,
            left.v0,
            rectified_rig.rig.baseline,
            right.u0 - left.u0,
            rectified_rig.scale,
        )

    def measure(self, observations: Observations) -> Array:
        """Measurements (M, 3) = (uL, vL, uR) of observations in the rig's own pixels."""
        z = np.empty((len(observations), 3))
        if self.rectified_rig.original.is_rectified:
            z[:, :2], z[:, 2] = observations.uv_left, observations.uv_right[:, 0]
        else:
            z[:, :2] = self.rectified_rig.rectify_left(observations.uv_left)
            z[:, 2] = self.rectified_rig.rectify_right(observations.uv_right)[:, 0]
        z[:, 2] -= self.doffs
        return z

    def project(self, local: Array) -> tuple[Array, Array]:
        """Measurements (N, 3) and Jacobians (N, 3, 3) of points (N, 3) in the left camera's coordinates.

        Points that are not in front of the camera give NaN measurements and zero Jacobians.
        """
        R = self.rectified_rig.R_left
        z, J = project_rectified(self.intrinsics, local @ R.T, True)
        J[np.isnan(z[:, 0])] = 0
        return z, J if self.rectified_rig.original.is_rectified else J @ R

    def triangulate(self, z: Array) -> Array:
        """Points (N, 3) in the left camera's coordinates; NaN where the disparity is not positive or missing."""
        points = triangulate_rectified(self.intrinsics, np.ascontiguousarray(z[:, :2]), np.ascontiguousarray(z[:, 2:]))
        return np.asarray(points @ self.rectified_rig.R_left)


@dataclass(frozen=True, eq=False)
class RectifiedMeasurement:
    """How an estimator measures: the rectified rig, and the noise of its pixels.

    Attributes:
        rig: the cameras.
        models: noise, priors, motion and gate.
    """

    rig: StereoRig
    models: EstimatorModels

    @cached_property
    def stereo(self) -> RectifiedStereo:
        """The rectified rig that measures."""
        return RectifiedStereo.of(self.rig)

    @cached_property
    def sigma(self) -> float:
        """Noise of rectified pixels [px]."""
        return self.models.pixel_sigma * self.stereo.scale
