"""Stereo measurements as estimators take them.

A measurement is (uL, vL, uR) in pixels of a rectified rig, uR shifted so that both cameras share one u0; uR is NaN
where there is no right pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from slam.chi_square import chi_square_limits
from slam.data import IdArray, IndexArray, Observations
from slam.errors import MeasurementError
from slam.geometry import kernels
from slam.geometry.kernels import predicted_pixels, project_rectified, triangulate_rectified
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

#: Why a back end refuses `slam.interfaces.ConsideringBackend.consider`.
TOO_LATE = "errors of the rig are followed from before the first predict or insert on"

_MOST_CORRELATED = 1 - 1e-9  # numerics: largest correlation of two pixels

#: Derivatives (N, 3, m) of measurements (N, 3) by m errors of the rig: see `slam.interfaces.ConsideringBackend`.
Field = Callable[[Array], Array]


def no_field(z: Array) -> Array:
    """The field of a rig that is exact: no errors."""
    return np.zeros((*z.shape, 0))


@dataclass(frozen=True, eq=False)
class RectifiedStereo:
    """Projection by a rectified rig."""

    rig: StereoRig
    intrinsics: Array  # as `StereoRig.rectified_parameters` (7,), where both cameras have one u0
    f: float  # focal length [px]
    u0: float  # principal point [px]
    v0: float
    baseline: float  # [m]
    doffs: float  # u0 of the right camera less that of the left [px]

    @classmethod
    def of(cls, rig: StereoRig) -> RectifiedStereo:
        """For a rectified rig.

        Raises:
            CalibrationError: the rig is not rectified.
        """
        f, _, u0, v0, _, right_u0, shift = rig.rectified_parameters.tolist()
        return cls(rig, np.array([f, f, u0, v0, f, u0, shift]), f, u0, v0, -shift, right_u0 - u0)

    def measure(self, observations: Observations) -> Array:
        """Measurements (M, 3) = (uL, vL, uR) of observations."""
        z = np.empty((len(observations), 3))
        z[:, :2], z[:, 2] = observations.uv_left, observations.uv_right[:, 0] - self.doffs
        return z

    @staticmethod
    def corrected(owner: str, z: Array, correct: Callable[[Array], Array]) -> Array:
        """Measurements (M, 3) as they are corrected by a back end of this name; a missing right pixel stays NaN.

        Raises:
            MeasurementError: a corrected one is not finite.
        """
        out = np.asarray(correct(z.copy()), float)
        if out.shape != z.shape or not (np.isfinite(out) == np.isfinite(z)).all():
            raise MeasurementError(f"{owner}: a corrected measurement is not finite")
        return out

    def project(self, local: Array) -> tuple[Array, Array]:
        """Measurements (N, 3) and Jacobians (N, 3, 3) of points (N, 3) in the left camera's coordinates.

        Points that are not in front of the camera give NaN measurements and zero Jacobians.
        """
        z, J = project_rectified(self.intrinsics, np.ascontiguousarray(local), True)
        J[np.isnan(z[:, 0])] = 0
        return z, J

    def triangulate(self, z: Array) -> Array:
        """Points (N, 3) in the left camera's coordinates; NaN where the disparity is not positive or missing."""
        left, right = np.ascontiguousarray(z[:, :2]), np.ascontiguousarray(z[:, 2:])
        return np.asarray(triangulate_rectified(self.intrinsics, left, right))


@dataclass(frozen=True, eq=False)
class RectifiedMeasurement:
    """How an estimator measures with a rig: what all of them need beside their state."""

    rig: StereoRig
    models: EstimatorModels
    field: Field = field(default=no_field, kw_only=True)

    @cached_property
    def stereo(self) -> RectifiedStereo:
        """Projection by the rig."""
        return RectifiedStereo.of(self.rig)

    def first_sight(self, ids: IdArray, z: Array, farthest: float = np.inf) -> tuple[Array, Array, Array]:
        """New landmarks in the left camera's coordinates (M, 3) [m], with covariances (M, 3, 3) (paper A, Eqs. 8, 10).

        And their derivatives (M, 3, m) by errors of the rig.

        Args:
            ids: of the landmarks (M,), for the message.
            z: measurements (M, 3), see `RectifiedStereo.measure`.
            farthest: depth [m] at which those beyond it are put.

        Raises:
            MeasurementError: one has no right pixel or no positive depth.
        """
        local = self.stereo.triangulate(z)
        bad = ~np.isfinite(local).all(axis=1)
        if bad.any():
            raise MeasurementError(f"landmark {ids[bad][0]} has no right pixel or no positive depth")
        local = local * np.minimum(1.0, farthest / np.maximum(local[:, 2:], 1e-300))
        back = np.linalg.inv(self.stereo.project(local)[1])
        return local, self.models.pixel_sigma**2 * back @ np.swapaxes(back, 1, 2), back @ self.field(z)

    def limits(self, z: Array) -> Array:
        """Limits (M,) of the gate on squared distances of residuals or measurements (M, 3), NaN where not measured."""
        return chi_square_limits(np.isfinite(z).sum(axis=1), self.models.gate_probability)

    def visible(self, T: Array, points: Array) -> IndexArray:
        """Which points (N, 3) in the world are in the angle of view from a pose T (4, 4) (paper A, Fig. 3)."""
        return np.flatnonzero(self.rig.left.in_view((points - T[:3, 3]) @ T[:3, :3]))

    def pixels(self, local: Array, covariances: Array) -> tuple[Array, Array, Array]:
        """Left and right pixels (M, 2) of points (M, 3) in the camera, and innovation covariances (M, 2, 2) [px²].

        The covariances (M, 3, 3) [m²] are of the points as seen from the camera.
        """
        camera = self.rig.rectified_parameters
        return predicted_pixels(camera, local, covariances, self.models.pixel_sigma, _MOST_CORRELATED)


def relative_covariance(P: Array, earlier: Array, later: Array, at: int = 0) -> Array:
    """Covariance (6, 6) of a pose where another one is known, from a joint covariance (n, n).

    Args:
        P: of poses, perturbed on the right; the last is the other.
        earlier: the pose that is known (4, 4).
        later: the other (4, 4).
        at: where the one that is known begins in P.
    """
    P = np.ascontiguousarray(P)
    return np.asarray(kernels.relative_covariance(P, at, len(P) - 6, earlier, later))
