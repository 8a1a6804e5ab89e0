"""Factors of the estimation problem, made of plain arrays: shared by the smoother and the batch solver."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np

from backends.smoother import motion
from backends.smoother.landmarks import Known
from backends.smoother.variables import pose_key
from slam.geometry.se3 import Array, hat, nearest_rotation
from slam.models import EstimatorModels
from slam.window.stereo import RectifiedStereo

#: cost: Share of its depth to which a point's depth must be known for its linear triangulation to be good enough.
_WELL_KNOWN = 0.1


def to_pose3(T: Array) -> gtsam.Pose3:
    """A gtsam pose of a nearly rigid matrix (4, 4), made orthonormal: gtsam would not do that."""
    return gtsam.Pose3(gtsam.Rot3(nearest_rotation(T[:3, :3])), T[:3, 3])


def inverse_depth(local: Array) -> tuple[Array, Array]:
    """[x/z, y/z, 1/z] of a point (3,) before a camera, and its derivatives (3, 3)."""
    x, y, z = local
    w = 1 / z
    return np.array([x * w, y * w, w]), w * np.array([[1, 0, -x * w], [0, 1, -y * w], [0, 0, -w]])


def _as_it_is(local: Array) -> tuple[Array, Array]:
    """A point (3,) and its derivatives (3, 3)."""
    return local, np.eye(3)


def _smart_parameters(refined: bool) -> gtsam.SmartProjectionParams:
    """How smart factors triangulate and linearise."""
    parameters = gtsam.SmartProjectionParams()
    # The other mode gives the same information, but throws where a landmark lies behind a camera.
    parameters.setLinearizationMode(gtsam.LinearizationMode.JACOBIAN_SVD)
    parameters.setEnableEPI(refined)
    return parameters


class FactorMaker:
    """Makes factors for one rig and one set of models.

    Args:
        stereo: the rectified rig's projection.
        models: noise, priors and motion.
    """

    def __init__(self, stereo: RectifiedStereo, models: EstimatorModels) -> None:
        self.stereo = stereo
        self.models = models
        self.sigma = models.pixel_sigma * stereo.scale
        self._K = gtsam.Cal3_S2Stereo(stereo.f, stereo.f, 0.0, stereo.u0, stereo.v0, stereo.baseline)
        self._noise = gtsam.noiseModel.Isotropic.Sigma(3, self.sigma)
        self._refined, self._linear = _smart_parameters(True), _smart_parameters(False)
        rectified = stereo.rectified_rig.original.is_rectified
        self._sensor = () if rectified else (to_pose3(stereo.rectified_rig.T_left_rectified),)

    @cached_property
    def _mono(self) -> tuple[gtsam.Cal3_S2, gtsam.noiseModel.Base]:
        s = self.stereo
        return gtsam.Cal3_S2(s.f, s.f, 0.0, s.u0, s.v0), gtsam.noiseModel.Isotropic.Sigma(2, self.sigma)

    def prior(self, key: int) -> gtsam.NonlinearFactor:
        """The first pose."""
        m = self.models
        sigmas = np.repeat([m.initial_rotation_sigma, m.initial_position_sigma], 3)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        return gtsam.PriorFactorPose3(key, to_pose3(m.initial_pose), noise)

    def first_motion(self, keys: tuple[int, int], dt: float) -> gtsam.NonlinearFactor:
        """Between the first two poses: the prior on the velocity."""
        noise = gtsam.noiseModel.Diagonal.Sigmas(dt * motion.first_velocity_sigmas(self.models, dt))
        return gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(), noise)

    def rest(self, keys: tuple[int, int]) -> gtsam.NonlinearFactor:
        """Between two successive poses of a camera that stands."""
        return gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(motion.rest_sigmas()))

    def motion(self, keys: tuple[int, int, int], dt01: float, dt12: float) -> gtsam.NonlinearFactor:
        """Between three successive poses: constant velocity with a random impulse (see `motion`)."""

        def error(_this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Any:
            poses = [values.atPose3(key) for key in keys]
            R = [pose.rotation().matrix() for pose in poses]
            if jacobians is not None:
                for i, J in enumerate(motion.velocity_change_jacobians(R, dt01, dt12)):
                    jacobians[i] = J
            return motion.velocity_change(R, [pose.translation() for pose in poses], dt01, dt12)

        noise = gtsam.noiseModel.Diagonal.Sigmas(motion.motion_sigmas(self.models, dt12))
        return gtsam.CustomFactor(noise, list(keys), error)

    def step(self, keys: tuple[int, int], relative: Array, dt: float) -> gtsam.NonlinearFactor:
        """Between two successive poses: their relative pose (4, 4), with the covariance of the motion model."""
        noise = gtsam.noiseModel.Diagonal.Sigmas(dt * motion.motion_sigmas(self.models, dt))
        return gtsam.BetweenFactorPose3(*keys, to_pose3(relative), noise)

    def point(self, z: list[float]) -> gtsam.StereoPoint2:
        """A measurement (uL, vL, uR); uR may be NaN."""
        return gtsam.StereoPoint2(z[0], z[2], z[1])

    def smart(self, points: Sequence[gtsam.StereoPoint2], keys: Sequence[int]) -> gtsam.NonlinearFactor:
        """A landmark eliminated from its measurements.

        The linear triangulation of a far point alone can be so far off that a step goes astray by metres; so it is
        refined, which takes as long as all the rest.
        """
        parameters = self._refined if self._is_far(points) else self._linear
        factor = gtsam_unstable.SmartStereoProjectionPoseFactor(self._noise, parameters, *self._sensor)
        factor.add(points, keys, self._K)
        return factor

    def _is_far(self, points: Sequence[gtsam.StereoPoint2]) -> bool:
        """Whether a point's measurements tell its depth to less than a tenth; n disparities d to ``σ √2 / (d √n)``."""
        first, last = (point.uL() - point.uR() for point in (points[0], points[-1]))
        known = first > 0 and len(points) * first * last > 2 * (self.sigma / _WELL_KNOWN) ** 2  # not if one is NaN
        return not known

    def known(self, key: int, known: Known) -> gtsam.NonlinearFactor:
        """The prior on a landmark variable, in the world or in a camera's coordinates.

        If a camera has measured it, the prior is on [x/z, y/z, 1/z]: depth from two views is closer to Gaussian in
        inverse depth than in metres.
        """
        if known.frame is None:
            noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
            return gtsam.PriorFactorPoint3(key, known.position, noise)
        coordinates = inverse_depth if known.seen else _as_it_is
        place, D = coordinates(known.position)
        noise = gtsam.noiseModel.Gaussian.Covariance(D @ known.covariance @ D.T)

        def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Any:
            pose, landmark = factor.keys()
            T = values.atPose3(pose).matrix()
            R = T[:3, :3]
            local = R.T @ (values.atPoint3(landmark) - T[:3, 3])
            now, D = coordinates(local)
            if jacobians is not None:
                jacobians[0] = D @ np.concatenate([hat(local), -np.eye(3)], axis=1)
                jacobians[1] = D @ R.T
            return now - place

        return gtsam.CustomFactor(noise, [pose_key(known.frame), key], error)

    def explicit(self, point: gtsam.StereoPoint2, pose: int, landmark: int) -> gtsam.NonlinearFactor:
        """One measurement of a landmark that is a variable."""
        uR = point.uR()
        if uR == uR:  # not NaN; NumPy's own test costs as much as the factor
            return gtsam.GenericStereoFactor3D(point, self._noise, pose, landmark, self._K, *self._sensor)
        K, noise = self._mono
        uv = np.array([point.uL(), point.v()])
        return gtsam.GenericProjectionFactorCal3_S2(uv, noise, pose, landmark, K, *self._sensor)
