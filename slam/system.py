"""The system: one step of stereo SLAM, with any front end and any back end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import overload

import numpy as np

from slam import registry
from slam.calibration import RemainingRigError, Revision, SavedCalibration, SelfCalibration
from slam.config import SystemConfig
from slam.data import Estimate, FrameResult, IdArray, Prediction, StereoFeatures, StereoFrame, UpdateReport
from slam.errors import ConfigurationError, MeasurementError, SlamError
from slam.extraction import Extracted, Extractor, as_frame
from slam.geometry.arrays import isin
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend, Frontend, RestingBackend
from slam.landmarks import LandmarkTable
from slam.mapping.atlas.atlas import Atlas, TrackingGap
from slam.mapping.atlas.loop_closer import LoopCloser
from slam.mapping.map_io import FIRST_FRAME, SavedMap
from slam.mapping.mapper import MapChange, Mapper
from slam.mapping.relocalizer import Relocalizer
from slam.mapping.step import AssociatedFrame, Completed, Step
from slam.objects.modes import ObjectDetector, detector_for
from slam.results import frame_result
from slam.runtime.blas import one_blas_thread
from slam.runtime.memory import keep_freed_memory
from slam.runtime.one_thread import OneThread
from slam.runtime.prefetch import prefetch
from slam.runtime.stages import Stages
from slam.showing import count
from slam.third_party import named_failures
from slam.tracking.feature_check import usable
from slam.tracking.input_warnings import REPEATED
from slam.tracking.localizer import LandmarkMatches, Localizer
from slam.tracking.patch_alignment import Aligner, PatchAnchors
from slam.tracking.protocol_check import require_estimate, require_positions, require_prediction, require_report
from slam.tracking.standing import Standing
from slam.tracking.state import TrackingState
from slam.version import __version__


def _require_types(
    rig: StereoRig, config: SystemConfig | None, prior_map: SavedMap | None, rig_prior: SavedCalibration | None
) -> None:
    """Raise ConfigurationError if an argument of a system has another type than documented."""
    kinds: dict[str, tuple[object, type]] = {
        "rig": (rig, StereoRig), "config": (config, SystemConfig),
        "prior_map": (prior_map, SavedMap), "rig_prior": (rig_prior, SavedCalibration),
    }  # fmt: skip
    for name, (value, kind) in kinds.items():
        if not isinstance(value, kind) and (value is not None or name == "rig"):
            raise ConfigurationError(f"{name} must be a {kind.__name__}, got {type(value).__name__}")


class StereoSlam:
    """Stereo SLAM with a front end and a back end of choice.

    Use a system from one thread at a time; several systems may run in several threads, with results identical to the
    byte. A system can be pickled or copied (`copy.deepcopy`) if its parts can; the copy continues identically. The
    first system makes the process keep memory that it has freed (see `slam.runtime.memory`).

    Args:
        rig: the two cameras.
        frontend: a name (see ``frontends.names()``), an object with `Frontend`'s method, or None where features are
            given directly to `process_features`.
        backend: a name (see ``backends.names()``) or an object with `Backend`'s methods.
        kind: kind of motion, ``"handheld"`` or ``"driving"``, which chooses the default settings.
        config: all settings; overrides `kind`.
        prior_map: a map to start in (see `slam.load_map`). World coordinates are then the map's. Frames have the status
            LOST until the camera is found in it. The back end must be given by name.
        rig_prior: errors of the rig as estimated from earlier recordings (see `slam.load_calibration`). They are
            corrected from the first frame on, and their estimation continues.

    Raises:
        CalibrationError: `rig_prior` is of another rig.
        UnknownNameError: no front end or back end of this name.
        ConfigurationError: a setting is unknown or out of range.
        SlamError: the map is of another front end.

    Examples:
        >>> import slam
        >>> sequence = slam.open_sequence("synthetic:desk?frames=3")
        >>> system = slam.StereoSlam(sequence.rig, backend="ekf")
        >>> results = [system.process(frame) for frame in sequence]
    """

    @one_blas_thread
    def __init__(
        self,
        rig: StereoRig,
        frontend: str | Frontend | None = "surf",
        backend: str | Backend = "ekf",
        *,
        kind: str = "handheld",
        config: SystemConfig | None = None,
        prior_map: SavedMap | None = None,
        rig_prior: SavedCalibration | None = None,
    ) -> None:
        keep_freed_memory()
        _require_types(rig, config, prior_map, rig_prior)
        names = [name if isinstance(name, str) else None for name in (frontend, backend)]
        self.rig = rig
        c = config or SystemConfig.for_kind(kind, *names)
        if prior_map is not None and len(prior_map) > c.map.max_landmarks:  # all of it is kept
            c = replace(c, map=replace(c.map, max_landmarks=len(prior_map)))
        self.config = c
        self.frontend: Frontend | None = (
            registry.create("frontends", frontend, rig, **c.frontend)
            if isinstance(frontend, str)
            else registry.require_methods("frontends", frontend)
        )
        self.backend: Backend = (
            registry.create("backends", backend, rig, models=c.models, **c.backend)
            if isinstance(backend, str)
            else registry.require_methods("backends", backend)
        )
        self.landmarks: LandmarkTable | None = None  # of the last step that was completed
        self.calibration = SelfCalibration(rig, c.self_calibration, rig_prior)
        self.objects: ObjectDetector = detector_for(rig, c.objects, c.models)
        self.frontend_name = names[0] or ""
        self.world_frame = FIRST_FRAME if prior_map is None else prior_map.world_frame
        self._rig_error = RemainingRigError(self.calibration, c.models)
        self._localizer = Localizer(rig, c.association, c.models, c.map.lost_after)
        self._aligner = Aligner(rig, c.association.align)
        self._mapper = Mapper(rig, c.map, self._localizer, self.backend)
        self.atlas = Atlas()
        self._loop_closer = LoopCloser(rig, c.atlas, c.association, c.models, c.map.max_depth_error)
        self._relocalizer = Relocalizer(rig, c.models, names[1], c.backend, self._localizer)
        self._last = Completed()
        self._stages = Stages()
        self._extractor = Extractor(self.frontend, rig, c.models)
        self._stepping = OneThread("this system")
        self._stamp = -np.inf  # to which the back end was last advanced [s]
        if prior_map is not None:
            prior_map.require_fits(self.frontend_name)
            self._relocalizer.search_in(prior_map, self.backend)
            self.landmarks = prior_map.rows
            self.atlas = Atlas.of_earlier_run(prior_map.keyframes, prior_map.keyframe_poses, prior_map.loops)
            self._last = Completed(
                dimensions=prior_map.dimensions if len(prior_map) else None, mapped=len(prior_map) > 0
            )

    def __repr__(self) -> str:
        frontend = "no front end" if self.frontend is None else type(self.frontend).__name__
        known = 0 if self.landmarks is None else len(self.landmarks)
        done = f"{count(self._last.index + 1, 'frame')}, {count(known, 'landmark')}"
        return f"StereoSlam({frontend}, {type(self.backend).__name__}, {done})"

    @overload
    def process(self, frame: StereoFrame, /) -> FrameResult: ...
    @overload
    def process(self, left: np.ndarray, right: np.ndarray | None, stamp: float) -> FrameResult: ...
    def process(
        self, left: StereoFrame | np.ndarray, right: np.ndarray | None = None, stamp: float | None = None
    ) -> FrameResult:
        """One step from a pair of images, as a `StereoFrame` or as two arrays and their time; see `process_features`.

        Args:
            left: a frame; or the left image (H, W) or, in OpenCV's order of colours, (H, W, 3|4), uint8 or uint16.
            right: the right image, None where there is none; not with a frame.
            stamp: time [s]; not with a frame.

        Raises:
            MeasurementError: images without a stamp, or a frame with one; or as `process_features`.
            SequenceError: the images are of another type or size than the rig's.
        """
        frame = as_frame(left, right, stamp, self._last.index + 1)
        with self._stepping:
            return self._timed_step(self._extractor.extract(self.frontend, frame))

    def run(self, frames: Iterable[StereoFrame], overlap: bool = True) -> Iterator[tuple[StereoFrame, FrameResult]]:
        """Every frame with the result of its step.

        Args:
            frames: a sequence, or frames in order of time; of `slam.LiveFrames`, frames that come too late are dropped.
            overlap: read the next frame and extract its features in a second thread. The results have the same bytes;
                only the times differ.

        Raises:
            SlamError: as `process`, at the frame whose step fails.
        """
        if not isinstance(frames, Iterable):
            raise MeasurementError(f"run: frames must be a sequence of frames, got {type(frames).__name__}")
        extracted = (self._extractor.extract(self.frontend, frame) for frame in frames)
        depth = 1 if getattr(frames, "live", False) else 2  # live frames must not wait
        for found in prefetch(extracted, depth) if overlap else extracted:
            with self._stepping:
                result = self._timed_step(found)
            yield found.frame, result

    def process_features(self, features: StereoFeatures) -> FrameResult:
        """One step from features: predict, associate, update, and manage the map (paper A, III and IV; paper B, 2).

        A frame without features is no error: the pose is predicted and the status says so. A step ended by an
        exception, such as an interrupt, leaves the map unchanged (see `roll_back`), but the back end is already at the
        stamp of that frame, so continue with a later one. Self-calibration keeps what it has learnt from the frame.

        Raises:
            MeasurementError: the features are not as documented, or time does not increase. Nothing is changed then.
            SlamError: another thread is using the system; or back end or front end return something else than their
                protocols say, or raise an exception of their own, which is then the cause (`PartError`).
        """
        with self._stepping:
            return self._step(features, self._last.index + 1)

    def _timed_step(self, found: Extracted) -> FrameResult:
        """`_step` with what was found in images; the result has the time of extraction, too."""
        result = self._step(found.features, found.frame.index, found.checksum)
        if result.reason == REPEATED:
            self._extractor.warn_of_repeated(found.frame.index)
        return replace(result, milliseconds={**found.milliseconds, **result.milliseconds})

    def _step(self, features: StereoFeatures, number: int, checksum: tuple[int, int] | None = None) -> FrameResult:
        """`process_features`, in the only thread; `number` is the frame's in its sequence."""
        with self._named(f"frame {number}"):
            return self._whole_step(features, checksum)

    def _named(self, place: str) -> AbstractContextManager[None]:
        """Make exceptions of third-party parts say what failed, and where."""
        return named_failures(place, self.backend, self.frontend)

    @one_blas_thread
    def _whole_step(self, features: StereoFeatures, checksum: tuple[int, int] | None) -> FrameResult:
        """All stages of a step; what images with the checksum of the last step's show was measured in that one."""
        features = usable(features, self.rig, self._last.dimensions, self._stamp)
        self._roll_back()
        index, stages, search = self._last.index + 1, self._stages, self._relocalizer.search
        backends = len(self.restarted)
        if search is not None and not self._locate(features, index):
            self._last, self._stamp = replace(self._last, index=index, checksum=None), features.stamp
            return search.lost(index, replace(features, images=None))
        repeated = len(features) > 0 and checksum is not None and checksum == self._last.checksum
        if repeated:
            features = StereoFeatures.empty(features.stamp, features.descriptors.shape[1], features.threshold)
        with stages.stage("predict"):  # the motion model (paper A, Eq. 11)
            standing = self._last.standing.after(self.rig, self.config.models.pixel_sigma, features)
            revision, prediction, dt = self._revise(), *self._predict(features.stamp, standing)
        with stages.stage("associate"):  # landmarks in the angle of view, in size-variable windows (paper A, IV)
            seen = self._associate(prediction, features, standing, index)
        with stages.stage("update"):  # the measurement of the landmarks
            report, left_out, state = self._update(seen, dt)
            if not seen.standing.stands and self._needs_new_map(state):
                seen, report, left_out = self._begin_new_map(features, index)
        with stages.stage("estimate"):
            estimate = self._estimate_pose(report)
        with stages.stage("objects"):  # what moves, and the moving bodies' poses (paper B, 3)
            landmark = seen.matches.landmark_of(len(seen.features))
            labels = self.objects.classify(seen.features, estimate, landmark, seen.standing.witnesses)
            labels = labels.with_undecided(seen.standing.leaving(len(seen.features)))
            objects = self.objects.update(self.backend, seen.features)
        with stages.stage("manage"):  # count, erase bad landmarks, add new ones (paper A, IV)
            step = Step(
                index, seen.features, seen.prediction, seen.matches, seen.withheld, seen.withheld_rows, left_out,
                report, state, estimate, labels, checksum=checksum, repeated=repeated,
            )  # fmt: skip
            change, anchors = self._manage(seen, step)
        with stages.stage("atlas"):  # a loop closure corrects the path
            step, atlas, change = self._close_loops(step, change)
        common = self._rig_error.common(as_given=True)
        result = frame_result(step, change, objects, self._last.mapped, revision, stages.milliseconds, atlas, common)
        # Commit the step in one statement, so that an interrupt finds all of it done or nothing.
        self._last, self.landmarks, self.atlas, self._stages = (
            self._last.after(step, len(change.added), anchors, seen.standing, len(self.restarted) > backends),
            change.landmarks, atlas, Stages(),
        )  # fmt: skip
        return result

    def _predict(self, stamp: float, standing: Standing) -> tuple[Prediction, float]:
        """The back end's prediction for a time, and the time since the last one [s]."""
        if standing.stands and isinstance(self.backend, RestingBackend):
            prediction = self.backend.predict_at_rest(stamp)
        else:
            prediction = self.backend.predict(stamp)
        require_prediction(prediction, self.backend)
        dt, self._stamp = stamp - self._stamp, stamp
        return prediction, dt

    def _associate(
        self, prediction: Prediction, features: StereoFeatures, standing: Standing, index: int
    ) -> AssociatedFrame:
        """Match landmarks with features, and align the features if the front end can."""
        corrected = self.calibration.correct(features)
        landmarks = self.landmarks or LandmarkTable.empty(features.descriptors.shape[1])
        if standing.stands:
            standing, matches = self._at_rest(standing, prediction, landmarks, corrected, index)
        if not standing.stands:
            landmarks, prediction, matches = self._localize(prediction, landmarks, corrected, index)
        anchors, places = self._last.anchors, self.backend.positions
        aligned = self._aligner.align(self.frontend, anchors, features, matches, landmarks, places)
        if aligned.features is not features:
            corrected = self.calibration.correct(aligned.features)
        corrected = replace(corrected, images=None)
        held = self._moving(corrected, landmarks, matches, prediction, standing, index)
        rows = matches.rows[isin(matches.ids, held)]
        return AssociatedFrame(aligned, corrected, landmarks, prediction, matches.without(held), held, rows, standing)

    def _at_rest(
        self, standing: Standing, prediction: Prediction, landmarks: LandmarkTable, features: StereoFeatures, index: int
    ) -> tuple[Standing, LandmarkMatches]:
        """Whether the camera stands in spite of the pose on which landmarks agree; then matches of what stays."""
        positions, sigma = self._positions(landmarks.ids), self.config.models.pixel_sigma
        found = self._localizer.match(prediction, landmarks, positions, features, index)
        if found.T_world_left is not None:
            standing = standing.contested(self.rig, sigma, features, found.rows, found.T_world_left)
        if 2 * isin(found.rows, standing.witnesses).sum() > len(found):
            return standing, found
        at, witnessed = standing.T_world_left, standing.witnessed(features)
        found = self._localizer.match_around(at, prediction, landmarks, positions, witnessed, index)
        return standing, replace(found, rows=standing.witnesses[found.rows])

    def _moving(
        self, features: StereoFeatures, landmarks: LandmarkTable, matches: LandmarkMatches, prediction: Prediction,
        standing: Standing, index: int,
    ) -> IdArray:  # fmt: skip
        """Ids of matched landmarks that may move; while the camera stands, all that do not stay where they are."""
        if standing.stands:
            return matches.ids[~isin(matches.rows, standing.witnesses)]
        pose = prediction.T_world_left if matches.T_world_left is None else matches.T_world_left
        ages = index - landmarks.last_seen[landmarks.rows(matches.ids)]
        moving = self.objects.newly_moving(features, matches.ids, matches.rows, ages, self._positions, pose)
        return np.union1d(self.objects.suspects, moving)

    def _update(self, seen: AssociatedFrame, dt: float) -> tuple[UpdateReport, IdArray, TrackingState]:
        """Update the back end: its report, the ids of landmarks left out of the update, and the tracking state."""
        positions = self._positions(seen.matches.ids)
        asked, left_out = self._localizer.informative(seen.prediction, seen.matches, positions, dt)
        report = self.backend.update(asked.observations(seen.features), asked.T_world_left)
        require_report(report, self.backend)
        state = self._localizer.state_after(self._last.state, seen.prediction, seen.features, asked, report)
        self.calibration.observe(replace(seen.aligned.features, images=None), seen.pose)
        return report, left_out, state

    def _estimate_pose(self, report: UpdateReport) -> Estimate:
        """The camera's pose after an update; the rig's uncertainty is propagated to it."""
        estimate = require_estimate(self.backend.estimate(landmarks=False), self.backend)
        self._rig_error.uncertainty.observe(
            estimate.T_world_left, estimate.stamp, report.used, self._positions(report.used)
        )
        return estimate

    def _manage(self, seen: AssociatedFrame, step: Step) -> tuple[MapChange, PatchAnchors]:
        """Change the map after a frame: the change, and the landmarks' image patches."""
        change = self._mapper.update(self.backend, seen.landmarks, step)
        T = step.estimate.T_world_left
        anchors = self._aligner.anchored(self.frontend, seen.aligned, seen.matches, change.added, T)
        if self.landmarks is not None and not len(seen.landmarks):  # left behind: a new map was started
            change = replace(change, erased=np.concatenate([self.landmarks.ids, change.erased]))
        new = change.added.ids[~isin(change.added.ids, change.erased)]
        self._rig_error.uncertainty.change(new, self._positions(new), change.erased)
        return change, anchors

    def _positions(self, ids: IdArray) -> np.ndarray:
        """Landmarks' positions (N, 3) [m] in the world."""
        return require_positions(self.backend.positions(ids), ids, self.backend)

    def _close_loops(self, step: Step, change: MapChange) -> tuple[Step, Atlas, MapChange]:
        """The step with the rig's uncertainty added, the atlas, and the map, to which a loop returns old landmarks."""
        estimate, common = self._rig_error.added_to(step.estimate), self._rig_error.common(as_given=False)
        step = replace(step, estimate=estimate, common=common, correction=self.calibration.applied)
        atlas, seen_again = self._loop_closer.update(self.atlas, step, change.added, self._path)
        if seen_again is not None:
            change = self._mapper.restore(self.backend, change, step, seen_again)
            back = np.sort(change.returned.ids)
            self._rig_error.uncertainty.replace_landmarks(back, self._positions(back))
        return step, atlas, change

    @one_blas_thread
    def roll_back(self) -> None:
        """After a step that an exception ended: undo its changes of the map, in the back end as well.

        Landmarks that it added are removed; those that it had removed from the back end leave the map. The camera's
        estimate stays as the step left it. Bodies are forgotten if their detector was interrupted. The next step,
        `estimate` and `snapshot` do this by themselves; without such an exception there is nothing to do.
        """
        with self._stepping, self._named("taking a step back"):
            self._roll_back()

    def _roll_back(self) -> None:
        """`roll_back`, in the only thread."""
        stage = self._stages.current
        if stage in ("associate", "objects"):
            self.objects.restart()
        if stage not in (None, "predict"):
            self.landmarks = self._mapper.reconcile(self.backend, self.landmarks)
            self._rig_error.uncertainty.keep(np.zeros(0, np.int64) if self.landmarks is None else self.landmarks.ids)
        self._stages = Stages()

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """The left camera's path: the latest estimate of each frame's pose; in a prior map, since it was found."""
        with self._stepping, self._named("the path"):
            return self.atlas.path(self._path())

    def _path(self) -> Trajectory:
        """The path by the back end, in its own frame."""
        return Trajectory.joined([*self._relocalizer.past, self.backend.trajectory()])

    @one_blas_thread
    def estimate(self) -> Estimate:
        """Pose and map with covariances."""
        with self._stepping, self._named("the estimate"):
            return self._estimate()

    def _estimate(self, of_map: bool = False) -> Estimate:
        """`estimate`, in the only thread; with `of_map`, landmarks' covariances are relative to each other."""
        self._roll_back()
        search = self._relocalizer.search
        if search is not None:
            return search.estimate(float("nan"))
        estimate = self._rig_error.added_to(require_estimate(self.backend.estimate(), self.backend))
        return self.atlas.estimate(estimate, self._rig_error.common(as_given=False), not of_map)

    @one_blas_thread
    def snapshot(self) -> SavedMap:
        """A copy of the present map; the prior map itself, as long as the camera has not been found in it.

        Raises:
            SlamError: there is no map yet.
        """
        with self._stepping, self._named("the map"):
            if self._relocalizer.search is not None:
                return self._relocalizer.search.known
            estimate = self._estimate(of_map=True) if self.landmarks is not None else None
            if estimate is None or self.landmarks is None:
                raise SlamError("there is no map yet: no frame was processed")
            rows = self.landmarks.moved(self.atlas.T_map_odom)
            keyframes = (k.corrected(self.calibration.applied, self.rig.rectified.rig) for k in self.atlas.keyframes)
            atlas = replace(self.atlas, keyframes=tuple(keyframes))
            return SavedMap.of(rows, estimate, self.frontend_name, self.world_frame, __version__, atlas)

    @property
    def warnings(self) -> list[str]:
        """Warnings about images, stamps or baseline, one line each (see `slam.tracking.input_warnings`)."""
        return self._extractor.warnings

    def __getstate__(self) -> dict[str, object]:
        """State for copying and pickling; refused while another thread is in a step."""
        with self._stepping:
            return vars(self).copy()

    @property
    def restarted(self) -> list[int]:
        """Indices of the frames in which another back end took over: a kidnapped camera, or a new map."""
        return self._relocalizer.restarted

    def _revise(self) -> Revision | None:
        """Apply the present estimate of the rig's error, also to earlier measurements if the back end can."""
        change = self._rig_error.apply(self.backend)
        if change is not None:
            self.objects.revise(change.rows)
        return self._rig_error.revise(self.backend, restarted=bool(self._relocalizer.past))

    def _locate(self, features: StereoFeatures, index: int) -> bool:
        """Look for the camera in the prior map, and start the back end if it is found; returns whether it is."""
        search = self._relocalizer.search
        assert search is not None
        T, found = search.locate(features, index), None
        if T is None:
            found = self._loop_closer.find(self.atlas, features, self.calibration.applied, index)
            if found is None:
                return False
            T = found.T_odom_left
        new = self._relocalizer.start(T)
        search.fill(new)
        self._mapper.next_id = search.known.next_id
        landmarks = self.landmarks
        if found is not None:
            landmarks = self._mapper.insert(new, search.known.rows, found.place)
        self.landmarks, self.backend, self._rig_error.given, self._relocalizer.search = (
            landmarks, new, self.calibration.applied, None,
        )  # fmt: skip
        return True

    def _localize(
        self, prediction: Prediction, landmarks: LandmarkTable, features: StereoFeatures, index: int
    ) -> tuple[LandmarkTable, Prediction, LandmarkMatches]:
        """Match landmarks in this frame; if the camera was kidnapped, start a new back end first.

        If it is at a place of the atlas that is no longer in the map, landmarks of that place join the map.
        """
        positions, found = self._positions(landmarks.ids), None

        def elsewhere() -> np.ndarray | None:
            """The camera's pose by the keyframes of the atlas."""
            nonlocal found
            found = self._loop_closer.find(self.atlas, features, self.calibration.applied, index)
            return None if found is None else found.T_odom_left

        matches = self._localizer.localize(
            prediction, landmarks, positions, features, self._last.state, index, elsewhere
        )
        if not matches.kidnapped:
            return landmarks, prediction, matches
        assert matches.T_world_left is not None
        if not self._relocalizer.can_restart(self.backend):
            return landmarks, prediction, LandmarkMatches.nothing()
        new, path = self._relocalizer.restart(self.backend, matches.T_world_left)
        place = None
        if found is not None and matches.T_world_left is found.T_odom_left:
            landmarks, place = self._mapper.insert(new, landmarks, found.place), found.stamp
            positions = new.positions(landmarks.ids)
        prediction = new.predict(features.stamp)
        gap = TrackingGap(self._last.measured_at, features.stamp)
        self._take_over(new, path, self.atlas.relocalized(gap, place), index)
        return landmarks, prediction, self._localizer.match(prediction, landmarks, positions, features, index)

    def _needs_new_map(self, state: TrackingState) -> bool:
        """Whether the camera is in an unknown place, and a new back end can begin a map there."""
        unknown, enabled = state.in_unknown_place(self.config.map.restart_after), self.config.atlas.enabled
        return unknown and enabled and len(self.atlas) > 0 and self._relocalizer.can_restart(self.backend)

    def _begin_new_map(self, features: StereoFeatures, index: int) -> tuple[AssociatedFrame, UpdateReport, IdArray]:
        """Begin a new map with a new back end, and the frame again: nothing in it refers to the old one's landmarks.

        The new map's pose relative to the earlier one is as uncertain as the predicted pose, until a place of the atlas
        is seen again. The earlier landmarks remain in the atlas only.
        """
        before = self._rig_error.added_to(require_estimate(self.backend.estimate(landmarks=False), self.backend))
        new, path, prediction, report = self._relocalizer.start_new_map(self.backend, features.stamp)
        after, common = new.estimate(landmarks=False), self._rig_error.common(as_given=False)
        since, models = self._last.measured_at, self.config.models
        self._take_over(new, path, self.atlas.with_new_map(since, before, after, common, models), index)
        corrected = replace(self.calibration.correct(features), images=None)
        return AssociatedFrame.of_nothing_known(features, corrected, prediction), report, report.used

    def _take_over(self, new: Backend, path: Trajectory, atlas: Atlas, index: int) -> None:
        """Continue with a new back end; `path` is the old one's."""
        self.objects.restart()
        self._localizer.forget()
        r = self._relocalizer
        self.backend, self.atlas, self._rig_error.given, r.past, r.restarted = (
            new, atlas, self.calibration.applied, [*r.past, path], [*r.restarted, index],
        )  # fmt: skip
