"""The stages of a step, each a function of the frame in work; `slam.system` puts them in order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slam.atlas.atlas import Atlas
from slam.bodies.detector import ObjectDetector
from slam.data import (
    Estimate,
    FrameResult,
    FrameStatus,
    IdArray,
    Prediction,
    StereoFeatures,
    UpdateReport,
    UpdateStatus,
)
from slam.geometry.arrays import Array, isin
from slam.geometry.se3 import inverse
from slam.input.warnings import REPEATED
from slam.interfaces import AligningFrontend, Frontend, RestingBackend
from slam.object_data import MovingObject
from slam.rig_error import CommonError, Revision
from slam.session import NEW_MAP, Elsewhere, Session, State
from slam.third_party import checked
from slam.tracks.alignment import align, take_patches
from slam.tracks.localizer import LandmarkMatches, Search
from slam.tracks.standing import Standing
from slam.tracks.state import HIDDEN
from slam.tracks.step import Step
from slam.tracks.table import Tracks


class Tracker:
    """The stages of a step.

    Args:
        session: with the parts of the system, and the back ends.
        objects: detects what moves.
        frontend: made the features; those of landmarks are aligned with earlier images if it can do that.

    Attributes:
        advanced: stamp to which a back end was last advanced [s]; an interrupted step counts.
    """

    def __init__(self, session: Session, objects: ObjectDetector, frontend: Frontend | None) -> None:
        self.objects = objects
        self.advanced = -np.inf
        self._session = session
        aligns = session.config.association.align and isinstance(frontend, AligningFrontend)
        self._aligning: AligningFrontend | None = frontend if aligns else None  # type: ignore[assignment]

    def revise(self, state: State) -> Revision | None:
        """Apply the present estimate of the rig's error, also to earlier measurements if the back end can."""
        change = self._session.rig_error.apply(state.backend)
        if change is not None and state.tracks is not None:
            self.objects.revise(state.tracks, change.rows)
        return self._session.rig_error.revise(state.backend, restarted=bool(state.past))

    def predict(self, state: State, features: StereoFeatures) -> tuple[Standing, Prediction]:
        """Whether the camera stands, and the back end's prediction for the time of the features."""
        standing = state.standing.after(self._session.rig, self._session.config.models.pixel_sigma, features)
        at_rest = standing.stands and isinstance(state.backend, RestingBackend)
        ask = state.backend.predict_at_rest if at_rest else state.backend.predict  # type: ignore[attr-defined]
        prediction: Prediction = checked(state.backend, "predict", ask(features.stamp))
        self.advanced = features.stamp
        return standing, prediction

    def associate(
        self, state: State, features: StereoFeatures, standing: Standing, prediction: Prediction
    ) -> Step | Elsewhere:
        """Match landmarks with features, and align the features with earlier images."""
        corrected, place = self._session.calibration.correct(features), None
        tracks = state.tracks
        if tracks is None or (tracks.descriptors.shape[1] != features.descriptors.shape[1] and not len(tracks.mapped)):
            tracks = Tracks.empty(features.descriptors.shape[1])
        tracks = tracks.begun(len(features), self.objects.window)
        landmarks, backend = tracks.landmarks(), state.backend
        positions = checked(backend, "positions", backend.positions(landmarks.ids), n=len(landmarks))

        def elsewhere() -> Array | None:
            nonlocal place
            place = self._session.find(state, corrected)
            return None if place is None else place.T_odom_left

        localizer, index, tracking = self._session.localizer, state.index + 1, state.tracking
        search = Search(localizer, prediction, landmarks, positions, corrected, index)
        if state.begins_at(index):
            matches = search.match()
        else:
            matches, tracking, standing = search.follow(tracking, standing, elsewhere)
        if matches.kidnapped:
            if self._session.can_restart(state):
                return Elsewhere(matches.T_world_left, place)
            matches = LandmarkMatches.nothing()
        tracks.count_returning(matches.returning)
        aligned = features
        if self._aligning is not None:
            aligned = align(self._session.rig, self._aligning, features, matches, tracks, backend.positions)
        if aligned is not features:
            corrected = _shifted_as(corrected, features, aligned)
        step = Step(
            index, aligned, replace(corrected, images=None), prediction, tracks, matches, standing, tracking,
            state.views,
        )  # fmt: skip
        suspects = self._suspects(step)
        moving = isin(matches.ids, suspects)
        matches, withheld = matches.select(~moving), matches.select(moving)
        tracks.find(tracks.rows(matches.ids), matches.rows)
        return replace(step, matches=matches, withheld=withheld, suspects=suspects)

    def _suspects(self, step: Step) -> IdArray:
        """Ids of landmarks that may move; while the camera stands, all matched ones that do not stay where they are."""
        ids, rows = step.matches.ids, step.matches.rows
        if step.standing.stands:
            return ids[~isin(rows, step.standing.witnesses)]
        at = step.tracks.rows(ids)
        parting = self.objects.parting(step.tracks, step.features, at, rows, step.pose)
        return np.union1d(self.objects.suspects, parting)

    def update(self, state: State, step: Step) -> Step | Elsewhere:
        """Update the back end; `Elsewhere` in an unknown place."""
        matches, standing = step.matches, step.standing
        answer = state.backend.update(matches.observations(step.features), matches.T_world_left)
        report: UpdateReport = checked(state.backend, "update", answer)
        tracking = self._session.localizer.state_after(
            step.tracking, step.prediction, step.features, matches, report, standing.stands
        )
        if state.begins_at(step.index):
            report = replace(report, reason=report.reason if len(step.tracks.mapped) else NEW_MAP)
        elif not standing.holds(tracking.lost) and self._session.may_begin_new_map(state, tracking):
            return Elsewhere(None)
        return replace(step, report=report, tracking=tracking)

    def estimate(self, state: State, step: Step) -> Step:
        """The camera's pose after an update; the rig's calibration learns from the frame."""
        self._session.calibration.observe(replace(step.measured, images=None), step.pose)
        estimate: Estimate = checked(state.backend, "estimate", state.backend.estimate(landmarks=False))
        return replace(step, estimate=estimate)

    def sort(self, state: State, step: Step) -> Step:
        """Which features move, and the moving bodies."""
        features, standing = step.features, step.standing
        labels, objects = self.objects.step(state.backend, step.tracks, features, step.estimate, standing.witnesses)
        labels = labels.with_undecided(standing.leaving(len(features)))
        return replace(step, labels=labels, objects=objects)

    def manage(self, state: State, step: Step) -> Step:
        """Change the map, and remember the image patches of new landmarks."""
        step = self._session.mapper.update(state.backend, step)
        if self._aligning is not None:
            seen, T = step.matches.joined(step.added), step.estimate.T_world_left
            take_patches(self._aligning, step.measured, seen, step.tracks, T)
        return step

    def close_loops(self, state: State, step: Step) -> tuple[Step, Atlas]:
        """The step, its pose with the rig's uncertainty, and the atlas after it.

        The frame becomes a keyframe where its view differs; a loop corrects the path.
        """
        session, rig_error, backend = self._session, self._session.rig_error, state.backend
        estimate, common = rig_error.added_to(backend, step.estimate), rig_error.common(backend, as_reported=False)
        step = replace(step, estimate=estimate, common=common, correction=session.calibration.applied)
        return step, session.loop_closer.update(state.atlas, step, state.path)

    def roll_back(self, state: State) -> State:
        """The state after an interrupted step: what that did to the back end's map is undone, bodies are forgotten."""
        self.objects.restart()
        if state.prior_map is not None or not np.isfinite(self.advanced):  # that back end has not begun
            return state
        return replace(state, tracks=self._session.mapper.reconcile(state.backend, state.tracks))

    def whole_estimate(self, state: State) -> Estimate:
        """Pose and map of the back end, with the rig's uncertainty."""
        estimate = checked(state.backend, "estimate", state.backend.estimate())
        return self._session.rig_error.added_to(state.backend, estimate)


def _shifted_as(corrected: StereoFeatures, before: StereoFeatures, now: StereoFeatures) -> StereoFeatures:
    """Corrected features that move as the measured ones did: the correction is the same over so small a shift."""
    if corrected is before:
        return now
    left, right = now.uv_left - before.uv_left, now.uv_right - before.uv_right
    return replace(corrected, uv_left=corrected.uv_left + left, uv_right=corrected.uv_right + right)


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
        estimate = replace(estimate, covariance=0.5 * (covariance + covariance.T))
    return FrameResult(
        step.index, status, reason, estimate, step.report, step.features,
        len(step.prediction.ids), step.matches.ids, step.matches.rows, step.added.ids, step.added.rows, step.erased,
        len(step.tracks.mapped), dict(milliseconds), step.labels.moving, objects, revision=revision,
        T_map_odom=atlas.T_map_odom, loop=loop, refused_loop=refused_loop,
        keyframe=bool(atlas.keyframes) and atlas.keyframes[-1].frame == step.index,
        returned=step.joined,
        common=common,
    )  # fmt: skip


def _in_map(thing: MovingObject, T_map_odom: Array) -> MovingObject:
    """A body in the map's coordinates; of its covariances only the velocity's changes, the pose's is in body axes."""
    e, R = thing.estimate, np.kron(np.eye(2), T_map_odom[:3, :3])
    motion, since = (T_map_odom @ T @ inverse(T_map_odom) for T in (thing.motion, thing.motion_since_found))
    pose, P = T_map_odom @ e.T_world_object, R @ e.velocity_covariance @ R.T
    estimate = replace(e, T_world_object=pose, velocity=R @ e.velocity, velocity_covariance=P)
    return replace(thing, estimate=estimate, motion=motion, motion_since_found=since)


def _status(step: Step, mapped_before: bool) -> tuple[FrameStatus, str]:
    """How a frame ended, and why where it was not tracked."""
    if step.report.status is UpdateStatus.FAILED:
        return FrameStatus.FAILED, step.report.reason
    if not step.tracking.unmatched:
        return FrameStatus.TRACKED, ""
    if not mapped_before:
        return (FrameStatus.STARTED, "") if len(step.added) else (FrameStatus.PREDICTED, "nothing to see yet")
    reason = REPEATED if step.repeated else step.report.reason
    if step.matches.doubted:
        reason = f"{step.matches.doubted} landmarks agree on a pose too far from the prediction to be believed at once"
        reason = reason if step.tracking.hidden_at is None else HIDDEN
    reason = reason or f"only {len(step.report.used)} of {len(step.matches)} matched landmarks were used"
    return (FrameStatus.LOST if step.tracking.lost else FrameStatus.PREDICTED), reason
