"""The maximum-likelihood estimate from all measurements, by Levenberg-Marquardt: the reference for back ends.

Every landmark is a variable and every accepted measurement a factor of its own; nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from backends.smoother import SmootherBackend
from backends.smoother.config import SmootherConfig
from backends.smoother.rebuild import add_landmark, add_poses, optimise
from backends.smoother.solver import FAILURES, Change
from backends.smoother.variables import landmark_key, pose_key
from slam.checks import require_recent
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, RecentPoses, UpdateReport
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, transform
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.blas import one_blas_thread

_ITERATIONS = 100  # numerics: of Levenberg-Marquardt at most


@dataclass(frozen=True)
class BatchConfig(SmootherConfig):
    """Options of `BatchBackend`: those of the smoother that runs along, and its own.

    Attributes:
        online: whether the pose alone is the solved one as well, and not the smoother's.
        lag: no option here: all poses stay variables.
    """

    online: bool = False
    lag: None = None


class BatchBackend:
    """Levenberg-Marquardt over all poses and landmarks.

    `estimate` and `trajectory` raise `SlamError` where gtsam cannot solve the problem.

    A smoother runs along: it predicts, gates and gives the first values. The problem is solved when the trajectory or
    the landmarks are asked for; with ``online=True`` whenever the pose is, which costs more with every frame.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        online: whether the pose alone is the solved one as well, and not the smoother's.
        options: of the smoother but for its lag, see `backends.smoother.config.SmootherConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(
        self,
        rig: StereoRig,
        models: EstimatorModels = EstimatorModels(),  # noqa: B008
        online: bool = False,
        **options: Any,
    ) -> None:
        if not isinstance(online, bool):
            raise ConfigurationError(f"batch: online must be true or false, got {online!r}")
        self.rig = rig
        self.models = models
        self.online = online
        if "lag" in options:
            raise ConfigurationError("batch: lag is an option of the smoother; nothing is left out here")
        self._smoother = SmootherBackend(rig, models, lag=None, **options)
        self.config = BatchConfig(**asdict(self._smoother.config), online=online)
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
        if not (landmarks or self.online):
            return rough
        solution = self._solved()
        marks = self._smoother.measurement_log.landmarks
        slots = marks.slots(rough.ids)
        positions, covariances = rough.positions.copy(), rough.covariances.copy()
        for row, serial in enumerate(marks.serial[slots].tolist()):
            if serial in solution.landmarks:
                positions[row] = solution.values.atPoint3(landmark_key(serial))
                covariances[row] = solution.covariance(landmark_key(serial), covariances[row])
        path = self._smoother.measurement_log.path
        if not path.count or path.stamps[-1] < rough.stamp:  # predicted only: its measurements are still to come
            return Estimate(rough.stamp, rough.T_world_left, rough.covariance, rough.ids, positions, covariances)
        P = solution.covariance(pose_key(path.count - 1), rough.covariance)
        return Estimate(rough.stamp, solution.poses[-1].copy(), P, rough.ids, positions, covariances)

    @one_blas_thread
    def recent(self, n: int) -> RecentPoses:
        """The last n poses with their joint covariance; one that has no measurements yet is known by itself alone."""
        n, newest = require_recent("batch", n), self.estimate()
        solution, path = self._solved(), self._smoother.measurement_log.path
        count, first = path.count, self._smoother.measurement_log.history.first
        keys = [pose_key(i) for i in range(max(count - n, first), count)]
        P = solution.joint(keys) if count and path.stamps[count - 1] == newest.stamp else None
        if P is None:
            return RecentPoses(np.array([newest.stamp]), newest.T_world_left[None], newest.covariance)
        return RecentPoses(path.stamps[count - len(keys) : count].copy(), solution.poses[-len(keys) :].copy(), P)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`: the smoother's."""
        return self._smoother.positions(ids)

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`."""
        rough = self._smoother.trajectory()
        if not len(rough):
            return rough
        solved = self._solved().poses
        return Trajectory(rough.stamps, np.concatenate([solved, rough.poses[len(solved) :]]))

    def _solved(self) -> _Solution:
        count = self._smoother.measurement_log.path.count  # a pose without measurements may have come since
        if self._solution is None or len(self._solution.poses) != count:
            self._solution = _Solution(self._smoother)
        return self._solution


class _Solution:
    """A solved problem.

    Attributes:
        values: all variables.
        poses: (F, 4, 4); those before a restart of the smoother are its own.
        landmarks: serial numbers of the landmarks that are variables.
    """

    def __init__(self, smoother: SmootherBackend) -> None:
        change = Change()
        make, measurement_log = smoother.factor_maker, smoother.measurement_log
        add_poses(change, make, measurement_log)
        self.landmarks: set[int] = set()
        for serial, rows in _by_landmark(measurement_log.measurements.landmark, measurement_log.history.known):
            known = measurement_log.history.known.get(serial)
            if known is not None:
                T = np.eye(4) if known.frame is None else measurement_log.path.poses[known.frame]
                add_landmark(
                    change, make, measurement_log, landmark_key(serial), rows, transform(T, known.position[None])[0]
                )
                change.factors.add(make.known(landmark_key(serial), known))
                self.landmarks.add(serial)
                continue
            z = measurement_log.measurements.z[rows]
            nearest = int(np.nanargmax(z[:, 0] - z[:, 2]))  # its depth is known best
            local = make.stereo.triangulate(z[nearest : nearest + 1])
            T = measurement_log.path.poses[measurement_log.measurements.frame[rows[nearest]]]
            add_landmark(change, make, measurement_log, landmark_key(serial), rows, transform(T, local)[0])
            self.landmarks.add(serial)
        self._factors = change.factors
        self.values = optimise(change, _ITERATIONS)
        self.poses, first = measurement_log.path.poses.copy(), measurement_log.history.first
        for i in range(first, len(self.poses)):
            self.poses[i] = self.values.atPose3(pose_key(i)).matrix()

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

    def joint(self, keys: list[int]) -> Array | None:
        """Joint covariance of poses (6 K, 6 K), perturbed on the right; None where the problem leaves one open."""
        if self._marginals is None:
            return None
        try:
            found = self._marginals.jointMarginalCovariance(keys)
        except FAILURES:
            return None
        return np.block([[found.at(i, j) for j in keys] for i in keys])


def _by_landmark(landmark: NDArray[np.int32], known: Container[int]) -> Iterator[tuple[int, IndexArray]]:
    """Serial numbers of landmarks measured at least twice, or once and `known`, each with its measurements' rows."""
    order = np.argsort(landmark, kind="stable")
    serials, starts = np.unique(landmark[order], return_index=True)
    for serial, rows in zip(serials.tolist(), np.split(order, starts[1:])):
        if serial >= 0 and (len(rows) > 1 or serial in known):
            yield serial, rows
