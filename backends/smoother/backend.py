"""The smoother back end: the protocol on top of the steps and the graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from backends.smoother.config import SmootherConfig
from backends.smoother.factors import FactorMaker
from backends.smoother.graph import Graph
from backends.smoother.state import SmootherState
from backends.smoother.steps import Steps
from slam.bounds import from_options
from slam.checks import known_landmarks, require_guess, require_not_measured, require_recent, require_stamp
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, RecentPoses, UpdateReport
from slam.errors import CopyError, MeasurementError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.stereo import TOO_LATE, Field


class SmootherBackend:
    """gtsam's incremental fixed-lag smoother over smart stereo factors.

    The newest pose and each landmark are estimated twice: the pose from the landmarks as they stand, which gates its
    measurements (`slam.window.pose_only`), then by the graph; the landmark within its smart factor, then from its last
    measurements and the poses as the graph has them. It stands where these put it, as they outlive the lag and the
    factor: a landmark that comes back is where it was left.

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        options: see `SmootherConfig`.

    Attributes:
        state: all that is kept: poses, measurements, landmarks.
        factor_maker: makes factors with this back end's rig and models.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(SmootherConfig, "smoother", options)
        self._steps = Steps(rig, models, self.config)
        self.factor_maker = FactorMaker(self._steps.stereo, models)
        self._graph = Graph(self.factor_maker, self.config.lag)
        self.state = SmootherState.empty(np.zeros((6, 0)))

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predict(stamp, rests=False)

    @one_blas_thread
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        return self._predict(stamp, rests=self.state.started)

    def _predict(self, stamp: float, rests: bool) -> Prediction:
        s = self.state
        require_stamp("smoother", stamp, float(s.stamps[-1]) if s.started else None)
        s = self._steps.predicted(s, float(stamp), rests)
        rows, left, right, S = self._steps.in_view(s)
        self.state, T, P = s, s.poses[-1].copy(), s.covariances[-1].copy()
        return Prediction(float(stamp), T, P, s.landmarks.ids[rows], left, right, S)

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        s = self._started("update")
        require_guess("smoother", guess)
        require_not_measured("smoother", s.measured)
        z = self._steps.stereo.measure(observations)
        s, report = self._steps.updated(s, self._graph, observations.ids.copy(), z, guess)
        self.state = s
        return report

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        s = self._started("add")
        if len(observations):
            s = self._steps.added(s, observations.ids.copy(), self._steps.stereo.measure(observations))
            self.state = s

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`. What its measurements said about the poses is kept."""
        self.state = self._steps.removed(self.state, np.unique(np.asarray(ids, np.int64)))

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        s = self._started("estimate")
        marks = s.landmarks
        rows = marks.order if landmarks else marks.order[:0]
        covariances = self.landmark_covariances(rows)
        T, P = s.poses[-1].copy(), s.covariances[-1].copy()
        return Estimate(float(s.stamps[-1]), T, P, marks.ids[rows], marks.position[rows], covariances)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        marks = self.state.landmarks
        return marks.position[marks.rows_of(ids)]

    @one_blas_thread
    def recent(self, n: int) -> RecentPoses:
        """The last camera poses, at most n and as many as are in the graph, with their joint covariance."""
        s, n = self._started("recent"), require_recent("smoother", n)
        first, P = self._graph.joint_covariance(s, s.number + 1 - n)
        return RecentPoses(s.stamps[s.of(first) :].copy(), s.poses[s.of(first) :].copy(), 0.5 * (P + P.T))

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: poses that have left the lag move as one, by `revise` alone."""
        stamps = np.append(self.state.left_stamps, self.state.stamps)
        order = np.argsort(stamps)
        return Trajectory(stamps[order], np.concatenate([self.state.left_poses, self.state.poses])[order])

    def landmark_covariances(self, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) in the world of rows of `state.landmarks`."""
        return self._steps.landmark_covariances(self.state, self._graph, rows)

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        arguments = known_landmarks("smoother", self.state.landmarks, ids, positions, covariances, False)
        if len(ids):
            self.state = self._steps.inserted(self.state, *arguments)

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        arguments = known_landmarks("smoother", s.landmarks, ids, local, covariances, True)
        if len(ids):
            self.state = self._steps.placed(s, *arguments)

    # --- errors of the rig (documented in slam.interfaces.ConsideringBackend) ---

    def consider(self, field: Field, pose: Array | None = None) -> None:
        """See `slam.interfaces.ConsideringBackend.consider`."""
        if self.state.started or len(self.state.landmarks):
            raise MeasurementError(f"smoother: {TOO_LATE}")
        first = np.zeros((6, field(np.zeros((0, 3))).shape[2])) if pose is None else pose
        self._steps, self.state = replace(self._steps, field=field), SmootherState.empty(first)

    def sensitivities(self, ids: IdArray) -> tuple[Array, Array]:
        """See `slam.interfaces.ConsideringBackend.sensitivities`."""
        s = self._started("sensitivities")
        return s.by_rig[6:].copy(), s.landmarks.by_rig[s.landmarks.rows_of(ids)]

    # --- corrected measurements (documented in slam.interfaces.RevisingBackend) ---

    @property
    def revises_path(self) -> bool:
        """See `slam.interfaces.RevisingBackend`: True while the first pose has not left the lag."""
        s = self.state
        return not s.started or s.oldest(self.config.lag, s.number) == 0

    @one_blas_thread
    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: the newest pose stays unless landmarks are known in the world.

        The graph is built anew from corrected measurements, and landmarks move to where they put them. Poses that have
        left the lag move as a whole: the path does not part there.
        """
        s = self.state
        if s.started:
            before, s = s, self._steps.revised(s, self._graph, correct)
            # what the landmarks move by is none of their error: it is the last of the rig's (`RevisingBackend.revise`)
            if not self.revises_path:
                by_rig = s.landmarks.by_rig.copy()
                by_rig[:, :, -1:] -= (s.landmarks.position - before.landmarks.position)[:, :, None]
                s = replace(s, landmarks=replace(s.landmarks, by_rig=by_rig))
            self.state = replace(s, measured=True)

    # --- copies ---

    def __reduce_ex__(self, protocol: object) -> str:
        """Raises CopyError: copying gtsam's objects would abort the process."""
        raise CopyError(
            f"{type(self).__name__} can be neither copied nor pickled, as gtsam's solver cannot: save the map "
            "(slam.save_map) and start in it, or record the run (--record) and replay it"
        )

    # --- parts ---

    def _started(self, what: str) -> SmootherState:
        if not self.state.started:
            raise MeasurementError(f"smoother: {what} before the first predict")
        return self.state
