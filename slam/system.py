"""The system: one step of stereo SLAM, whatever detects and whatever estimates."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from slam import registry
from slam.config import SystemConfig
from slam.data import (
    BoolArray,
    Estimate,
    FrameResult,
    FrameStatus,
    IdArray,
    Observations,
    Prediction,
    StereoFeatures,
    StereoFrame,
    UpdateReport,
    UpdateStatus,
)
from slam.errors import ConfigurationError
from slam.interfaces import Backend, Frontend
from slam.landmarks import LandmarkRows
from slam.map_management import bad_landmarks, new_landmarks, surplus_landmarks
from slam.recognition import Recogniser, Recognition
from slam.rig import StereoRig
from slam.selfcalibration import SelfCalibration
from slam.trajectory import Trajectory

_MINIMUM_TRACKED = 3  # stereo points that fix a pose


class StereoSlam:
    """Stereo SLAM with a front end and a back end of choice.

    Args:
        rig: the two cameras.
        frontend: a name (see ``frontends.names()``), an object with `Frontend`'s method, or None where features are
            given directly to `process_features`.
        backend: a name (see ``backends.names()``) or an object with `Backend`'s methods.
        kind: kind of motion, ``"handheld"`` or ``"driving"``, which chooses the default settings.
        config: all settings; overrides `kind`.

    Raises:
        UnknownNameError: no front end or back end of this name.
        ConfigurationError: a setting is unknown or out of range.

    Example:
        >>> import slam
        >>> sequence = slam.open_sequence("synthetic:desk?frames=3")
        >>> system = slam.StereoSlam(sequence.rig, backend="ekf")
        >>> results = [system.process(frame) for frame in sequence]
    """

    def __init__(
        self,
        rig: StereoRig,
        frontend: str | Frontend | None = "surf",
        backend: str | Backend = "ekf",
        *,
        kind: str = "handheld",
        config: SystemConfig | None = None,
    ) -> None:
        self.rig = rig
        self.config = config or SystemConfig.for_kind(kind, frontend if isinstance(frontend, str) else None)
        c = self.config
        self.frontend: Frontend | None = (
            registry.create("frontends", frontend, rig, **c.frontend) if isinstance(frontend, str) else frontend
        )
        self.backend: Backend = (
            registry.create("backends", backend, rig, models=c.models, **c.backend)
            if isinstance(backend, str)
            else backend
        )
        self.landmarks: LandmarkRows | None = None
        self.calibration = SelfCalibration(rig, c.self_calibration)
        self._recogniser = Recogniser(rig, c.association, c.models.pixel_sigma)
        self._index = -1
        self._next_id = 0
        self._unrecognised = 0  # frames since a landmark was last recognised

    def process(self, frame: StereoFrame) -> FrameResult:
        """One step from a pair of images; see `process_features`."""
        if self.frontend is None:
            raise ConfigurationError("this system has no front end: use process_features")
        start = time.perf_counter()
        features = self.frontend.extract(frame)
        elapsed = 1e3 * (time.perf_counter() - start)
        result = self.process_features(features)
        return replace(result, milliseconds={"extract": elapsed, **result.milliseconds})

    def process_features(self, features: StereoFeatures) -> FrameResult:
        """One step from features: predict, associate, update, and keep the map (paper A, III and IV; paper B, 2).

        A frame with nothing to see is no error: the state is predicted and the status says so.

        Raises:
            MeasurementError: time does not increase.
        """
        clock = _Clock()
        prediction = self.backend.predict(features.stamp)
        self._index += 1
        landmarks = self.landmarks or LandmarkRows.empty(features.descriptors.shape[1])
        clock.lap("predict")
        measured, features = features, self.calibration.correct(features)
        found = self._recognise(prediction, landmarks, features)
        self.calibration.observe(found.ids, measured.uv_left[found.rows], measured.uv_right[found.rows])
        clock.lap("associate")
        report = self.backend.update(_observations(features, found), found.T_world_left)
        clock.lap("update")
        landmarks = self._count(landmarks, prediction, features, found, report)
        landmarks, erased = self._erase(landmarks, bad_landmarks(landmarks, self.config.map))
        landmarks, added = self._add(landmarks, features, found)
        landmarks, surplus = self._erase(landmarks, surplus_landmarks(landmarks, self.config.map))
        self.landmarks = landmarks
        clock.lap("manage")
        estimate = self.backend.estimate(landmarks=False)
        status, reason = self._status(report, len(added))
        clock.lap("estimate")
        return FrameResult(
            index=self._index,
            status=status,
            reason=reason,
            estimate=estimate,
            report=report,
            features=features,
            predicted=len(prediction.ids),
            matched=found.ids,
            matched_features=found.rows,
            added=added.ids,
            added_features=added.rows,
            erased=np.concatenate([erased, surplus]),
            map_size=len(landmarks),
            milliseconds=clock.laps,
        )

    def trajectory(self) -> Trajectory:
        """The left camera's path: the back end's last word on every frame."""
        return self.backend.trajectory()

    def estimate(self) -> Estimate:
        """Pose and map with covariances."""
        return self.backend.estimate()

    def _recognise(self, prediction: Prediction, landmarks: LandmarkRows, features: StereoFeatures) -> Recognition:
        """Landmarks in this frame (paper A, III and IV)."""
        positions = self.backend.positions(landmarks.ids)
        return self._recogniser.recognise(prediction, landmarks, positions, features, seed=self._index)

    def _count(
        self,
        landmarks: LandmarkRows,
        prediction: Prediction,
        features: StereoFeatures,
        found: Recognition,
        report: UpdateReport,
    ) -> LandmarkRows:
        """Count what was seen and missed; a frame in which nothing is recognised says nothing of single landmarks."""
        tracked = len(report.used) >= _MINIMUM_TRACKED
        self._unrecognised = 0 if tracked else self._unrecognised + 1
        expected = prediction.ids if tracked else prediction.ids[:0]
        measured = np.isin(found.ids, report.used)
        return landmarks.after_frame(self._index, expected, found.ids[measured], features, found.rows[measured])

    def _erase(self, landmarks: LandmarkRows, rows: BoolArray) -> tuple[LandmarkRows, IdArray]:
        """Drop landmarks from the map and from the back end."""
        erased = landmarks.ids[rows]
        if len(erased):
            self.backend.remove(erased)
            landmarks = landmarks.select(~rows)
        return landmarks, erased

    def _add(
        self, landmarks: LandmarkRows, features: StereoFeatures, found: Recognition
    ) -> tuple[LandmarkRows, Recognition]:
        """Make landmarks of features that are none yet; not where the pose is unknown, but for starting anew."""
        if len(landmarks) and self._unrecognised % (self.config.map.restart_after + 1):
            return landmarks, Recognition.nothing()
        free = np.ones(len(features), bool)
        free[found.rows] = False
        occupied = features.uv_left[found.rows]
        rows = new_landmarks(features, free, occupied, self.rig, self.config.models.pixel_sigma, self.config.map)
        ids = np.arange(self._next_id, self._next_id + len(rows), dtype=np.int64)
        added = Recognition(ids, rows)
        if len(added):
            self.backend.add(_observations(features, added))
            landmarks = landmarks.with_new(self._index, ids, features, rows)
            self._next_id += len(added)
        return landmarks, added

    def _status(self, report: UpdateReport, added: int) -> tuple[FrameStatus, str]:
        if report.status is UpdateStatus.FAILED:
            return FrameStatus.FAILED, report.reason
        if len(report.used) >= _MINIMUM_TRACKED:
            return FrameStatus.TRACKED, ""
        if self._next_id == added:
            return (FrameStatus.STARTED, "") if added else (FrameStatus.PREDICTED, "nothing to see yet")
        return FrameStatus.PREDICTED, report.reason or f"only {len(report.used)} landmarks recognised"


def _observations(features: StereoFeatures, found: Recognition) -> Observations:
    return Observations(found.ids, features.uv_left[found.rows], features.uv_right[found.rows])


@dataclass
class _Clock:
    """Wall time between laps [ms]."""

    def __post_init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = 1e3 * (now - self._last)
        self._last = now
