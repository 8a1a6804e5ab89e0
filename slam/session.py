"""Around the step: a prior map, a kidnapped camera and a new map replace the back end, between frames.

If a step finds that the camera is elsewhere, it ends without a state; `Session` then gives one with another back end,
and the step is made again as a whole.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from slam import registry
from slam.atlas.atlas import Atlas, TrackingGap
from slam.atlas.loop_closer import Found
from slam.atlas.map_io import SavedMap
from slam.checks import definite
from slam.data import (
    CommonError,
    Estimate,
    FrameResult,
    FrameStatus,
    IdArray,
    Prediction,
    StereoFeatures,
    UpdateReport,
    UpdateStatus,
)  # fmt: skip
from slam.errors import ConfigurationError, SlamError
from slam.geometry.se3 import Array
from slam.interfaces import Backend, MapBackend
from slam.tracker import Elsewhere, State, Tracker
from slam.tracks.localizer import Search, nowhere
from slam.tracks.mapper import depth_is_known
from slam.tracks.standing import Standing
from slam.tracks.step import Step, TrackingState
from slam.tracks.table import Tracks

#: Standard deviations of the initial pose [m], [rad] of a back end that starts in a map. They are wide, because the
#: back end measures the landmarks that gave that pose once more: a narrow prior would count them twice.
POSITION_SIGMA, ROTATION_SIGMA = 1.0, 0.2

NOT_FOUND = "the camera has not been found in the map yet"


class Session:
    """Replaces a tracker's back end between frames, by one named `backend`; by none where that is None."""

    def __init__(self, tracker: Tracker, backend: str | None) -> None:
        self._tracker, self._config, self._backend = tracker, tracker.config, backend

    def begin(self, first: Backend, prior_map: SavedMap | None) -> State:
        """The state before the first frame.

        Raises ConfigurationError where there is a prior map, but the back end was not given by name or cannot start in
        one, and SlamError where the map is empty, or too large for the back end.
        """
        self._tracker.rig_error.follow(first)
        if prior_map is None:
            return State(first)
        name, most = type(first).__name__, getattr(first, "most_landmarks", None)
        if self._backend is None:
            raise ConfigurationError("a system that starts in a prior map needs its back end by name")
        if not len(prior_map) and not prior_map.keyframes:
            raise SlamError(f"{prior_map.source}: the map holds no landmarks, so the camera cannot be found in it")
        if not isinstance(first, MapBackend):
            raise ConfigurationError(f"{name} cannot start in a prior map: it has no insert")
        if most is not None and len(prior_map) > most:
            raise SlamError(
                f"{prior_map.source}: {len(prior_map)} landmarks, but {name} takes a map of at most {most}: "
                "start in a smaller map, or with another back end"
            )
        first.insert(prior_map.ids, prior_map.positions, prior_map.covariances)
        atlas = Atlas.of_earlier_run(prior_map.keyframes, prior_map.keyframe_poses, prior_map.loops)
        dimensions, mapped = prior_map.dimensions if len(prior_map) else None, len(prior_map) > 0
        tracks = Tracks.empty(prior_map.descriptors.shape[1]).with_landmarks(prior_map.rows)
        return State(first, tracks, atlas, dimensions=dimensions, ever_mapped=mapped, prior_map=prior_map)

    def found_in_prior_map(self, state: State, features: StereoFeatures) -> State | None:
        """The state with a back end at the pose at which the camera is found in the prior map; None if it is not."""
        saved = state.prior_map
        assert saved is not None
        prediction, place = nowhere(features.stamp, self._config.models.initial_pose), None
        localizer, index = self._tracker.localizer, state.index + 1
        matches = Search(localizer, prediction, saved.rows, saved.positions, features, index).match()
        T = matches.T_world_left if len(matches) >= localizer.config.minimum_consistent else None
        if T is None:
            place = self._tracker.find(state, features)
            if place is None:
                return None
            T = place.T_odom_left
        self._tracker.mapper.next_id = saved.next_id
        new, tracks = self._start(state.tracks, T, (saved.ids, saved.positions, saved.covariances), place)
        return replace(state, backend=new, tracks=tracks, prior_map=None, online=(), ever_mapped=True)

    def not_found(self, state: State, features: StereoFeatures) -> tuple[State, FrameResult]:
        """State and result after a frame in which the camera was not found in the prior map."""
        none, rows = np.zeros(0, np.int64), np.zeros(0, np.intp)
        whole = self.map_estimate(state, features.stamp)
        estimate = replace(whole, ids=none, positions=whole.positions[:0], covariances=whole.covariances[:0])
        report, seen = UpdateReport.nothing(UpdateStatus.EMPTY, NOT_FOUND), replace(features, images=None)
        result = FrameResult(
            state.index + 1, FrameStatus.LOST, NOT_FOUND, estimate, report, seen, predicted=0, matched=none,
            matched_features=rows, added=none, added_features=rows, erased=none, map_size=len(whole.ids), located=False,
        )  # fmt: skip
        return replace(state, index=state.index + 1, checksum=None), result

    def map_estimate(self, state: State, stamp: float) -> Estimate:
        """The prior map, with a guess as the pose; its covariance is so large that the pose means nothing."""
        k, none = state.prior_map, nowhere(stamp, self._config.models.initial_pose)
        assert k is not None
        return Estimate(stamp, none.T_world_left, none.covariance, k.ids, k.positions, k.covariances)

    def at_first_sight(self, state: State, features: StereoFeatures) -> State:
        """The state with a new back end where the first landmarks can begin after frames that showed none.

        They define the world's coordinates, so the pose in this frame is exact, as in a first one: with that of a back
        end that has predicted it since then, linearisation would fail, see `taken_over`.
        """
        c, rows = self._config, np.flatnonzero(features.has_stereo)
        if state.ever_mapped or state.index < 0 or self._backend is None:
            return state
        if not depth_is_known(self._tracker.rig, features, rows, c.models.pixel_sigma, c.map.max_depth_error).any():
            return state
        self._tracker.objects.restart()
        past, new = (*state.past, state.backend.trajectory()), self._new(CommonError())
        return replace(state, backend=new, tracks=None, tracking=TrackingState(), online=(), past=past)

    def taken_over(self, state: State, elsewhere: Elsewhere, features: StereoFeatures) -> tuple[State, Prediction]:
        """The state with another back end, and what that predicts for the frame in which it takes over.

        The old back end's path stays without its newest pose. At a pose in the map, the new one gets all landmarks, and
        those of the place if that is no longer in the map; correlations between landmarks are lost, as with a map from
        a file. The old one would take the displacement for motion.

        In an unknown place, a new map begins at the old one's pose, which is exact for it: it defines its coordinates.
        A single estimator cannot hold a pose that is uncertain by many metres and degrees together with landmarks seen
        from there: linearisation fails over such angles and makes it overconfident in a wrong pose. The new map's pose
        relative to the earlier one is more uncertain than the predicted pose, see `covariance_after_unseen_motion` of
        `slam.atlas.atlas`, until a place of the atlas is seen again. The earlier landmarks remain in the atlas only.
        """
        old, T, stamp = state.backend, elsewhere.T_world_left, features.stamp
        tracks = None
        if T is None:
            before = self._tracker.rig_error.added_to(old, old.estimate(landmarks=False))
            T, standing = before.T_world_left, Standing(fastened=state.standing.fastened)
            common = self._tracker.rig_error.common(old, as_reported=False)
            new = self._new(common, T_world_left=T.tolist())
            prediction = new.predict(stamp)
            after = new.estimate(landmarks=False)
            atlas = state.atlas.with_new_map(state.measured_at, before, after, common, self._config.models)
        else:
            whole, place = self._tracker.rig_error.added_to(old, old.estimate()), elsewhere.place
            landmarks = whole.ids, whole.positions, definite(whole.covariances)
            new, tracks = self._start(state.tracks, T, landmarks, place)
            seen_at = None if place is None else place.stamp
            prediction = new.predict(stamp)
            standing = state.standing.after(self._tracker.rig, self._config.models.pixel_sigma, features).moving()
            atlas = state.atlas.relocalized(TrackingGap(state.measured_at, stamp), seen_at)
        path = old.trajectory().select(slice(None, -1))
        hidden = elsewhere.T_world_left is None and state.tracking.stood and self._config.models.motion.wheels
        state = replace(
            state, backend=new, tracks=tracks, atlas=atlas, standing=standing, online=(),
            tracking=state.tracking.believing(T, stamp, T if hidden else None), past=(*state.past, path),
            restarted=(*state.restarted, state.index + 1),
        )  # fmt: skip
        return state, prediction

    def with_takeover(self, before: State, begun: State, step: Step) -> Step:
        """The step, with the landmarks that left and joined the map where another back end took over.

        `before` is the state after the last frame; `begun` that in which the step began, without landmarks where a new
        map did.
        """
        if before.tracks is None:
            return step
        if begun.tracks is None:
            gone = before.tracks.landmarks().ids
            return replace(step, erased=np.concatenate([gone, step.erased]))
        joined = np.setdiff1d(begun.tracks.landmarks().ids, before.tracks.landmarks().ids)
        return replace(step, joined=np.union1d(step.joined, joined))

    def _start(
        self, tracks: Tracks | None, T_world_left: Array, landmarks: tuple[IdArray, Array, Array], place: Found | None
    ) -> tuple[Backend, Tracks]:
        """A back end at a pose (4, 4) that is only roughly known, and the table with a place's landmarks.

        It is given landmarks (their ids, positions, covariances) and those of the place that are not among them.
        """
        assert tracks is not None
        sigmas = {"initial_position_sigma": POSITION_SIGMA, "initial_rotation_sigma": ROTATION_SIGMA}
        new = self._new(CommonError(), T_world_left=T_world_left.tolist(), **sigmas)
        new.insert(*landmarks)  # type: ignore[attr-defined]
        if place is not None:
            tracks = self._tracker.mapper.insert(new, tracks, place.landmarks, place.positions, place.covariances)
        return new, tracks

    def _new(self, common: CommonError, **models: Any) -> Backend:
        """Another back end of the same kind; `common` is the error by the rig that its first pose has."""
        assert self._backend is not None
        options = {"models": replace(self._config.models, **models), **self._config.backend}
        backend: Backend = registry.create("backends", self._backend, self._tracker.rig, **options)
        self._tracker.rig_error.follow(backend, common.jacobian if common.jacobian.size else None)
        return backend
