"""The smoother back end: the protocol on top of the factor graph and the belief that follows from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from backends.smoother.belief import Belief
from backends.smoother.config import SmootherConfig
from backends.smoother.factor_graph import FactorGraph
from backends.smoother.factors import FactorMaker
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.pose_set import PredictedPose
from backends.smoother.prediction import normalised_innovation
from backends.smoother.rollback import snapshot
from backends.smoother.solver import SolverError
from slam.checks import require_guess, require_not_measured, require_stamp
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import CopyError, MeasurementError
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse
from slam.geometry.trajectory import Trajectory
from slam.mapping.known_landmarks import require_in_front, require_known
from slam.models import EstimatorModels
from slam.options import from_options
from slam.runtime.blas import one_blas_thread
from slam.window import pose_only
from slam.window.agreement import landmarks_pose
from slam.window.gating import with_noise
from slam.window.pose_only import residual_noise, seen_from
from slam.window.recovery import Agreement, agreement, world_covariance
from slam.window.stereo import RectifiedStereo


class SmootherBackend:
    """ISAM2 over smart stereo factors: all poses are estimated together and revised with every frame.

    The motion model is the papers' (see `backends.smoother.motion`). Which landmarks are eliminated and which are
    variables: see `backends.smoother.factor_builder`. Covariances: see `backends.smoother.uncertainty`.

    Args:
        rig: the cameras; measurements of any rig are rectified first.
        models: noise, priors, motion and gate.
        options: see `SmootherConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(SmootherConfig, "smoother", options)
        self._stereo = RectifiedStereo.of(rig)
        self._make = FactorMaker(self._stereo, models)
        self._graph = FactorGraph(self._make, self.config)
        self._belief = Belief(self._graph, models)
        self._answer: tuple[MeasurementLog, Belief] | None = None  # what `estimate` and `trajectory` last gave
        self._measured = False  # whether the predicted pose has had its update
        self._contradicted = 0  # updates in succession that disagreed with the path

    @property
    def measurement_log(self) -> MeasurementLog:
        """Poses, measurements and landmarks as they are believed now; not to be changed."""
        return self._graph.log

    @property
    def factor_maker(self) -> FactorMaker:
        """Makes factors with this back end's rig and models."""
        return self._make

    @property
    def solver_seconds(self) -> float:
        """CPU time spent in gtsam's solvers so far [s]: the least this back end could cost; the rest is overhead."""
        return self._graph.solver_seconds

    @property
    def rebuilds(self) -> int:
        """How often the problem was put into a new solver so far, after a failure or a divergence."""
        return self._graph.rebuilds

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predict(stamp, rests=False)

    @one_blas_thread
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        return self._predict(stamp, rests=self.measurement_log.path.count > 0)

    def _predict(self, stamp: float, rests: bool) -> Prediction:
        path = self.measurement_log.path
        last = path.predicted.stamp if path.predicted is not None else float(path.stamps[-1]) if path.count else None
        require_stamp("smoother", stamp, last)
        self._graph.repair()
        self._commit()
        path = self.measurement_log.path
        path.rests.discard(path.count)
        if rests:
            path.rests.add(path.count)
        predicted = self._belief.predicted(stamp)
        in_view = self._in_view(predicted)
        self._answer, self._measured = None, False
        self.measurement_log.path.predicted = predicted  # last: an interrupted call has predicted nothing
        return in_view

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        self._require_started("update")
        predicted = self.measurement_log.path.predicted
        require_not_measured("smoother", predicted is None or self._measured)
        require_guess("smoother", guess)
        slots = self.measurement_log.landmarks.slots(observations.ids)
        assert predicted is not None
        report = self._corrected(predicted, slots, observations, guess)
        self._measured = True
        return report

    def _corrected(
        self, predicted: PredictedPose, slots: IndexArray, observations: Observations, guess: Array | None
    ) -> UpdateReport:
        """The update by observations of landmarks `slots`."""
        if not len(slots):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        z, P = self._stereo.measure(observations), predicted.covariance
        try:
            found = self._solve_pose(predicted, slots, z, observations, guess)
        except np.linalg.LinAlgError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"smoother: the pose cannot be solved for: {error}")
        self._contradicted = found.contradicted
        T, used = found.T, found.used
        if not used.any():
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", observations.ids)
        if found.jump is not None:
            predicted = replace(predicted, noise=predicted.noise + np.diag(found.jump))
        solved = self._belief.points(replace(predicted, T=T), slots[used])
        step = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(predicted.T) @ T))
        try:
            nis, dof = normalised_innovation(self._stereo, self._make.sigma, solved, z[used], step)
        except np.linalg.LinAlgError:  # covariances that differ by more than their digits
            nis, dof = float("nan"), 0
        with self._whole():
            if found.jump is not None:
                before = self._belief.covariances_from_measured()
                failure = self._graph.restart(predicted.stamp, T, world_covariance(P), before, slots[used], z[used])
            else:
                failure = self._graph.append_measured_pose(predicted.stamp, T, slots[used], z[used])
            if failure:
                return UpdateReport.nothing(UpdateStatus.FAILED, f"smoother: {failure}")
            return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], nis, dof)

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._require_started("add")
        self._require_new(observations.ids)
        if not len(observations):
            return
        z = self._stereo.measure(observations)
        local = self._stereo.triangulate(z)
        bad = ~np.isfinite(local).all(axis=1)
        if bad.any():
            raise MeasurementError(
                f"smoother: landmark {observations.ids[bad][0]} has no right pixel or no positive depth"
            )
        self._commit()
        with self._whole():
            self._graph.add_landmarks(observations.ids, z, local)

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`. What its measurements said about the poses is kept."""
        slots = self.measurement_log.landmarks.slots(np.unique(np.asarray(ids, np.int64)))
        with self._whole():
            self._graph.remove_landmarks(slots)

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        self._require_started("estimate")
        self._graph.repair()
        log, belief = self._converged() if landmarks else (self.measurement_log, self._belief)
        stamp, T, P = belief.newest()
        marks = log.landmarks
        slots = marks.all_slots() if landmarks else np.zeros(0, np.intp)
        covariances = belief.landmark_covariances(slots) if len(slots) else np.zeros((0, 3, 3))
        return Estimate(stamp, T, P, marks.ids[slots], marks.position[slots], covariances)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        marks = self.measurement_log.landmarks
        return marks.position[marks.slots(ids)]

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: every pose as it is believed now."""
        self._graph.repair()
        path = self._converged()[0].path
        ahead = path.predicted
        if ahead is not None:  # not in the graph yet: its measurements are still to come
            return Trajectory(np.append(path.stamps, ahead.stamp), np.concatenate([path.poses, ahead.T[None]]))
        return Trajectory(path.stamps.copy(), path.poses.copy())

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        require_known("smoother", ids, positions, covariances)
        self._require_new(ids)
        with self._whole():
            self._graph.add_known(ids, positions, covariances)

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        self._require_started("place")
        require_known("smoother", ids, local, covariances)
        require_in_front("smoother", ids, local)
        self._require_new(ids)
        if not len(ids):
            return
        self._commit()
        with self._whole():
            self._graph.add_known(ids, local, covariances, self.measurement_log.path.count - 1)

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    @property
    def revises_path(self) -> bool:
        """See `slam.interfaces.RevisingBackend`: True while all poses and measurements are still in the problem."""
        history = self.measurement_log.history
        return history.first == history.restarted == 0 and not self._graph.poses_leave()

    @one_blas_thread
    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: solves the whole problem again, as long as that takes."""
        self._commit()
        if self.measurement_log.measurements.count:
            with self._whole():
                self._graph.revise(correct)

    # --- copies ---

    def __reduce_ex__(self, protocol: object) -> str:
        """Refuse to be copied: copying gtsam's objects would abort the process.

        Raises:
            CopyError: always.
        """
        raise CopyError(
            f"{type(self).__name__} can be neither copied nor pickled, as gtsam's solver cannot: save the map "
            "(slam.save_map) and start in it, or record the run (--record) and replay it"
        )

    # --- parts ---

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Make a block atomic: if it is interrupted, the measurement log is restored."""
        self._answer = None
        self._graph.repair()
        restore = snapshot(self.measurement_log)
        try:
            yield
            self._belief.window()  # here, as it may have to repair the solver, which a query must not do
        except BaseException:
            self._graph.interrupted()
            restore()
            raise

    def _converged(self) -> tuple[MeasurementLog, Belief]:
        """Everything as the converged problem has it, without changing the state; as it stands if that fails."""
        if self._answer is None:
            log, belief = self.measurement_log, self._belief
            with suppress(SolverError):
                if log.path.count:
                    graph = self._graph.converged()
                    log, belief = graph.log, Belief(graph, self.models)
            self._answer = log, belief
        return self._answer

    def _commit(self) -> None:
        """Put a predicted pose without measurements into the graph."""
        predicted = self.measurement_log.path.predicted
        if predicted is not None:
            with self._whole():
                self._graph.append_pose(predicted.stamp, predicted.T)

    def _in_view(self, predicted: PredictedPose) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        T, marks, rig = predicted.T, self.measurement_log.landmarks, self.rig
        slots = marks.used()
        slots = slots[rig.left.in_view((marks.position[slots] - T[:3, 3]) @ T[:3, :3])]
        points = self._belief.points(predicted, slots)
        uv, J = rig.left.project_with_jacobian(points.local)
        right = rig.right.project((points.local + rig.b) @ rig.R.T)
        S = with_noise(points.covariance(J), self.models.pixel_sigma)
        return Prediction(predicted.stamp, T.copy(), predicted.covariance, marks.ids[slots], uv, right, S)

    def _solve_pose(
        self, predicted: PredictedPose, slots: IndexArray, z: Array, observations: Observations, guess: Array | None
    ) -> Agreement:
        """Initial value of the newest pose, and which measurements agree with it."""
        marks = self.measurement_log.landmarks
        local, own = seen_from(predicted.T, marks.position[slots], marks.covariance[slots])
        noise = residual_noise(self._stereo, self._make.sigma, local, own, z)
        known = marks.prior[slots].any()  # what is known in the world does not move with the poses
        P = predicted.covariance if known else predicted.covariance_to(self._belief.last_measured())
        information = np.linalg.inv(P)
        problem = pose_only.PoseProblem(
            self._stereo, marks.position[slots], z, noise, predicted.T, information, self.models.gate_probability
        )

        def search() -> Array | None:
            rows, seed = measurement_rows(observations.uv_left, observations.uv_right), self.measurement_log.path.count
            return landmarks_pose(self.rig, problem.points, rows, self.models, predicted.T, seed)

        start = predicted.T if guess is None else guess
        return agreement(problem, start, search, self._contradicted, self._belief.lost())

    def _require_started(self, what: str) -> None:
        if not self.measurement_log.path.count and self.measurement_log.path.predicted is None:
            raise MeasurementError(f"smoother: {what} before the first predict")

    def _require_new(self, ids: IdArray) -> None:
        known = ids[self.measurement_log.landmarks.among(ids)]
        if len(known):
            raise MeasurementError(f"smoother: landmark {known[0]} is in the map already")
