"""Factors, and an update of a graph with them: shared by the smoother and the batch solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from gtsam.symbol_shorthand import L, X

from backends.smoother.kernels import motion_error
from backends.smoother.state import SmootherState
from slam.geometry.se3 import Array, inverse, nearest_rotation, transform
from slam.models import EstimatorModels
from slam.window.motion import STANDS, is_first, velocity_sigmas
from slam.window.stereo import RectifiedStereo

SmartFactor = gtsam_unstable.SmartStereoProjectionPoseFactor
_FAR = 5 * 2**0.5  # probability: sigmas of a pixel; noise changes a disparity by more once in a million times
_LOOSE = np.diag(np.repeat([9.0, 1e4], 3))  # numerics: variances [rad²], [m²] of a motion that is unknown


def to_pose3(T: Array) -> gtsam.Pose3:
    """A gtsam pose of a nearly rigid matrix (4, 4), made orthonormal: gtsam would not do that."""
    return gtsam.Pose3(gtsam.Rot3(nearest_rotation(T[:3, :3])), T[:3, 3])


class FactorMaker:
    """Makes factors for one rig and one set of models: of poses X(number) and landmarks L(serial number).

    Attributes:
        far: disparity [px] below which a measurement tells hardly that its landmark is in front of the camera.
    """

    def __init__(self, stereo: RectifiedStereo, models: EstimatorModels) -> None:
        self.stereo, self.models, self.far = stereo, models, _FAR * models.pixel_sigma
        self._K = gtsam.Cal3_S2Stereo(stereo.f, stereo.f, 0.0, stereo.u0, stereo.v0, stereo.baseline)
        self._noise = gtsam.noiseModel.Isotropic.Sigma(3, models.pixel_sigma)
        self._K_left = gtsam.Cal3_S2(stereo.f, stereo.f, 0.0, stereo.u0, stereo.v0)
        self._noise_left = gtsam.noiseModel.Isotropic.Sigma(2, models.pixel_sigma)
        self._smart = gtsam.SmartProjectionParams()
        self._smart.setDegeneracyMode(gtsam.DegeneracyMode.ZERO_ON_DEGENERACY)

    def prior(self, pose: int, T: Array, covariance: Array) -> gtsam.NonlinearFactor:
        """A pose is T (4, 4) with a covariance (6, 6)."""
        return gtsam.PriorFactorPose3(X(pose), to_pose3(T), gtsam.noiseModel.Gaussian.Covariance(covariance))

    def between(self, earlier: int, later: int, relative: Array, covariance: Array) -> gtsam.NonlinearFactor:
        """A pose relative to an earlier one (4, 4), with a covariance (6, 6)."""
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        return gtsam.BetweenFactorPose3(X(earlier), X(later), to_pose3(relative), noise)

    def motion(self, keys: Sequence[int], dt: Array) -> gtsam.NonlinearFactor:
        """The velocity between the last two poses is that before but for noise: the papers' motion on poses alone.

        The papers' velocity jumps when an interval begins and then stays: it is the difference of two poses, and a
        variable for it would only repeat it. gtsam linearises this factor where it linearises the rest: at other poses
        it would pull at the path as a whole, which nothing else holds. `keys` are three successive poses with the times
        `dt` (2,) [s] between them; or two of which the first velocity is unknown, and then the first time does not
        count.
        """
        n, before, last = len(keys), float(dt[0]), float(dt[1])

        def error(_factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Any:
            r, J = motion_error(np.array([values.atPose3(key).matrix() for key in keys]), before, last)
            if jacobians is not None:
                for i in range(n):
                    jacobians[i] = J[:, 6 * (i + 3 - n) : 6 * (i + 4 - n)]
            return r

        sigmas = velocity_sigmas(self.models, last, n == 2)
        return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), keys, error)

    def point(self, z: Sequence[float]) -> gtsam.StereoPoint2:
        """A measurement (uL, vL, uR); uR may be NaN."""
        return gtsam.StereoPoint2(z[0], z[2], z[1])

    def smart(self, points: Sequence[gtsam.StereoPoint2], keys: Sequence[int]) -> SmartFactor:
        """A landmark eliminated from its measurements, of which two or more are needed and one with a right pixel.

        It tells nothing, and is not valid, where the measurements put it behind a camera.
        """
        factor = SmartFactor(self._noise, self._smart)
        factor.add(points, keys, self._K)
        return factor

    def explicit(self, point: gtsam.StereoPoint2, pose: int, landmark: int) -> gtsam.NonlinearFactor:
        """One measurement of a landmark that is a variable."""
        keys, uR = (X(pose), L(landmark)), point.uR()
        if uR == uR:  # not NaN; NumPy's own test costs as much as the factor
            return gtsam.GenericStereoFactor3D(point, self._noise, *keys, self._K)
        uv = np.array([point.uL(), point.v()])
        return gtsam.GenericProjectionFactorCal3_S2(uv, self._noise_left, *keys, self._K_left)

    def known(self, landmark: int, position: Array, covariance: Array) -> gtsam.NonlinearFactor:
        """A landmark variable is at a position (3,) in the world, with a covariance (3, 3)."""
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        return gtsam.PriorFactorPoint3(L(landmark), position, noise)

    def known_from(self, pose: int, landmark: int, local: Array, covariance: Array) -> gtsam.NonlinearFactor:
        """A landmark variable is at `local` (3,) in the camera's coordinates, with a covariance (3, 3).

        gtsam's factor takes it as a direction and a distance.
        """
        distance = float(np.linalg.norm(local))
        direction = gtsam.Unit3(local / distance)
        D = np.concatenate([direction.basis().T, direction.point3()[None] * distance]) / distance
        noise = gtsam.noiseModel.Gaussian.Covariance(D @ covariance @ D.T)
        return gtsam.BearingRangeFactor3D(X(pose), L(landmark), direction, distance, noise)


@dataclass
class GraphUpdate:
    """What a graph is given: the arguments of gtsam's `update`."""

    make: FactorMaker
    to_graph: Array = field(default_factory=lambda: np.eye(4))  # takes the state's coordinates to gtsam's
    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    timestamps: dict[Any, float] = field(default_factory=dict)  # of variables, for the fixed lag: `SmootherState.ticks`
    removed: list[int] = field(default_factory=list)  # slots of factors that others replace

    def add_pose(self, s: SmootherState, number: int, oldest: int) -> None:
        """A pose, and its motion since the one before it, if it is not the `oldest` in the graph."""
        if number > oldest:
            self.factors.add(self._motion(s, number, oldest))
        self.values.insert(X(number), to_pose3(self.to_graph @ s.poses[s.of(number)]))
        self.timestamps[X(number)] = float(s.ticks[s.of(number)])

    def _motion(self, s: SmootherState, number: int, oldest: int) -> gtsam.NonlinearFactor:
        """What the motion model says of a pose: its velocity is that between the two poses before, but for noise.

        Where the graph has but one of these two, the pose is hardly held where it is.
        """
        row, (dt, before) = s.of(number), s.intervals(number)
        if s.rests[row]:
            return self.make.between(number - 1, number, np.eye(4), STANDS**2 * np.eye(6))
        if not is_first(before, dt) and number - 2 < oldest:
            return self.make.between(number - 1, number, inverse(s.poses[row - 1]) @ s.poses[row], _LOOSE)
        count = 2 if is_first(before, dt) else 3
        return self.make.motion([X(i) for i in range(number + 1 - count, number + 1)], np.array([before or np.nan, dt]))

    def add_known(self, s: SmootherState, serial: int) -> None:
        """A landmark of which something is known beforehand, as a variable."""
        known = s.known[serial]
        if known.pose < 0:
            self.factors.add(self.make.known(serial, known.position, known.covariance))
            place = known.position
        else:
            self.factors.add(self.make.known_from(known.pose, serial, known.position, known.covariance))
            place = transform(self.to_graph @ s.poses[s.of(known.pose)], known.position[None])[0]
        self.values.insert(L(serial), place)
