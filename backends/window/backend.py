"""The window back end: the last poses and the landmarks that they see, solved together in every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from backends.window.history import History, newest_kept, state_corrected
from backends.window.state import WindowConfig, WindowState, settle
from backends.window.steps import Steps
from slam.bounds import from_options
from slam.checks import known_landmarks, require_guess, require_not_measured, require_recent, require_stamp
from slam.data import Estimate, IdArray, Observations, Prediction, RecentPoses, UpdateReport
from slam.errors import MeasurementError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.stereo import TOO_LATE, Field


class WindowBackend:
    """A sliding-window filter with a relative marginal prior: a few poses, and the landmarks that they see.

    The last poses keep their measurements and are solved for together in every frame, with all measurements linearised
    again (Sibley, Matthies & Sukhatme, J. Field Robotics 27(5), 2010). A pose that leaves is marginalised with what it
    measured: the landmarks that go on keep their joint covariance with the poses that stay. One pose stays for longer
    as the reference of that prior, as keyframes do in Leutenegger et al., IJRR 34(3), 2015; what differs is that
    nothing is dropped to keep the problem sparse, that the prior is relative to the reference pose (see
    `slam.window.problem.RelativePrior`), and that landmarks stand in it by inverse distance. Poses that have left are
    still revised, by what stayed, for `WindowConfig.lag` frames.

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        options: see `WindowConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(WindowConfig, "window", options)
        self._steps = Steps(rig, models, self.config)
        self._state = WindowState.empty(np.zeros((6, 0)))
        self._stamps: list[float] = []
        self._final: list[Array] = []  # poses by frame; those of the window and of its past are in the state
        self._history = History(((self._state, ()),))
        self._revised = -1  # number of the newest frame when measurements were revised last, −1 for never
        self._path: tuple[WindowState, Trajectory] | None = None  # the last answer, and the state that it is of

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predict(stamp, rests=False)

    @one_blas_thread
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        return self._predict(stamp, rests=len(self._state.frames) > 0)

    def _predict(self, stamp: float, rests: bool) -> Prediction:
        s = self._state
        require_stamp("window", stamp, float(s.stamps[-1]) if len(s.stamps) else None)
        before, s = s, self._steps.predicted(s, float(stamp), rests)
        s, settled = settle(before, s, self.config.lag)
        rows, left, right, S = self._steps.in_view(s)
        frame = int(s.frames[-1])
        self._stamps[frame:], self._final[frame:] = [float(stamp)], [s.poses[-1].copy()]
        for earlier, T in settled.items():
            self._final[earlier] = T
        self._done(s, "predicted", float(stamp), rests)
        return Prediction(
            float(stamp), s.poses[-1].copy(), s.covariance[-6:, -6:].copy(), s.landmarks.ids[rows], left, right, S
        )

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        s = self._started("update")
        require_guess("window", guess)
        require_not_measured("window", s.measured)
        ids, z = observations.ids.copy(), self._steps.stereo.measure(observations)
        after, report = self._steps.updated(s, ids, z, guess)
        after, settled = settle(s, after, self.config.lag)
        for frame, T in settled.items():
            self._final[frame] = T
        self._done(after, "updated", ids, z, None if guess is None else guess.copy())
        return report

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        s = self._started("add")
        ids, z = observations.ids.copy(), self._steps.stereo.measure(observations)
        if len(ids):
            self._done(self._steps.added(s, ids, z), "added", ids, z)

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`. What its measurements said about the poses is kept."""
        ids = np.unique(np.asarray(ids, np.int64))
        self._done(self._steps.removed(self._state, ids), "removed", ids)

    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        s = self._started("estimate")
        marks = s.landmarks
        rows = marks.order if landmarks else marks.order[:0]
        return Estimate(
            float(s.stamps[-1]), s.poses[-1].copy(), s.covariance[-6:, -6:].copy(), marks.ids[rows],
            marks.position[rows], marks.world[rows],
        )  # fmt: skip

    def recent(self, n: int) -> RecentPoses:
        """The last n poses, or as many as the window has without a gap, with their joint covariance."""
        s = self._started("recent")
        begins = s.frames - np.arange(len(s.frames))  # the same for all without a gap before the newest
        n = min(require_recent("window", n), int((begins == begins[-1]).sum()))
        return RecentPoses(s.stamps[-n:].copy(), s.poses[-n:].copy(), s.covariance[-6 * n :, -6 * n :].copy())

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        marks = self._state.landmarks
        return marks.position[marks.rows_of(ids)]

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: poses of the last `lag` frames are revised, others are final.

        After a revision of the measurements, the last frames are gone through again for it. The newest pose stays where
        it is and the path before it moves, but where landmarks are known in the world.
        """
        if self._path is None or self._path[0] is not self._state:
            s, final, M = self._state, self._final, np.eye(4)
            if self._revised >= max(self._history.begins, 0):  # states since then come from revised measurements
                s, final = self._history.repeated(self._steps, final)
                M = M if self._history.anchored else self._state.poses[-1] @ inverse(s.poses[-1])
            poses = np.array(final).reshape(-1, 4, 4)
            for frame, T in s.revised_poses().items():
                poses[frame] = T
            self._path = self._state, Trajectory(np.array(self._stamps), M @ poses)
        return Trajectory(self._path[1].stamps.copy(), self._path[1].poses.copy())

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        arguments = known_landmarks("window", self._state.landmarks, ids, positions, covariances, False)
        if len(ids):
            self._done(self._steps.inserted(self._state, *arguments), "inserted", *arguments)

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        arguments = known_landmarks("window", s.landmarks, ids, local, covariances, True)
        if len(ids):
            self._done(self._steps.placed(s, *arguments), "placed", *arguments)

    # --- errors of the rig (documented in slam.interfaces.ConsideringBackend) ---

    def consider(self, field: Field, pose: Array | None = None) -> None:
        """See `slam.interfaces.ConsideringBackend.consider`."""
        if len(self._state.frames) or len(self._state.landmarks):
            raise MeasurementError(f"window: {TOO_LATE}")
        first = np.zeros((6, field(np.zeros((0, 3))).shape[2])) if pose is None else pose
        self._steps, self._state = replace(self._steps, field=field), WindowState.empty(first)
        self._history = History(((self._state, ()),))

    def sensitivities(self, ids: IdArray) -> tuple[Array, Array]:
        """See `slam.interfaces.ConsideringBackend.sensitivities`."""
        s = self._started("sensitivities")
        return s.by_rig[-6:].copy(), s.landmarks.by_rig[s.landmarks.rows_of(ids)]

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    @property
    def revises_path(self) -> bool:
        """See `slam.interfaces.RevisingBackend`: True while the first frame's measurements are still known."""
        return self._history.begins < 0

    @one_blas_thread
    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: the newest pose stays where it is.

        Measurements of the window are corrected, and landmarks move to where the newest camera sees them corrected. The
        path is found anew when it is asked for.
        """
        if len(self._state.frames):
            s = state_corrected(self._state, self._steps.stereo, correct, self.revises_path)
            s = s if self._history.anchored else newest_kept(s, self._steps.stereo)
            self._history = self._history.corrected(self._steps.stereo, correct)
            self._state, self._revised = replace(s, measured=True), int(s.frames[-1])

    # --- parts ---

    def _started(self, what: str) -> WindowState:
        if not len(self._state.frames):
            raise MeasurementError(f"window: {what} before the first predict")
        return self._state

    def _done(self, s: WindowState, step: str, *arguments: Any) -> None:
        """Take over the state after a step, and remember the step."""
        self._history, self._state = self._history.then((step, arguments), s, self.config.lag), s
