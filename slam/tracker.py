"""The stages of a step, each a function of the frame in work; `slam.system` puts them in order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

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
from slam.interfaces import Frontend, RestingBackend
from slam.mapping.step import Step
from slam.object_data import MovingObject
from slam.objects.modes import ObjectDetector
from slam.rig_error import CommonError, Revision
from slam.session import NEW_MAP, Elsewhere, Session, State
from slam.third_party import checked
from slam.tracks.alignment import Aligner
from slam.tracks.localizer import LandmarkMatches
from slam.tracks.standing import Standing
from slam.tracks.state import HIDDEN
from slam.tracks.table import LandmarkTable


class Tracker:
    """The stages of a step.

    Args:
        session: with the parts of the system, and the back ends.
        objects: detects what moves.

    Attributes:
        advanced: stamp to which a back end was last advanced [s]; an interrupted step counts.
    """

    def __init__(self, session: Session, objects: ObjectDetector) -> None:
        self.objects = objects
        self.advanced = -np.inf
        self._session = session
        self._aligner = Aligner(session.rig, session.config.association.align)

    def revise(self, state: State) -> Revision | None:
        """Apply the present estimate of the rig's error, also to earlier measurements if the back end can."""
        change = self._session.rig_error.apply(state.backend)
        if change is not None:
            self.objects.revise(change.rows)
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
        self, state: State, features: StereoFeatures, standing: Standing, prediction: Prediction,
        frontend: Frontend | None,
    ) -> Step | Elsewhere:  # fmt: skip
        """Match landmarks with features, and align the features if the front end that made them can."""
        corrected, found = self._session.calibration.correct(features), None
        landmarks = state.landmarks or LandmarkTable.empty(features.descriptors.shape[1])

        def elsewhere() -> Array | None:
            nonlocal found
            found = self._session.find(state, corrected)
            return None if found is None else found.T_odom_left

        seen = prediction, landmarks, _positions(state, landmarks.ids), corrected
        localizer, index, tracking = self._session.localizer, state.index + 1, state.tracking
        if state.begins_at(index):
            matches = localizer.match(*seen, index)
        else:
            matches, tracking, standing = localizer.follow(*seen, tracking, standing, index, elsewhere)
        if matches.kidnapped:
            if self._session.can_restart(state):
                return Elsewhere(matches.T_world_left, found)
            matches = LandmarkMatches.nothing()
        places = state.backend.positions
        aligned, landmarks = self._aligner.align(frontend, features, matches, landmarks, places)
        if aligned is not features:
            corrected = _moved_as(corrected, features, aligned)
        step = Step(
            index, aligned, replace(corrected, images=None), prediction, landmarks, matches, standing, tracking,
            state.atlas,
        )  # fmt: skip
        suspects = self._suspects(state, step)
        moving = isin(matches.ids, suspects)
        return replace(step, matches=matches.select(~moving), withheld=matches.select(moving), suspects=suspects)

    def _suspects(self, state: State, step: Step) -> IdArray:
        """Ids of landmarks that may move; while the camera stands, all matched ones that do not stay where they are."""
        ids, rows = step.matches.ids, step.matches.rows
        if step.standing.stands:
            return ids[~isin(rows, step.standing.witnesses)]
        ages = step.index - step.landmarks.last_seen[step.landmarks.rows(ids)]
        moving = self.objects.newly_moving(
            step.features, ids, rows, ages, lambda ids: _positions(state, ids), step.pose
        )
        return np.union1d(self.objects.suspects, moving)

    def update(self, state: State, step: Step) -> Step | Elsewhere:
        """Update the back end; `Elsewhere` in an unknown place."""
        positions, localizer = _positions(state, step.matches.ids), self._session.localizer
        dt = step.prediction.stamp - state.stamp
        asked, left_out = localizer.informative(step.prediction, step.matches, positions, dt)
        answer = state.backend.update(asked.observations(step.features), asked.T_world_left)
        report: UpdateReport = checked(state.backend, "update", answer)
        stands = step.standing.stands
        tracking = localizer.state_after(step.tracking, step.prediction, step.features, asked, report, stands)
        if state.begins_at(step.index):
            report = replace(report, reason=report.reason if len(step.landmarks) else NEW_MAP)
        elif not step.standing.holds(tracking.lost) and self._session.may_begin_new_map(state, tracking):
            return Elsewhere(None)
        return replace(step, report=report, left_out=left_out, tracking=tracking)

    def estimate(self, state: State, step: Step) -> Step:
        """The camera's pose after an update; the rig's uncertainty is propagated to it, and its calibration learns."""
        self._session.calibration.observe(replace(step.measured, images=None), step.pose)
        estimate: Estimate = checked(state.backend, "estimate", state.backend.estimate(landmarks=False))
        used = step.report.used
        rig_error, positions = self._session.rig_error, _positions(state, used)
        rig_error.uncertainty.observe(estimate.T_world_left, estimate.stamp, used, positions)
        return replace(step, estimate=estimate)

    def sort(self, state: State, step: Step) -> Step:
        """Which features move, and the moving bodies."""
        landmark, standing = step.matches.landmark_of(len(step.features)), step.standing
        labels, objects = self.objects.step(
            state.backend, step.features, step.estimate, landmark, standing.witnesses
        )  # fmt: skip
        labels = labels.with_undecided(standing.leaving(len(step.features)))
        return replace(step, labels=labels, objects=objects)

    def manage(self, state: State, step: Step, frontend: Frontend | None) -> Step:
        """Change the map, and remember the image patches of new landmarks."""
        step = self._session.mapper.update(state.backend, step)
        seen, T = step.matches.joined(step.added), step.estimate.T_world_left
        landmarks = self._aligner.with_patches(frontend, step.measured, seen, step.landmarks, T)
        new = step.added.ids[~isin(step.added.ids, step.erased)]
        self._session.rig_error.uncertainty.change(new, _positions(state, new), step.erased)
        return replace(step, landmarks=landmarks)

    def close_loops(self, state: State, step: Step) -> Step:
        """Make the frame a keyframe where it differs; a loop corrects the path, and returns old landmarks to the map.

        The rig's uncertainty is added to the pose.
        """
        session, rig_error = self._session, self._session.rig_error
        estimate, common = rig_error.added_to(step.estimate), rig_error.common(as_reported=False)
        step = replace(step, estimate=estimate, common=common, correction=session.calibration.applied)
        atlas, seen_again = session.loop_closer.update(state.atlas, step, state.path)
        if seen_again is not None:
            step = session.mapper.restore(state.backend, step, seen_again)
            back = np.sort(step.returned.ids)
            rig_error.uncertainty.change(back, _positions(state, back), back[:0], again=True)
        return replace(step, atlas=atlas)

    def roll_back(self, state: State) -> State:
        """The state after an interrupted step: what that did to the back end's map is undone, bodies are forgotten."""
        self.objects.restart()
        if state.prior_map is not None or not np.isfinite(self.advanced):  # that back end has not begun
            return state
        landmarks = self._session.mapper.reconcile(state.backend, state.landmarks)
        self._session.rig_error.uncertainty.keep(np.zeros(0, np.int64) if landmarks is None else landmarks.ids)
        return replace(state, landmarks=landmarks)

    def whole_estimate(self, state: State) -> Estimate:
        """Pose and map of the back end, with the rig's uncertainty."""
        return self._session.rig_error.added_to(checked(state.backend, "estimate", state.backend.estimate()))


def _moved_as(corrected: StereoFeatures, before: StereoFeatures, now: StereoFeatures) -> StereoFeatures:
    """Corrected features that move as the measured ones did: the correction is the same over so small a shift."""
    if corrected is before:
        return now
    left, right = now.uv_left - before.uv_left, now.uv_right - before.uv_right
    return replace(corrected, uv_left=corrected.uv_left + left, uv_right=corrected.uv_right + right)


def _positions(state: State, ids: IdArray) -> Array:
    """Landmarks' positions (N, 3) [m] in the world."""
    return np.asarray(checked(state.backend, "positions", state.backend.positions(ids), n=len(ids)))


def frame_result(
    step: Step, mapped_before: bool, revision: Revision | None, milliseconds: Mapping[str, float], common: CommonError
) -> FrameResult:  # fmt: skip
    """The result of a step.

    `mapped_before` says whether there ever was a landmark before; `revision` is the change of earlier pixels'
    correction before the step, `common` the part of the pose's error that it shares with the poses reported in other
    frames.
    """
    atlas, objects = step.atlas, step.objects
    if atlas.loops:
        objects = tuple(_in_map(thing, atlas.T_map_odom) for thing in objects)
    status, reason = _status(step, mapped_before)
    return FrameResult(
        step.index, status, reason, atlas.estimate(step.estimate, step.common), step.report, step.features,
        len(step.prediction.ids), step.matches.ids, step.matches.rows, step.added.ids, step.added.rows, step.erased,
        len(step.landmarks), dict(milliseconds), step.labels.moving, objects, revision=revision,
        T_map_odom=atlas.T_map_odom, loop=atlas.closed_in(step.index), refused_loop=atlas.refused_in(step.index),
        keyframe=bool(atlas.keyframes) and atlas.keyframes[-1].frame == step.index, returned=step.returned.ids,
        common=common if atlas.anchor is None else CommonError(),
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
