"""The system: one step of stereo SLAM, with any front end and any back end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np

from slam import registry
from slam.atlas.atlas import Atlas
from slam.atlas.map_io import SavedMap
from slam.bodies.detector import MovingObjectDetector, ObjectDetector
from slam.calibration import SavedCalibration, SelfCalibration
from slam.config import SystemConfig
from slam.data import Estimate, FrameResult, Prediction, StereoFeatures, StereoFrame
from slam.errors import ConfigurationError, MeasurementError, SlamError
from slam.geometry.arrays import changed
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import transform
from slam.geometry.trajectory import Trajectory
from slam.input.extraction import Extracted, Extractor
from slam.input.features import Rectification, documented, following
from slam.input.moment import MomentWatch
from slam.input.warnings import REPEATED
from slam.interfaces import Backend, Frontend
from slam.naming import count
from slam.papers.procedure1 import Procedure1Detector
from slam.runtime.compilation import Stages
from slam.runtime.memory import keep_freed_memory
from slam.runtime.threads import OneThread, one_blas_thread, prefetch
from slam.session import Session
from slam.third_party import checked, named_failures
from slam.tracker import Elsewhere, State, Tracker, frame_result
from slam.tracks.step import Step
from slam.tracks.table import LandmarkTable

#: Types of a system's arguments.
_TYPES = {"rig": StereoRig, "config": SystemConfig, "prior_map": SavedMap, "rig_prior": SavedCalibration}


class StereoSlam:
    """Stereo SLAM with a front end and a back end of choice.

    Use a system from one thread at a time; several systems may run in several threads, with results identical to the
    byte. A system can be pickled or copied (`copy.deepcopy`) if its parts can; the copy continues identically. The
    first system makes the process keep memory that it has freed (see `slam.runtime.memory`).

    Args:
        rig: the two cameras.
        frontend: a name (see ``frontends.names()``), an object with `Frontend`'s method, or None where features are
            given directly to `process_features`.
        backend: a name (see ``backends.names()``) or an object with `Backend`'s methods, which must have been made with
            ``rig.rectified.rig``: it is given pixels of the rectified pair, and its poses are of that left camera.
        kind: kind of motion, ``"handheld"`` or ``"driving"``, which chooses the default settings; None for handheld.
        config: all settings, in place of `kind`, see `SystemConfig.for_kind`.
        prior_map: a map to start in (see `slam.load_map`). World coordinates are then the map's. Frames have the status
            LOST until the camera is found in it. The back end must be given by name.
        rig_prior: errors of the rig as estimated from earlier recordings (see `slam.load_calibration`). They are
            corrected from the first frame on, and their estimation continues.

    Attributes:
        rig, frontend, config: as given.
        calibration: the rig's error as estimated so far.
        objects: the detector of what moves.

    Raises:
        CalibrationError: `rig_prior` is of another rig.
        UnknownNameError: no front end or back end of this name.
        ConfigurationError: a setting is unknown or out of range, or `kind` and `config` are both given.
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
        kind: str | None = None,
        config: SystemConfig | None = None,
        prior_map: SavedMap | None = None,
        rig_prior: SavedCalibration | None = None,
    ) -> None:
        keep_freed_memory()
        for (name, wanted), value in zip(_TYPES.items(), (rig, config, prior_map, rig_prior)):
            if not isinstance(value, wanted) and (value is not None or name == "rig"):
                raise ConfigurationError(f"{name} must be a {wanted.__name__}, got {type(value).__name__}")
        names = [name if isinstance(name, str) else None for name in (frontend, backend)]
        self.rig = rig
        if config is not None and kind is not None:
            raise ConfigurationError(
                "kind does not go with config: settings of a kind of motion are already in it (SystemConfig.for_kind)"
            )
        c = config or SystemConfig.for_kind(kind or "handheld", names[0])
        if prior_map is not None and len(prior_map) > c.map.max_landmarks:  # all of it is kept
            c = replace(c, map=replace(c.map, max_landmarks=len(prior_map)))
        self.config = c
        if isinstance(frontend, str):
            frontend = registry.create("frontends", frontend, rig, **c.frontend)
        self._rectification = inside = Rectification(rig)
        inner = replace(c, models=inside.models(c.models))
        if c.backend and not isinstance(backend, str):
            raise ConfigurationError(f"backend.{next(iter(c.backend))}: an object is made with its options beforehand")
        if isinstance(backend, str):
            backend = registry.create("backends", backend, inside.rig, models=inner.models, **c.backend)
        self.frontend: Frontend | None = registry.require_methods("frontends", frontend)
        first: Backend = registry.require_methods("backends", backend)
        self.frontend_name = names[0] or ""
        inside.require_fits(first)
        self.calibration = SelfCalibration(rig, c.self_calibration, rig_prior)
        kinds = {"off": lambda *_: ObjectDetector(), "detect": MovingObjectDetector, "procedure1": Procedure1Detector}
        detector, restarts = kinds[c.objects.mode](inside.rig, c.objects, inner.models), names[1] is not None
        self._tracker = Tracker(inside.rig, inner, self.calibration, first, restarts, detector, self.frontend)
        self._session = Session(self._tracker, names[1])
        self._stages = Stages()
        self._extractor, self._moment = Extractor(self.frontend, rig, c.models), MomentWatch(inside.rig)
        self._stepping = OneThread("this system")
        if prior_map is not None:
            prior_map.require_fits(self.frontend_name, rig)
        self._state = self._session.begin(first, prior_map)

    @property
    def objects(self) -> ObjectDetector:
        """The detector of what moves."""
        return self._tracker.objects

    def __repr__(self) -> str:
        frontend = "no front end" if self.frontend is None else type(self.frontend).__name__
        landmarks = 0 if self.landmarks is None else len(self.landmarks)
        done = f"{count(self._state.index + 1, 'frame')}, {count(landmarks, 'landmark')}"
        return f"StereoSlam({frontend}, {type(self.backend).__name__}, {done})"

    @property
    def backend(self) -> Backend:
        """The present back end; another one takes over after a kidnapping, or in an unknown place."""
        return self._state.backend

    @property
    def landmarks(self) -> LandmarkTable | None:
        """The landmarks' bookkeeping after the last step; None before the first."""
        tracks = self._state.tracks
        return None if tracks is None else tracks.landmarks()

    @property
    def atlas(self) -> Atlas:
        """Keyframes and loops after the last step; their poses are of the rectified left camera."""
        return self._state.atlas

    @property
    def restarted(self) -> list[int]:
        """Indices of the frames in which another back end took over: a kidnapped camera, or a new map."""
        return list(self._state.restarted)

    @one_blas_thread
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
        if not isinstance(left, StereoFrame):
            if stamp is None:
                raise MeasurementError("process: two images need their time [s]: process(left, right, stamp)")
            left = StereoFrame(self._state.index + 1, stamp, left, right)
        elif right is not None or stamp is not None:
            raise MeasurementError("process: a frame has its right image and its stamp already")
        with self._stepping:
            return self._timed_step(self._extractor.extract(self.frontend, left))

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
        extractions = (self._extractor.extract(self.frontend, frame) for frame in frames)
        depth = 1 if getattr(frames, "live", False) else 2  # live frames must not wait
        for extracted in prefetch(extractions, depth) if overlap else extractions:
            with self._stepping:
                result = self._timed_step(extracted)
            yield extracted.frame, result

    def process_features(self, features: StereoFeatures) -> FrameResult:
        """One step from features: predict, associate, update, and manage the map (paper A, III and IV; paper B, 2).

        A frame without features is no error: the pose is predicted and the status says so. A step ended by an
        exception, such as an interrupt, leaves the map unchanged, but for landmarks that it had removed already, and
        forgets moving bodies. The back end is already at the stamp of that frame, so continue with a later one.
        Self-calibration keeps what it has learnt from the frame.

        Raises:
            MeasurementError: the features are not as documented, or time does not increase. Nothing is changed then.
            SlamError: another thread is using the system; or back end or front end return something else than their
                protocols say, or raise an exception of their own, which is then the cause (`PartError`).
        """
        with self._stepping, self._named(f"frame {self._state.index + 1}"):
            return self._process(documented(features, self.rig), None)

    def _timed_step(self, extracted: Extracted) -> FrameResult:
        """A step with what was found in images; the result has the time of extraction, too."""
        with self._named(f"frame {extracted.frame.index}"):
            result = self._process(extracted.features, extracted.checksum)
        if result.reason == REPEATED:
            self._extractor.input_warnings.note_repeated(extracted.frame.index)
        return changed(result, milliseconds={**extracted.milliseconds, **result.milliseconds})

    def _named(self, place: str) -> AbstractContextManager[None]:
        """Make exceptions of third-party parts say what failed, and where."""
        return named_failures(place, self.backend, self.frontend)

    def _step(
        self, state: State, features: StereoFeatures, repeated: bool, begun: Prediction | None = None
    ) -> tuple[Step, Atlas] | Elsewhere:
        """The way of a frame from its features, as measured, to the map, beside the state before the frame.

        Images that come again, `repeated` byte for byte or compressed anew, show nothing that was not measured before.
        `begun` is the prediction of a back end that takes over in this frame, at a pose that is believed.
        """
        stage, t = self._stages.stage, self._tracker
        with stage("predict"):  # the motion model advances the camera's pose (paper A, Eq. 11), unless it stands
            standing, prediction = (state.standing, begun) if begun else t.predict(state, features)
            if not begun and t.came_again(state, standing, prediction):
                repeated, features, standing = True, _nothing_of(features), standing.unseen()
        with stage("associate"):  # correct features, find landmarks (paper A, IV): `slam.tracks.localizer`
            step = t.associate(state, features, standing, prediction)
            if isinstance(step, Elsewhere):  # a kidnapped camera, found elsewhere in the map: `slam.session`
                return step
            step = changed(step, repeated=repeated)
        with stage("update"):  # the landmarks' pixels correct pose and map
            step = t.update(state, step)
            if isinstance(step, Elsewhere):  # the place is unknown: a new map begins, see `slam.session`
                return step
        with stage("estimate"):  # the pose; the calibration learns from the one on which the matches agree
            step = t.estimate(state, step)
        with stage("objects"):  # which features may move or do; moving bodies (paper B, 3): `slam.bodies.detector`
            step = t.classify(state, step)
        with stage("manage"):  # count, erase and add landmarks (paper A, IV): `slam.tracks.mapper`
            step = t.manage(state, step)
        with stage("atlas"):  # the frame may become a keyframe, a loop corrects the path: `slam.atlas`
            return t.close_loops(state, step)

    @one_blas_thread
    def _process(self, features: StereoFeatures, checksum: tuple[int, int] | None) -> FrameResult:
        """A step, made again as a whole where another back end takes over; its state then replaces the last one's."""
        features = following(features, self._state.dimensions, self._tracker.advanced)
        features, out = self._rectification.features_in(features), self._rectification.result_out
        self._roll_back()
        state, session, tracker = self._state, self._session, self._tracker
        if state.prior_map is not None:
            located = session.found_in_prior_map(state, features)
            if located is None:
                self._state, result = session.not_found(state, features)
                tracker.advanced = features.stamp
                return out(result)
            state = located
        repeated = len(features) > 0 and checksum is not None and checksum == state.checksum
        sigma, standing = self.config.models.pixel_sigma, state.standing
        features = _nothing_of(features) if repeated else standing.without_fastened(sigma, features)
        state = session.at_first_sight(state, features)
        with self._stages.stage("predict"):
            revision = tracker.revise(state)
        done = self._step(state, features, repeated)
        if isinstance(done, Elsewhere):  # another back end begins there, in the map or in a new one
            state, begun = session.taken_over(state, done, features)
            self.objects.restart()
            done = self._step(state, features, repeated, begun)
            assert not isinstance(done, Elsewhere)  # a back end that takes over is believed
        step, atlas = done
        if state is not self._state:
            step = session.with_takeover(self._state, state, step)
        common = tracker.rig_error.common(state.backend, as_reported=True)
        result = frame_result(step, atlas, state.ever_mapped, revision, self._stages.milliseconds, common)
        self._moment.add(features, step.estimate.T_world_left, result.status.measured)
        self._state, self._stages = state.after(step, atlas, checksum), Stages()
        return out(result)

    def _roll_back(self) -> None:
        """After a step that an exception ended: table and back end hold the same landmarks again."""
        if self._stages.begun:
            self._state, self._stages = self._tracker.roll_back(self._state), Stages()

    @one_blas_thread
    def trajectory(self) -> Trajectory:
        """The left camera's path: the latest estimate of each frame's pose; in a prior map, since it was found."""
        with self._stepping, self._named("the path"):
            return self._rectification.path_out(self.atlas.path(self._state.path()))

    @one_blas_thread
    def estimate(self) -> Estimate:
        """Pose and map with covariances."""
        with self._stepping, self._named("the estimate"):
            return self._rectification.estimate_out(self._estimate())

    def _estimate(self, of_map: bool = False) -> Estimate:
        """`estimate`, in the only thread; with `of_map`, landmarks' covariances are relative to each other."""
        self._roll_back()
        if self._state.prior_map is not None:
            return self._session.map_estimate(self._state, float("nan"))
        estimate, error = checked(self.backend, "estimate", self.backend.estimate()), self._tracker.rig_error
        common = error.common(self.backend, as_reported=False)
        return self.atlas.estimate(error.added_to(self.backend, estimate), common, not of_map)

    @one_blas_thread
    def snapshot(self) -> SavedMap:
        """A copy of the present map; the prior map itself, as long as the camera has not been found in it.

        Raises:
            SlamError: there is no map yet.
        """
        with self._stepping, self._named("the map"):
            if self._state.prior_map is not None:
                return self._state.prior_map
            if self._state.tracks is None:
                raise SlamError("there is no map yet: no frame was processed")
            estimate = self._estimate(of_map=True)
            rows = self._state.tracks.landmarks()
            rows = replace(rows, seen_from=transform(self.atlas.T_map_odom, rows.seen_from))
            keyframes = (k.corrected(self.calibration.applied, self._tracker.rig) for k in self.atlas.keyframes)
            atlas = replace(self.atlas, keyframes=tuple(keyframes))
            return SavedMap.of(rows, estimate, self.frontend_name, atlas, self.rig)

    @property
    def warnings(self) -> list[str]:
        """Warnings about images, stamps, baseline or calibration, one line each (see `slam.input`)."""
        said, doubt = self._extractor.input_warnings, self.doubt or self.calibration.warning
        lines = [*said.lines, *filter(None, [said.repeated])]
        return lines if doubt in ("", *lines) else [*lines, doubt]

    @property
    def doubt(self) -> str:
        """Why no path by these images can be trusted, one of the `warnings`; empty where nothing says so."""
        return self._extractor.input_warnings.doubt or self._moment.doubt or self.calibration.doubt

    def __getstate__(self) -> dict[str, object]:
        """State for copying and pickling; refused while another thread is in a step."""
        with self._stepping:
            return vars(self).copy()


def _nothing_of(features: StereoFeatures) -> StereoFeatures:
    """No features, at the same time and of the same front end."""
    return StereoFeatures.empty(features.stamp, features.descriptors.shape[1], features.threshold)
