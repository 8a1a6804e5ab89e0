"""The maximum-likelihood estimate from all measurements, by Levenberg-Marquardt: the reference for back ends.

Every landmark is a variable and every accepted measurement a factor of its own; nothing is approximated but the motion
model: between two poses it counts as the prediction that it gave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from backends.smoother import SmootherBackend
from backends.smoother.factors import landmark_key, pose_key
from backends.smoother.graph import FAILURES, Problem, Tracks, minimised
from slam.bounds import require_not_negative
from slam.data import Estimate, IdArray, Observations, Prediction, UpdateReport
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.options import from_options
from slam.runtime.blas import one_blas_thread

_ITERATIONS = 100  # numerics: of Levenberg-Marquardt at most


@dataclass(frozen=True)
class BatchConfig:
    """Options of `BatchBackend`.

    Attributes:
        online: whether the pose alone is the solved one as well, and not the smoother's.

    Raises:
        ConfigurationError: it is neither true nor false.
    """

    online: bool = False

    def __post_init__(self) -> None:
        require_not_negative(self, {}, "batch")


class BatchBackend:
    """Levenberg-Marquardt over all poses and landmarks.

    `estimate` and `trajectory` raise `SlamError` where gtsam cannot solve the problem.

    A smoother runs along, of whose graph every measured frame is a pose: it predicts, gates and gives the first values.
    The problem is solved when the trajectory or the landmarks are asked for; with ``online=True`` whenever the pose is,
    which costs more with every frame.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        options: see `BatchConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(BatchConfig, "batch", options)
        self._smoother = SmootherBackend(rig, models, motion=0.0, lag=None)
        self._solution: _Solution | None = None

    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`: the smoother's."""
        return self._smoother.predict(stamp)

    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`: the smoother's."""
        self._solution = None
        return self._smoother.update(observations, guess)

    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._smoother.add(observations)
        self._solution = None

    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        self._smoother.insert(ids, positions, covariances)
        self._solution = None

    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        self._smoother.place(ids, local, covariances)
        self._solution = None

    @one_blas_thread
    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`."""
        self._smoother.revise(correct)
        self._solution = None

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`. What a landmark has told about the poses stays known."""
        self._smoother.remove(ids)

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        rough = self._smoother.estimate(landmarks)
        if not (landmarks or self.config.online):
            return rough
        solution, s = self._solved(), self._smoother.state
        positions, covariances = rough.positions.copy(), rough.covariances.copy()
        serials = s.landmarks.serial[s.landmarks.rows_of(rough.ids)]
        for row, serial in enumerate(serials.tolist()):
            if serial in solution.landmarks:
                positions[row] = solution.values.atPoint3(landmark_key(serial))
                covariances[row] = solution.covariance(landmark_key(serial), covariances[row])
            elif serial in solution.once:  # it moves with the pose that measured it
                positions[row] = transform(solution.once[serial], positions[row : row + 1])[0]
        T, P = rough.T_world_left, rough.covariance
        if s.inside:  # else it is predicted only: its measurements are still to come
            T, P = solution.poses[-1].copy(), solution.covariance(pose_key(s.number), P)
        return Estimate(rough.stamp, T, P, rough.ids, positions, covariances)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`: the smoother's."""
        return self._smoother.positions(ids)

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`."""
        s = self._smoother.state
        if not s.started:
            return self._smoother.trajectory()
        found = self._smoother.path.trajectory(s, self._solved().poses)
        if not s.inside:
            found.poses[-1] = s.last[1]
        return found

    def _solved(self) -> _Solution:
        """The solution; a frame that is only predicted changes nothing of it."""
        sights = self._smoother.state.sights
        if self._solution is None or self._solution.sights is not sights:
            self._solution = _Solution(self._smoother)
        return self._solution


class _Solution:
    """A solved problem.

    Attributes:
        sights: what it is the solution for.
        values: all variables.
        poses: of the graph (N, 4, 4); those before a restart of the smoother are its own.
        landmarks: serial numbers of the landmarks that are variables.
        once: how those that are none, but were measured, move with their pose (4, 4), by serial number.
    """

    def __init__(self, smoother: SmootherBackend) -> None:
        s, make = smoother.state, smoother.factor_maker
        self.sights = s.sights
        problem, tracks = Problem(), Tracks(make, 2, None)
        numbers = range(s.begun, s.number + 1)
        for number in numbers:
            tracks.add_pose(problem, s, number, s.begun)
        count = np.zeros(s.serials, np.int64)
        stereo = smoother.stereo
        nearest: dict[int, tuple[float, Array]] = {}  # largest disparity, and where that puts the landmark
        for number in numbers:
            sight, T = s.sights[s.of(number)], s.poses[s.of(number)]
            count[sight.serials] += 1
            disparity = np.nan_to_num(sight.z[:, 0] - sight.z[:, 2], nan=-1.0)
            places = transform(T, stereo.triangulate(sight.z))
            for serial, d, place in zip(sight.serials.tolist(), disparity.tolist(), places):
                if d > nearest.get(serial, (0.0, place))[0]:
                    nearest[serial] = d, place
        known = {serial: one for serial, one in s.known.items() if one.pose < 0 or one.pose >= s.begun}
        self.landmarks = {
            serial for serial in np.flatnonzero(count).tolist() if count[serial] > 1 and serial in nearest
        }
        self.landmarks |= {serial for serial in known if count[serial]}
        for serial in sorted(self.landmarks):
            if serial in known:
                tracks.add_known(problem, s, serial)
            else:
                problem.values.insert(landmark_key(serial), nearest[serial][1])
        for number in numbers:
            sight = s.sights[s.of(number)]
            for serial, z in zip(sight.serials.tolist(), sight.z.tolist()):
                if serial in self.landmarks:
                    problem.factors.add(make.explicit(make.point(z), number, serial))
        self._factors = problem.factors
        self.values = minimised(problem, _ITERATIONS)
        solved = np.array([self.values.atPose3(pose_key(i)).matrix() for i in numbers])
        self.poses = np.concatenate([s.poses[: s.of(s.begun)], solved])
        moved = solved @ inverse(s.poses[s.of(s.begun) :])
        self.once = {
            serial: moved[number - s.begun]
            for number in numbers
            for serial in s.sights[s.of(number)].serials.tolist()
            if serial not in self.landmarks
        }

    @cached_property
    def _marginals(self) -> gtsam.Marginals | None:
        try:
            return gtsam.Marginals(self._factors, self.values)
        except FAILURES:
            return None

    def covariance(self, key: int, otherwise: Array) -> Array:
        """Marginal covariance of a variable; `otherwise` where the problem leaves one open."""
        if self._marginals is None:
            return otherwise
        try:
            return np.asarray(self._marginals.marginalCovariance(key))
        except FAILURES:
            return otherwise
