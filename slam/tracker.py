"""The parts of a system and the stages of a step, each a function of the frame in work; `slam.system` orders them.

`State` is what a step starts from and leaves behind. A step builds a new one beside it, which takes its place at the
end. After a step that an exception ended, `Tracker.roll_back` makes table and back end hold the same landmarks again,
and bodies are forgotten; what the back end has learnt in that step stays in its estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from slam.atlas.atlas import Atlas
from slam.atlas.loop_closer import Found, LoopCloser
from slam.atlas.map_io import SavedMap
from slam.bodies.detector import ObjectDetector
from slam.bodies.estimator import FRAMES
from slam.calibration import RemainingRigError, SelfCalibration
from slam.calibration.estimator import SIGNIFICANT
from slam.config import SystemConfig
from slam.data import (
    CommonError,
    Estimate,
    FrameResult,
    FrameStatus,
    IdArray,
    Prediction,
    Revision,
    StereoFeatures,
    UpdateReport,
    UpdateStatus,
)  # fmt: skip
from slam.geometry.arrays import Array, changed, isin
from slam.geometry.rig import MINIMAL_POINTS, StereoRig
from slam.geometry.se3 import inverse, twice
from slam.geometry.trajectory import Trajectory
from slam.input.warnings import REPEATED
from slam.interfaces import AligningFrontend, Backend, Frontend, MapBackend, RestingBackend, RevisingBackend
from slam.object_data import MovingObject
from slam.third_party import OnlinePose, checked, recent_of
from slam.tracks.alignment import Aligner, shifted_as
from slam.tracks.localizer import Localizer, Search, jump, median_deviation
from slam.tracks.mapper import Mapper
from slam.tracks.standing import Standing
from slam.tracks.step import HIDDEN, LandmarkMatches, Step, TrackingState
from slam.tracks.table import Tracks

NEW_MAP = "the place is not in the map: a new map begins"


@dataclass(frozen=True, eq=False)
class State:
    """What a step starts from and leaves behind; a step replaces it as a whole, in one assignment at its end."""

    backend: Backend  # holds the estimate; see `Mapper.reconcile` for what an interrupted step left in it
    tracks: Tracks | None = None  # the table of all that is followed or in the map; None before the first frame
    atlas: Atlas = field(default_factory=Atlas)  # keyframes and loops
    index: int = -1  # of the last frame
    tracking: TrackingState = field(default_factory=TrackingState)  # how localization has gone
    standing: Standing = field(default_factory=Standing)  # whether the camera stands
    dimensions: int | None = None  # length of the descriptors; None before the first feature
    ever_mapped: bool = False  # whether there ever were landmarks enough to measure a pose
    measured_at: float = -np.inf  # time of the last frame whose pose was measured, or in which a new map began [s]
    checksum: tuple[int, int] | None = None  # of the images; None without images, or of images that show nothing
    # in which the camera has not been found yet; None without one, or once it is found
    prior_map: SavedMap | None = None
    online: tuple[OnlinePose, ...] = ()  # the last poses of the present back end, as estimated in their time
    past: tuple[Trajectory, ...] = ()  # the paths of all back ends before the present one
    restarted: tuple[int, ...] = ()  # indices of the frames in which another back end took over

    def begins_at(self, index: int) -> bool:
        """Whether the back end takes over in this frame."""
        return index in self.restarted[-1:]

    def after(self, step: Step, atlas: Atlas, checksum: tuple[int, int] | None) -> State:
        """The state after one more frame."""
        located = not step.tracking.unmeasured or not self.ever_mapped or self.begins_at(step.index)
        seen_at = self.standing.T_world_left if step.repeated else step.estimate.T_world_left
        return changed(
            self, tracks=step.tracks, atlas=atlas, index=step.index, tracking=step.tracking, online=step.online,
            standing=changed(step.standing, T_world_left=seen_at),
            checksum=checksum, ever_mapped=self.ever_mapped or len(step.tracks.mapped) >= MINIMAL_POINTS,
            dimensions=step.features.descriptors.shape[1] if len(step.features) else self.dimensions,
            measured_at=step.features.stamp if located else self.measured_at,
        )  # fmt: skip

    def path(self) -> Trajectory:
        """The path by all back ends so far, in their frame."""
        return reduce(Trajectory.joined, [*self.past, checked(self.backend, "trajectory", self.backend.trajectory())])


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """Why a step ended early: the camera is not where the back end has it, so that another one must take over."""

    # the pose (4, 4) at which the camera was found; None in an unknown place, where a new map begins
    T_world_left: Array | None
    # the place of the atlas by which it was found; None if it was found by the map's landmarks
    place: Found | None = None


class Tracker:
    """The parts of a system, and the stages of a step.

    With `restarts` another back end of its kind can take over. The front end made the features; those of landmarks are
    aligned with earlier images if it can do that.
    """

    def __init__(
        self, rig: StereoRig, config: SystemConfig, calibration: SelfCalibration, backend: Backend, restarts: bool,
        objects: ObjectDetector, frontend: Frontend | None,
    ) -> None:  # fmt: skip
        c = config
        self.rig, self.config, self.calibration, self.objects = rig, c, calibration, objects
        self.rig_error = RemainingRigError(calibration)
        self.localizer = Localizer(rig, c.association, c.models)
        self.mapper = Mapper(rig, c.map, self.localizer, backend)
        self.loop_closer = LoopCloser(rig, c.atlas.enabled, c.association, c.models, c.map.max_depth_error)
        self._can_restart = restarts and isinstance(backend, MapBackend)
        self.advanced = -np.inf  # stamp to which a back end was last advanced [s]; an interrupted step counts
        self._aligner: Aligner | None = None
        if c.association.align and isinstance(frontend, AligningFrontend):
            self._aligner = Aligner(rig, frontend)

    def find(self, state: State, features: StereoFeatures) -> Found | None:
        """The camera's pose by the keyframes of the atlas."""
        return self.loop_closer.find(state.atlas, features, self.calibration.applied, state.index + 1)

    def revise(self, state: State) -> Revision | None:
        """Apply the present estimate of the rig's error, also to earlier measurements if the back end can."""
        change = self.calibration.apply(SIGNIFICANT if isinstance(state.backend, RevisingBackend) else 0.0)
        if change is not None and state.tracks is not None:
            self.objects.revise(state.tracks, change.rows)
        return self.rig_error.revise(state.backend, restarted=bool(state.restarted))

    def predict(self, state: State, features: StereoFeatures) -> tuple[Standing, Prediction]:
        """Whether the camera stands, and the back end's prediction for the time of the features."""
        models = self.config.models
        standing = state.standing.after(self.rig, models.pixel_sigma, features, models.motion.wheels)
        at_rest = standing.stands and isinstance(state.backend, RestingBackend)
        ask = state.backend.predict_at_rest if at_rest else state.backend.predict  # type: ignore[attr-defined]
        prediction: Prediction = checked(state.backend, "predict", ask(features.stamp))
        self.advanced = features.stamp
        return standing, prediction

    def came_again(self, state: State, standing: Standing, prediction: Prediction) -> bool:
        """Whether the images are earlier ones, compressed anew: features stay, as of a stop that no camera makes."""
        c = self.config.association
        farthest = c.lost_jump if state.tracking.unmeasured else c.max_jump
        return standing.frames > 0 and jump(prediction, standing.T_world_left) > farthest

    def associate(
        self, state: State, features: StereoFeatures, standing: Standing, prediction: Prediction
    ) -> Step | Elsewhere:
        """Match landmarks with features, and align the features with earlier images."""
        corrected, place = self.calibration.correct(features), None
        tracks = state.tracks
        if tracks is None or (tracks.descriptors.shape[1] != features.descriptors.shape[1] and not len(tracks.mapped)):
            tracks = Tracks.empty(features.descriptors.shape[1])
        tracks = tracks.begun(len(features.scale), self.objects.window)
        landmarks, backend = tracks.landmarks(), state.backend
        positions = checked(backend, "positions", backend.positions(landmarks.ids), n=len(landmarks.ids))

        def elsewhere() -> Array | None:
            nonlocal place
            place = self.find(state, corrected)
            return None if place is None else place.T_odom_left

        localizer, index, tracking = self.localizer, state.index + 1, state.tracking
        search = Search(localizer, prediction, landmarks, positions, corrected, index)
        if state.begins_at(index):
            matches = search.match()
        else:
            matches, tracking, standing = search.follow(tracking, standing, elsewhere)
        if matches.kidnapped:
            if self._can_restart:
                return Elsewhere(matches.T_world_left, place)
            matches = LandmarkMatches.nothing()
        tracks.count_returning(matches.returning)
        aligned, T = features, matches.T_world_left
        if self._aligner is not None and T is not None:  # else they do not agree
            where, at = positions[landmarks.rows(matches.ids)], tracks.rows(matches.ids)
            aligned = self._aligner.align(features, matches.rows, tracks, at, T, where)
            corrected = shifted_as(corrected, features, aligned)
        step = Step(index, aligned, changed(corrected, images=None), prediction, tracks, matches, standing, tracking)
        suspects = self._suspects(step)
        matches = matches.select(~isin(matches.ids, suspects))
        tracks.set_features(tracks.rows(matches.ids), matches.rows)
        return changed(step, matches=matches, suspects=suspects)

    def _suspects(self, step: Step) -> IdArray:
        """Ids of landmarks that may move; while the camera stands, all matched ones that do not stay where they are."""
        ids, rows = step.matches.ids, step.matches.rows
        if step.standing.stands:
            return ids[~isin(rows, step.standing.witnesses)]
        at = step.tracks.rows(ids)
        parting = self.objects.parting(step.tracks, step.features, at, rows, step.pose)
        return np.union1d(self.objects.suspects, parting)

    def update(self, state: State, step: Step) -> Step | Elsewhere:
        """Update the back end; `Elsewhere` in an unknown place.

        The pose was not measured if the back end used less than half of the landmarks that agree with each other; a
        lost camera must match more landmarks than a tracked one. Once measured, the pose of a camera that stands holds.
        """
        matches, standing, before, c = step.matches, step.standing, step.tracking, self.config
        observations, pose = matches.observations(step.features), matches.T_world_left
        # A camera that stands measures the same landmarks with the same errors again, which tells nothing new.
        holds = standing.stands and not before.unmeasured and isinstance(state.backend, RestingBackend)
        if holds:
            observations, pose = observations.select(np.zeros(0, np.intp)), None
        report: UpdateReport = checked(state.backend, "update", state.backend.update(observations, pose))
        if holds and len(matches.ids) and report.status is not UpdateStatus.FAILED:
            report = replace(report, status=UpdateStatus.OK, reason="", used=matches.ids)
        least = c.association.minimum_consistent if before.lost else MINIMAL_POINTS
        measured = len(report.used) >= least and 2 * len(report.used) >= len(matches.ids)
        uncertain, stereo = False, 0  # asked where the pose was not measured
        if not measured:
            uncertain = median_deviation(step.prediction) > c.association.tight_window
            # A pose that agrees with the last frame's, but awaits a third one, does not show an unknown place.
            stereo = 0 if before.doubted.count > 1 else int(step.features.has_stereo.sum())
        tracking = before.after(measured, standing.stands, uncertain, stereo, c.map.lost_after)
        if state.begins_at(step.index):
            report = replace(report, reason=report.reason if len(step.tracks.mapped) else NEW_MAP)
        elif (
            tracking.in_unknown_place(c.map.restart_after) and not standing.holds(tracking.lost)
            and c.atlas.enabled and len(state.atlas) > 0 and self._can_restart
        ):  # fmt: skip
            return Elsewhere(None)
        return changed(step, report=report, tracking=tracking)

    def estimate(self, state: State, step: Step) -> Step:
        """The camera's pose after an update; the rig's calibration learns from the frame."""
        self.calibration.observe(changed(step.measured, images=None), step.pose)
        estimate: Estimate = checked(state.backend, "estimate", state.backend.estimate(landmarks=False))
        rows, f = step.matches.rows[isin(step.matches.ids, step.report.used)], step.features
        online = OnlinePose.seen(self.rig, self.config.models.pixel_sigma, estimate, f.uv_left[rows], f.uv_right[rows])
        path = (*state.online[-FRAMES:], online)
        return changed(step, estimate=estimate, online=path, recent=recent_of(state.backend, path))

    def classify(self, state: State, step: Step) -> Step:
        """Which features move, and the moving bodies."""
        features, standing = step.features, step.standing
        labels, objects = self.objects.step(
            step.recent, step.tracks, features, step.estimate, standing.witnesses, step.measured, self._aligner
        )
        if standing.stands:  # a feature that does not stay is undecided, unless it moves
            leaving = np.setdiff1d(np.arange(len(features)), standing.witnesses)
            undecided = np.setdiff1d(np.union1d(labels.undecided, leaving), labels.moving)
            labels = changed(labels, undecided=undecided)
        return changed(step, labels=labels, objects=objects)

    def manage(self, state: State, step: Step) -> Step:
        """Change the map, and remember the image patches of new landmarks."""
        step = self.mapper.update(state.backend, step)
        if self._aligner is not None:
            seen, T = step.matches.joined(step.added), step.estimate.T_world_left
            seen = seen.select(isin(seen.ids, step.tracks.ids))
            self._aligner.take_patches(step.measured, seen.rows, step.tracks, step.tracks.rows(seen.ids), T)
        return step

    def close_loops(self, state: State, step: Step) -> tuple[Step, Atlas]:
        """The step, its pose with the rig's uncertainty, and the atlas after it, with a keyframe more where one is due.

        The frame becomes a keyframe where its view differs; a loop corrects the path.
        """
        rig_error, backend = self.rig_error, state.backend
        estimate, common = rig_error.added_to(backend, step.estimate), rig_error.common(backend, as_reported=False)
        step = changed(step, estimate=estimate, common=common, correction=self.calibration.applied)
        return step, self.loop_closer.update(state.atlas, step)

    def roll_back(self, state: State) -> State:
        """The state after an interrupted step: landmarks that only table or back end has go, bodies are forgotten."""
        self.objects.restart()
        if state.prior_map is not None or not np.isfinite(self.advanced):  # that back end has not begun
            return state
        return replace(state, tracks=self.mapper.reconcile(state.backend, state.tracks))


def frame_result(
    step: Step, atlas: Atlas, mapped_before: bool, revision: Revision | None, milliseconds: Mapping[str, float],
    common: CommonError,
) -> FrameResult:  # fmt: skip
    """The result of a step.

    `mapped_before` says whether there ever was a landmark before; `revision` is the change of earlier pixels'
    correction before the step, `common` the part of the pose's error that it shares with the poses reported in other
    frames.
    """
    objects = step.objects
    if atlas.loops:
        objects = tuple(_in_map(thing, atlas.T_map_odom) for thing in objects)
    status, reason = _status(step, mapped_before)
    loop, refused_loop = atlas.partners(step.index)
    estimate, common = atlas.estimate(step.estimate, step.common), common if atlas.anchor is None else CommonError()
    if atlas.anchor is None:  # the pose as reported has another error by the rig than in the present path
        covariance = estimate.covariance + common.covariance - step.common.covariance
        estimate = changed(estimate, covariance=0.5 * (covariance + covariance.T))
    estimate = changed(estimate, T_world_left=estimate.T_world_left.copy())  # the caller may write into it
    return FrameResult(
        step.index, status, reason, estimate, step.report, step.features,
        len(step.prediction.ids), step.matches.ids, step.matches.rows, step.added.ids, step.added.rows, step.erased,
        len(step.tracks.mapped), dict(milliseconds), step.labels.moving, objects, revision=revision,
        T_map_odom=atlas.T_map_odom.copy(), loop=loop, refused_loop=refused_loop,
        keyframe=bool(atlas.keyframes) and atlas.keyframes[-1].frame == step.index,
        returned=step.joined,
        common=common,
        recent=step.recent if atlas.anchor is None else None,  # else the estimate's errors are of another world
    )  # fmt: skip


def _in_map(thing: MovingObject, T_map_odom: Array) -> MovingObject:
    """A body in the map's coordinates; of its covariances only the velocity's changes, the pose's is in body axes."""
    e, R = thing.estimate, twice(T_map_odom[:3, :3])
    motion, since = (T_map_odom @ T @ inverse(T_map_odom) for T in (thing.motion, thing.motion_since_found))
    pose, P = T_map_odom @ e.T_world_object, R @ e.velocity_covariance @ R.T
    estimate = replace(e, T_world_object=pose, velocity=R @ e.velocity, velocity_covariance=P)
    return replace(thing, estimate=estimate, motion=motion, motion_since_found=since)


def _status(step: Step, mapped_before: bool) -> tuple[FrameStatus, str]:
    """How a frame ended, and why where it was not tracked."""
    if step.report.status is UpdateStatus.FAILED:
        return FrameStatus.FAILED, step.report.reason
    if not step.tracking.unmeasured:
        return FrameStatus.TRACKED, ""
    if not mapped_before:
        begun = len(step.tracks.mapped) >= MINIMAL_POINTS
        return (FrameStatus.STARTED, "") if begun else (FrameStatus.PREDICTED, "nothing to see yet")
    reason = REPEATED if step.repeated else step.report.reason
    if step.matches.doubted:
        reason = f"{step.matches.doubted} landmarks agree on a pose too far from the prediction to be believed at once"
        reason = reason if step.tracking.hidden_at is None else HIDDEN
    reason = reason or f"only {len(step.report.used)} of {len(step.matches)} matched landmarks were used"
    return (FrameStatus.LOST if step.tracking.lost else FrameStatus.PREDICTED), reason
