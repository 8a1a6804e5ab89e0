"""The maximum-likelihood estimate from all measurements, by Levenberg-Marquardt: the reference for back ends.

Every frame is a variable, every landmark that its measurements determine, and every measurement of one that the
smoother accepted a factor of its own; the motion model ties three successive frames. Left out are landmarks that were
seen once, with a disparity below a pixel, and what was before the problem began anew.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from backends.smoother import SmootherBackend
from backends.smoother.factors import FactorMaker, landmark_key, pose_key, to_pose3
from backends.smoother.graph import SolverError, minimised, solving
from backends.smoother.state import SmootherState
from backends.smoother.tracks import GraphProblem, Tracks
from slam.data import Estimate
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.motion import LONGEST, is_first
from slam.window.stereo import RectifiedStereo

_ITERATIONS = 100  # numerics: of Levenberg-Marquardt at most
_DISTINCT = 1.0  # numerics: disparity [px] from which on one sight alone determines a landmark well enough for Cholesky


class BatchBackend:
    """Levenberg-Marquardt over all poses and landmarks.

    `estimate` and `trajectory` raise `SlamError` where gtsam cannot solve the problem.

    A smoother runs along: it predicts, gates and gives the first values.
    All but `estimate` and `trajectory` are its own methods (`SmootherBackend`). The problem is solved when the path or
    the landmarks are asked for; the pose alone is the smoother's. Where gtsam cannot give covariances for the solution,
    they are the smoother's, too, and a warning is logged.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        options: there are none.

    Raises:
        ConfigurationError: an option is given.
    """

    revises_path = True

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        if options:
            raise ConfigurationError(f"batch: unknown option {min(options)!r}; there are none")
        self.rig = rig
        self.models = models
        along = self._smoother = SmootherBackend(rig, models, lag=None)
        self.predict, self.update, self.add, self.remove = along.predict, along.update, along.add, along.remove
        self.positions, self.insert, self.place = along.positions, along.insert, along.place
        self.consider, self.sensitivities, self.revise = along.consider, along.sensitivities, along.revise
        self._solution: _BatchSolution | None = None

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        rough = self._smoother.estimate(landmarks)
        if not landmarks:
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
        T, P = solution.poses[-1].copy(), solution.covariance(solution.newest, rough.covariance)
        return Estimate(rough.stamp, T, P, rough.ids, positions, covariances)

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`."""
        s = self._smoother.state
        if not s.started:
            return self._smoother.trajectory()
        found, solved = self._smoother.path.trajectory(), self._solved().poses
        found.poses[-len(solved) :] = solved
        return found

    def _solved(self) -> _BatchSolution:
        """The solution for what is known now."""
        if self._solution is None or self._solution.state is not self._smoother.state:
            self._solution = _BatchSolution(self._smoother)
        return self._solution


class _BatchSolution:
    """A solved problem."""

    def __init__(self, smoother: SmootherBackend) -> None:
        s, make = smoother.state, smoother.factor_maker
        self.state = s  # what it is the solution for
        numbers, begin = range(s.begun, s.number + 1), s.of(s.begun)
        keys = [pose_key(number) for number in numbers]
        problem, tracks = GraphProblem(), Tracks(make, None)
        problem.factors.add(make.prior(s.begun, s.start, s.prior))
        for key, T in zip(keys, s.poses[begin:]):
            problem.values.insert(key, to_pose3(T))
        for factor in _motions(keys, np.diff(s.stamps[begin:]).clip(max=LONGEST), make):
            problem.factors.add(factor)
        places = _places(s, make.stereo, numbers)
        known = {serial for serial, one in s.known.items() if one.pose < 0 or one.pose >= s.begun}
        self.landmarks = known.union(places)  # serial numbers of those that are variables
        for serial in sorted(self.landmarks):
            if serial in known:
                tracks.add_known(problem, s, serial)
            else:
                problem.values.insert(landmark_key(serial), places[serial])
        for number in numbers:
            sight = s.sights[s.of(number)]
            for serial, z in zip(sight.serials.tolist(), sight.z.tolist()):
                if serial in self.landmarks:
                    problem.factors.add(make.explicit(make.point(z), number, serial))
        self._factors, self.newest = problem.factors, keys[-1]
        self.values = minimised(problem, _ITERATIONS)
        self.poses = np.array([self.values.atPose3(key).matrix() for key in keys])  # (F, 4, 4) from its beginning on
        self.once = self._moved(numbers)

    def _moved(self, numbers: range) -> dict[int, Array]:
        """How measured landmarks that are no variables move with their pose (4, 4), by serial number."""
        s = self.state
        solved = np.array([self.values.atPose3(pose_key(i)).matrix() for i in numbers])
        moved = solved @ inverse(s.poses[s.of(s.begun) :])
        return {
            serial: moved[number - s.begun]
            for number in numbers
            for serial in s.sights[s.of(number)].serials.tolist()
            if serial not in self.landmarks
        }

    @cached_property
    def _marginals(self) -> gtsam.Marginals | None:
        try:
            with solving():
                return gtsam.Marginals(self._factors, self.values)
        except SolverError as error:
            logging.getLogger(__name__).warning("batch: covariances are the smoother's, gtsam gives none: %s", error)
            return None

    def covariance(self, key: int, otherwise: Array) -> Array:
        """Marginal covariance of a variable; `otherwise` where the problem leaves one open."""
        if self._marginals is None:
            return otherwise
        try:
            with solving():
                return np.asarray(self._marginals.marginalCovariance(key))
        except SolverError:
            return otherwise


def _places(s: SmootherState, stereo: RectifiedStereo, numbers: range) -> dict[int, Array]:
    """Where landmarks (3,) begin that measurements determine, by serial number: where their nearest sight puts them."""
    count = np.zeros(s.serials, np.int64)
    nearest: dict[int, tuple[float, Array]] = {}  # largest disparity, and where that puts the landmark
    for number in numbers:
        sight, T = s.sights[s.of(number)], s.poses[s.of(number)]
        count[sight.serials] += 1
        disparity = np.nan_to_num(sight.z[:, 0] - sight.z[:, 2], nan=-1.0)
        places = transform(T, stereo.triangulate(sight.z))
        for serial, d, place in zip(sight.serials.tolist(), disparity.tolist(), places):
            if d > nearest.get(serial, (0.0, place))[0]:
                nearest[serial] = d, place
    return {serial: place for serial, (d, place) in nearest.items() if count[serial] > 1 or d > _DISTINCT}


def _motions(keys: list[int], dt: Array, make: FactorMaker) -> Iterator[gtsam.NonlinearFactor]:
    """What ties poses `dt` (N − 1,) [s] apart: velocities differ by white noise; the first one has its own prior."""
    for i, interval in enumerate(dt.tolist()):
        before = float(dt[i - 1]) if i else None
        first = is_first(before, interval)
        yield make.motion(keys[i if first else i - 1 : i + 2], np.array([before or np.nan, interval]))
