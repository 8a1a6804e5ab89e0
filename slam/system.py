"""The system: one step of stereo SLAM, whatever detects and whatever estimates."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from slam import registry
from slam.calibration import Revision, SelfCalibration
from slam.config import SystemConfig
from slam.data import (
    Estimate,
    FrameResult,
    FrameStatus,
    IdArray,
    Prediction,
    StereoFeatures,
    StereoFrame,
    UpdateReport,
    UpdateStatus,
)
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend, Frontend, MapBackend, RevisingBackend
from slam.landmarks import LandmarkRows
from slam.mapping.map_io import FIRST_FRAME, SavedMap
from slam.mapping.map_search import MapSearch, models_at
from slam.mapping.mapper import Mapper, Step, observations_of
from slam.objects.modes import ObjectDetector, detector_for
from slam.tracking.localizer import LandmarkMatches, Localizer, jump, median_deviation
from slam.tracking.relocalization import PoseHypotheses, transfer_landmarks
from slam.tracking.state import Tracking

_MINIMUM_TRACKED = 3  # stereo points that fix a pose
_COUNTS = 0.5  # standard deviations of the disparities' error; what changes by less is as likely as before


class StereoSlam:
    """Stereo SLAM with a front end and a back end of choice.

    Args:
        rig: the two cameras.
        frontend: a name (see ``frontends.names()``), an object with `Frontend`'s method, or None where features are
            given directly to `process_features`.
        backend: a name (see ``backends.names()``) or an object with `Backend`'s methods.
        kind: kind of motion, ``"handheld"`` or ``"driving"``, which chooses the default settings.
        config: all settings; overrides `kind`.
        known_map: a map to start in (see `slam.load_map`). The world is then the map's; frames are lost until the
            camera is found in it. The back end must be given by its name.

    Raises:
        UnknownNameError: no front end or back end of this name.
        ConfigurationError: a setting is unknown or out of range.
        SlamError: the map is of another front end.

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
        known_map: SavedMap | None = None,
    ) -> None:
        self.rig = rig
        names = (name if isinstance(name, str) else None for name in (frontend, backend))
        default = SystemConfig.for_kind(kind, *names)
        self.config = config or default
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
        self.objects: ObjectDetector = detector_for(rig, c.objects, c.models)
        self._localizer = Localizer(rig, c.association, c.models.pixel_sigma)
        self._index = -1
        self._tracking = Tracking()
        self.frontend_name = frontend if isinstance(frontend, str) else ""
        self.world_frame = FIRST_FRAME
        self._keeper = Mapper(rig, c, self._localizer, self.backend)
        self._backend_name = backend if isinstance(backend, str) else None
        self._can_restart = isinstance(backend, str) and isinstance(self.backend, MapBackend)
        self._carried = PoseHypotheses()
        self._past: list[Trajectory] = []  # the paths of back ends before the camera was carried off
        self.restarted: list[int] = []  # indices of the frames in which another back end went on
        self._search: MapSearch | None = None
        if known_map is not None:
            self._search_in(known_map, backend)

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
        if self._search is not None and not self._located(self._search, features):
            self._index += 1
            return self._search.lost(self._index, features)
        revision = self._revise()
        prediction = self.backend.predict(features.stamp)
        self._index += 1
        landmarks = self.landmarks or LandmarkRows.empty(features.descriptors.shape[1])
        clock.lap("predict")
        measured, features = features, self.calibration.correct(features)
        prediction, found = self._localize(prediction, landmarks, features)
        found = found.without(self.objects.suspects)
        pose = prediction.T_world_left if found.T_world_left is None else found.T_world_left
        self.calibration.observe(measured, pose)
        clock.lap("associate")
        report = self.backend.update(observations_of(features, found), found.T_world_left)
        clock.lap("update")
        self._tracking = self._tracked(prediction, features, found, report)
        estimate = self.backend.estimate(landmarks=False)
        clock.lap("estimate")
        judged = self.objects.classify(features, estimate, _landmark_ids(features, found))
        objects = self.objects.update(self.backend, features)
        clock.lap("objects")
        step = Step(self._index, features, estimate, found, report, judged, self._tracking)
        landmarks, added, erased = self._keeper.keep(self.backend, landmarks, step)
        self.landmarks = landmarks
        status, reason = self._status(report, len(added))
        clock.lap("manage")
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
            erased=erased,
            map_size=len(landmarks),
            milliseconds=clock.laps,
            moving_features=judged.moving,
            objects=objects,
            revision=revision,
        )

    def _revise(self) -> Revision | None:
        """Take what has become known of the rig's error into use, for what was given to the back end as well.

        All its measurements are then to be weighed anew, so a back end that can do that waits for a change that counts.
        """
        if not isinstance(self.backend, RevisingBackend):
            self.calibration.apply()
            return None
        revision = self.calibration.apply(_COUNTS)
        if revision is not None:
            self.backend.revise(revision.rows)
        return revision

    @property
    def unlocated_map(self) -> SavedMap | None:
        """The map that the system was started with, as long as the camera has not been found in it."""
        return None if self._search is None else self._search.known

    def trajectory(self) -> Trajectory:
        """The left camera's path: the back end's last word on every frame (in a known map, from when it was found)."""
        return Trajectory.joined([*self._past, self.backend.trajectory()])

    def estimate(self) -> Estimate:
        """Pose and map with covariances."""
        return self.backend.estimate() if self._search is None else self._search.estimate(float("nan"))

    def _search_in(self, known_map: SavedMap, backend: str | Backend) -> None:
        """Start in a known map."""
        if not isinstance(backend, str):
            raise ConfigurationError("a system that starts in a known map needs its back end by name")
        known_map.require_fits(self.frontend_name)
        self._search = MapSearch(known_map, self.rig, self._localizer, self.config.models.initial_pose)
        self._search.fill(self.backend)
        self.landmarks = known_map.rows
        self.world_frame = known_map.world_frame

    def _located(self, search: MapSearch, features: StereoFeatures) -> bool:
        """Look for the camera in the known map; where it is found, the back end begins there, with the map."""
        T = search.locate(features, self._index + 1)
        if T is None:
            return False
        self.backend = self._new_backend(T)
        search.fill(self.backend)
        self._keeper.next_id = int(search.known.ids.max(initial=-1)) + 1
        self._search = None
        return True

    def _new_backend(self, T_world_left: Array) -> Backend:
        """A back end of the same name that begins at a pose (4, 4) which is only roughly known."""
        assert self._backend_name is not None
        models = models_at(self.config.models, T_world_left)
        return registry.create("backends", self._backend_name, self.rig, models=models, **self.config.backend)

    def _localize(
        self, prediction: Prediction, landmarks: LandmarkRows, features: StereoFeatures
    ) -> tuple[Prediction, LandmarkMatches]:
        """Landmarks in this frame (paper A, III and IV); a new prediction where the camera was carried off."""
        positions = self.backend.positions(landmarks.ids)
        doubtful = self._tracking.unmatched > 0
        found = self._localizer.localize(prediction, landmarks, positions, features, self._index, doubtful)
        T, a = found.T_world_left, self.config.association
        if T is None or jump(prediction, T) <= (a.lost_jump if doubtful else a.max_jump):
            self._carried = PoseHypotheses()
            return prediction, found
        self._carried = self._carried.after(T, features.stamp, self.config.models)
        if self._carried.count < a.kidnapped_after or not self._can_restart:
            return prediction, LandmarkMatches.nothing()
        prediction = self._restart(T, features.stamp)
        return prediction, self._localizer.localize(prediction, landmarks, positions, features, self._index)

    def _restart(self, T_world_left: Array, stamp: float) -> Prediction:
        """A new back end in the same map: a motion that a carried camera did not make would spoil the old one's."""
        new = self._new_backend(T_world_left)
        self._past.append(transfer_landmarks(self.backend, new))
        self.backend, self._carried = new, PoseHypotheses()
        self.restarted.append(self._index)
        self.objects.restart()
        return self.backend.predict(stamp)

    def _tracked(
        self, prediction: Prediction, features: StereoFeatures, found: LandmarkMatches, report: UpdateReport
    ) -> Tracking:
        """Whether the pose was measured; a lost camera must localize more than a tracked one.

        Where the back end uses only the smaller part of the landmarks that agree with each other, it does not agree.
        """
        c = self.config
        least = c.association.minimum_consistent if self._tracking.lost else _MINIMUM_TRACKED
        vague = median_deviation(prediction) > c.association.tight_window
        recognised = len(report.used) >= least and 2 * len(report.used) >= len(found)
        return self._tracking.after(recognised, vague, int(features.has_stereo.sum()), c.map)

    def _status(self, report: UpdateReport, added: int) -> tuple[FrameStatus, str]:
        if report.status is UpdateStatus.FAILED:
            return FrameStatus.FAILED, report.reason
        if not self._tracking.unmatched:
            return FrameStatus.TRACKED, ""
        if self._keeper.next_id == added:
            return (FrameStatus.STARTED, "") if added else (FrameStatus.PREDICTED, "nothing to see yet")
        reason = report.reason or f"only {len(report.used)} landmarks recognised"
        return (FrameStatus.LOST if self._tracking.lost else FrameStatus.PREDICTED), reason


def _landmark_ids(features: StereoFeatures, found: LandmarkMatches) -> IdArray:
    """Id of the landmark that each feature was recognised as (N,), −1 for none."""
    ids = np.full(len(features), -1, np.int64)
    ids[found.rows] = found.ids
    return ids


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
