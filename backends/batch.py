"""The maximum-likelihood estimate from all measurements, by Levenberg-Marquardt: the reference for back ends.

Every frame is a variable, every landmark that was measured with a disparity, and every measurement of one that the
smoother accepted a factor of its own; the motion model ties three successive frames. What was before the problem began
anew is left out.
"""

from __future__ import annotations

import logging
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from backends.smoother import SmootherBackend
from backends.smoother.factors import GraphUpdate
from backends.smoother.graph import SolverError, first_prior, solving
from backends.smoother.landmarks import by_pose
from backends.smoother.state import SmootherState
from slam.data import Estimate
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, transform
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.stereo import RectifiedStereo

#: numerics: standard deviation [m] of a prior on each landmark; without it far ones go to infinity, and leave the
#: covariance of everything open
_FARTHEST = 1e4


class BatchBackend:
    """Levenberg-Marquardt over all poses and landmarks.

    `estimate` and `trajectory` raise `SlamError` where gtsam cannot solve the problem.

    A smoother runs along: it predicts, gates and gives the first values.
    All but `estimate` and `trajectory` are its own methods (`SmootherBackend`). The problem is solved when the path or
    the landmarks are asked for; the pose alone is the smoother's, and so are landmarks that are no variables. Where
    gtsam gives no covariances (motions of which some are ten thousand times as uncertain as others), the whole estimate
    is the smoother's, and a warning is logged.

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
        self.predict_at_rest, self.positions = along.predict_at_rest, along.positions
        self.insert, self.place = along.insert, along.place
        self.consider, self.sensitivities, self.revise = along.consider, along.sensitivities, along.revise
        self._solution: _BatchSolution | None = None

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        if not (landmarks and self._smoother.state.started):
            return self._smoother.estimate(landmarks=False)
        solution = self._solved()
        try:
            return solution.estimate(self._smoother)
        except SolverError as error:
            logging.getLogger(__name__).warning(
                "batch: the estimate is the smoother's, as gtsam gives no covariances: %s", error
            )
            return self._smoother.estimate()

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`."""
        s = self._smoother.state
        if not s.started:
            return self._smoother.trajectory()
        found, solved = self._smoother.trajectory(), self._solved().poses
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
        numbers = range(s.begun, s.number + 1)
        problem = GraphUpdate(make)
        prior, self._base = first_prior(s, s.begun)
        problem.factors.add(make.prior(s.begun, s.start, prior))
        for number in numbers:
            problem.add_pose(s, number, s.begun)
        places = _places(s, make.stereo, numbers)
        known = {serial for serial, one in s.known.items() if one.pose < 0 or one.pose >= s.begun}
        self.landmarks = known.union(places)  # serial numbers of those that are variables
        for serial in sorted(self.landmarks):
            if serial in known:
                problem.add_known(s, serial)
            else:
                problem.values.insert(L(serial), places[serial])
                problem.factors.add(make.known(serial, places[serial], _FARTHEST**2 * np.eye(3)))
        for number in numbers:
            sight = s.sights[s.of(number)]
            for serial, z in zip(sight.serials.tolist(), sight.z.tolist()):
                if serial in self.landmarks:
                    problem.factors.add(make.explicit(make.point(z), number, serial))
        self._factors = problem.factors
        self.values = minimised(problem, iterations=100)
        # (F, 4, 4) from its beginning on
        self.poses = np.array([self.values.atPose3(X(number)).matrix() for number in numbers])

    @cached_property
    def _marginals(self) -> gtsam.Marginals:
        return gtsam.Marginals(self._factors, self.values)

    def estimate(self, smoother: SmootherBackend) -> Estimate:
        """Newest pose and landmarks; SolverError where gtsam gives no covariances."""
        s, marks = self.state, self.state.landmarks
        rows = marks.order
        serials = marks.serial[rows].tolist()
        positions, covariances = marks.position[rows], np.zeros((len(rows), 3, 3))
        others = np.array([serial not in self.landmarks for serial in serials], bool)
        covariances[others] = smoother.landmark_covariances(rows[others])
        for row in np.flatnonzero(~others).tolist():
            key = L(serials[row])
            positions[row] = self.values.atPoint3(key)
            covariances[row] = self.covariance(key, by_pose(self.poses[0], positions[row][None])[0])
        T = self.poses[-1].copy()
        P = self.covariance(X(s.number), adjoint(inverse(T) @ self.poses[0]))
        return Estimate(float(s.stamps[-1]), T, P, marks.ids[rows], positions, covariances)

    def covariance(self, key: int, by_first: Array) -> Array:
        """Marginal covariance (n, n) of a variable, which the first pose moves by `by_first` (n, 6); SolverError."""
        with solving():
            return np.asarray(self._marginals.marginalCovariance(key) + by_first @ self._base @ by_first.T)


def _places(s: SmootherState, stereo: RectifiedStereo, numbers: range) -> dict[int, Array]:
    """Where landmarks (3,) with a disparity begin, by serial number: where the sight with the largest one puts them."""
    nearest: dict[int, tuple[float, Array]] = {}  # largest disparity, and where that puts the landmark
    for number in numbers:
        sight, T = s.sights[s.of(number)], s.poses[s.of(number)]
        disparity = np.nan_to_num(sight.z[:, 0] - sight.z[:, 2], nan=-1.0)
        places = transform(T, stereo.triangulate(sight.z))
        for serial, d, place in zip(sight.serials.tolist(), disparity.tolist(), places):
            if d > nearest.get(serial, (0.0, place))[0]:
                nearest[serial] = d, place
    return {serial: place for serial, (_, place) in nearest.items()}


def minimised(update: GraphUpdate, iterations: int) -> gtsam.Values:
    """The values that fit all factors best, by Levenberg-Marquardt; SolverError if gtsam finds nothing better."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-9)
    with solving():
        before = update.factors.error(update.values)
        optimizer = gtsam.LevenbergMarquardtOptimizer(update.factors, update.values, parameters)
        values = optimizer.optimize()
        after = update.factors.error(values)
    if not np.isfinite(after) or after > before:
        raise SolverError(f"Levenberg-Marquardt found no solution (error {before:.6g} to {after:.6g})")
    if optimizer.iterations() >= iterations:
        logging.getLogger(__name__).warning("Levenberg-Marquardt was stopped after %d iterations", iterations)
    return values
