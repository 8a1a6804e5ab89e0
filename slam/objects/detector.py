"""The detector of moving objects: tracks all features, says which move, and estimates the bodies that they form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Estimate, IdArray, RecentPoses, StereoFeatures
from slam.geometry.arrays import IndexArray, among, median
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.interfaces import Backend
from slam.models import EstimatorModels
from slam.object_data import MotionLabels, MovingObject
from slam.objects import membership
from slam.objects.bodies import (
    Body,
    advanced,
    continued,
    hidden,
    with_belief,
    with_evidence,
    with_extent,
)
from slam.objects.camera import recent_poses, with_estimate
from slam.objects.candidates import Candidate, MovingTracks, follow_candidates
from slam.objects.config import ObjectsConfig
from slam.objects.displacements import LAG, displacements, known_well
from slam.objects.estimates import reported
from slam.objects.estimator import FRAMES, BodyEstimator
from slam.objects.first_frames import FirstSights, Places, moving_landmarks
from slam.objects.following import follow
from slam.objects.initialization import BodyInitializer, MovingGroup
from slam.objects.measurement import measure
from slam.objects.merging import merge
from slam.objects.parts import moving_parts
from slam.objects.proof import PROOF, Way, with_frame
from slam.objects.recovery import located, observed
from slam.objects.regions import Scene, classify_scene
from slam.objects.revision import CorrectRows, revise_tracks
from slam.objects.tracks import Tracks, constant_velocity, fit_positions, fit_velocities, make_room, record

NONE = np.zeros(0, np.intp)
_PATIENCE = 2  # frames that a fresh body is remembered for, besides as many as it was seen
_ESTABLISHED = 0.4  # [s] of measured frames, at the present rate, from which a body is remembered in any case


class MovingObjectDetector:
    """Finds moving bodies without being told.

    Args:
        rig: the cameras.
        config: settings.
        models: pixel noise of the estimators, and how they assume that bodies move.
    """

    def __init__(self, rig: StereoRig, config: ObjectsConfig, models: EstimatorModels) -> None:
        self.rig = rig
        self.config = config
        self.sigma = models.pixel_sigma
        self.models = models.objects
        self.slide = (models.objects.drift / rig.left.fu) ** 2  # [rad² / rad]
        self._estimator = BodyEstimator(rig, models)
        self._next_track = 0
        self._next_body = 1
        self.restart()

    def restart(self) -> None:
        """See `slam.objects.modes.ObjectDetector`."""
        self.bodies: dict[int, Body] = {}
        self.tracks = Tracks.empty(0, self.config.window)
        self.suspects = np.zeros(0, np.int64)
        self._stamps = np.full(self.config.window, np.nan)
        self._poses = np.tile(np.eye(4), (self.config.window, 1, 1))  # of the left camera in the window's frames
        self._frame = -1
        self._first = FirstSights.none()
        self._path: RecentPoses | None = None
        self._candidates: list[Candidate] = []
        self._pose_covariance: Array = np.zeros((6, 6))

    def revise(self, correct: CorrectRows) -> None:
        """See `slam.objects.modes.ObjectDetector`."""
        revise_tracks(self.tracks, self.bodies, self._poses, self.slot, self.rig, correct)

    def newly_moving(
        self, features: StereoFeatures, ids: IdArray, rows: IndexArray, ages: IdArray, places: Places,
        T_world_left: Array,
    ) -> IdArray:  # fmt: skip
        """See `slam.objects.modes.ObjectDetector`."""
        if not 0 <= self._frame < self.config.window - 1:
            return np.zeros(0, np.int64)
        pixels, now = measurement_rows(features.uv_left[rows], features.uv_right[rows]), self._frame + 1
        self._first = self._first.after(ids, places, np.maximum(now - ages, 0))
        return ids[moving_landmarks(self.rig, T_world_left, self._first.of(ids), pixels, now, self.sigma, self.config)]

    def step(
        self, backend: Backend, features: StereoFeatures, estimate: Estimate, landmark: IdArray,
        still: IndexArray = NONE,
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Follow all tracks into this frame, test them, and find bodies; see `slam.objects.modes.ObjectDetector`."""
        times = self._begin(features)
        local = self.rig.triangulate(features.uv_left, features.uv_right)
        T_world_left = estimate.T_world_left
        self._poses[self.slot], self._pose_covariance = T_world_left, estimate.covariance
        measuring = local[(landmark >= 0) & np.isfinite(local[:, 0])]
        self._path = with_estimate(self._path, estimate, self.rig, self.sigma, measuring, FRAMES + 1)
        cameras = recent_poses(backend, FRAMES + 1, self._path, estimate.covariance)
        self._advance_bodies(times)
        tracks = self.tracks
        follow(
            tracks, self.bodies, self._candidates, T_world_left, features, local, self._dt(times), self.rig, self.sigma,
            self.config,
        )  # fmt: skip
        self._measure(tracks, features, local, cameras)
        tracks.assign_landmarks(landmark)
        tracks.still[:] = tracks.seen & among(max(len(features), 1), still)[tracks.row]
        self._fit(tracks, times)
        initializer = BodyInitializer(
            self.rig, self.config, self.sigma, self.models, times, self.slot, features.stamp, T_world_left[:3, 3]
        )
        self._change_members(initializer)
        scene = self._find_bodies(initializer, T_world_left)
        if self.config.size > 0:  # nothing gains by it where bodies are resolved, see `slam.objects.candidates`
            self._follow_candidates(initializer, T_world_left)
        self._prove(scene)
        self._begin_estimates(features, cameras)
        self._begin_tracks(features, local, T_world_left, landmark)
        return self._motion_labels(features), reported(self.bodies, tracks, self.config)

    def _begin(self, features: StereoFeatures) -> Array:
        """Move on by a frame; times of the window's slots less the present (W,) [s], zero where there is none yet."""
        dimensions = features.descriptors.shape[1]
        if self.tracks.descriptors.shape[1] != dimensions:  # of frames without features
            self.tracks = Tracks.empty(dimensions, self.config.window)
        self._frame += 1
        self._stamps[self.slot] = features.stamp
        return self._times(features)

    def _times(self, features: StereoFeatures) -> Array:
        times = self._stamps - features.stamp
        return np.where(np.isnan(times), 0.0, times)

    @property
    def slot(self) -> int:
        """The present frame's place in the window."""
        return self._frame % self.config.window

    def _dt(self, times: Array) -> float:
        """Time since the previous frame [s]."""
        return float(-times[(self.slot - 1) % self.config.window])

    def _advance_bodies(self, times: Array) -> None:
        """Predict all bodies; forget those that were not seen for long."""
        now, dt = self._stamps[self.slot], self._dt(times)
        for body in list(self.bodies.values()):
            fresh = (body.seen + 0.5) * dt < _ESTABLISHED  # to the nearest frame
            if now - body.seen_at > self.config.forget_after or (fresh and body.missed >= _PATIENCE + body.seen):
                del self.bodies[body.id]
                self.tracks.give_up(np.flatnonzero(self.tracks.body == body.id))
            else:
                self.bodies[body.id] = advanced(body, dt, self.slot, self.models)

    # ------------------------------------------------------------------------------------------- measuring

    def _measure(self, tracks: Tracks, features: StereoFeatures, local: Array, cameras: RecentPoses) -> None:
        """Estimate the bodies, and add this frame's measurements to the tracks, in world coordinates."""
        c, T_world_left = self.config, cameras.poses[-1]
        for body in list(self.bodies.values()):
            mine = np.flatnonzero((tracks.body == body.id) & tracks.seen)
            front = (other for other in self.bodies.values() if other.proven and other.id != body.id)
            tracks.row[mine[hidden(front, T_world_left[:3, 3], tracks.position[mine])]] = -1
            belief = located(
                body, tracks, features, local, cameras, self._estimator, self.rig, self.sigma, c, self._frame
            )
            if belief is None or not self.models.known(belief.estimate):  # it begins anew once it is measured again
                body = replace(body, belief=None)
            else:
                body = with_belief(body, belief, self.slot, features.stamp, c.min_speed)
            self.bodies[body.id] = body
            mine = tracks.body == body.id
            tracks.position[mine] = transform(body.T, tracks.local[mine])
        make_room(tracks, self.slot)
        seen = np.flatnonzero(tracks.seen)
        z = measurement_rows(features.uv_left[tracks.row[seen]], features.uv_right[tracks.row[seen]])
        record(tracks, seen, self.slot, *measure(self.rig, T_world_left, tracks.position[seen], z, self.sigma))

    def _fit(self, tracks: Tracks, times: Array) -> None:
        """Positions of free tracks, and velocities of those that may move."""
        free = np.flatnonzero((tracks.body < 0) & tracks.seen)
        count = tracks.count(free)
        unsure = (count < self.config.min_frames) | tracks.doubtful[free] | tracks.velocity[free].any(axis=1)
        fit_positions(tracks, free)
        fit_velocities(tracks, free[unsure & (count > 1)], times, self.config.max_speed)

    # ------------------------------------------------------------------------------------------- bodies and members

    def _prove(self, scene: Scene) -> None:
        """Weigh what says that bodies move; those that do not for long, given how long they did, are dropped."""
        c, tracks = self.config, self.tracks
        ages = (self.slot - np.arange(c.window)) % c.window
        for body in list(self.bodies.values()):
            if not body.measured:
                continue
            members = np.flatnonzero((tracks.body == body.id) & tracks.seen)
            members = members[tracks.count(members) >= c.min_frames - 1]
            moved = displacements(tracks, members, ages, self._poses[:, :3, 3], self.slide)
            way = Way.of(body, self._stamps, self._poses, self.rig, self.sigma)
            evidence, certain = with_frame(body.evidence, moved, scene, way, body.far)
            frames = body.certain + 1 if certain else 0
            proven = body.proven or frames >= PROOF
            body = replace(body, evidence=evidence, certain=frames, proven=proven)
            self.bodies[body.id] = body
            if evidence == 0.0 if body.proven else body.seen >= membership.PROBATION:
                self._drop(body)

    def _drop(self, body: Body) -> None:
        """Let a body's tracks go; they need proof to become members of another one."""
        membership.remove_members(self.tracks, np.flatnonzero(self.tracks.body == body.id), body)
        del self.bodies[body.id]

    def _find_bodies(self, initializer: BodyInitializer, T_world_left: Array) -> Scene:
        """Test free tracks in windows of every size against the rest; a group that moves for long becomes a body.

        Returns the still scene.
        """
        c, tracks, times = self.config, self.tracks, initializer.times
        free = np.flatnonzero(tracks.seen & (tracks.body < 0))
        rows, place = known_well(tracks, free, T_world_left, c.min_frames)
        ages = (self.slot - np.arange(c.window)) % c.window
        moved = displacements(tracks, rows, ages, self._poses[:, :3, 3], self.slide)
        scene = classify_scene(moved, place, c.suspect, c.min_support)
        parts = moving_parts(self.bodies, tracks, ages, T_world_left, self._dt(times), c)
        tracks.doubtful[:] = False
        tracks.doubtful[rows] = (scene.alone > c.doubtful) & ~tracks.still[rows]
        alike = np.zeros(len(tracks), bool)
        suspects = [np.zeros(0, np.int64)]
        for group in scene.groups:
            members = rows[group.members]
            members = members[~tracks.still[members]]
            tracks.doubtful[members] = True
            suspects.append(tracks.landmark[members])
            alike[members] = group.moves(c.group_test, LAG * self._dt(times) * c.min_speed)
        for _, members in parts:
            alike[members] = True
        fit_velocities(tracks, np.flatnonzero(tracks.doubtful), times, c.max_speed)
        tracks.streak[:] = np.where(alike, tracks.streak + 1, np.maximum(tracks.streak - 1, 0))
        of_parts = among(len(tracks), np.concatenate([np.zeros(0, np.intp), *(members for _, members in parts)]))
        alone = [rows[group.members] for group in scene.groups]
        alone = [members[~tracks.still[members]] for members in alone]
        alone = [members for members in alone if 2 * of_parts[members].sum() <= len(members)]
        for whole, members in [*parts, *((None, members) for members in alone)]:
            members = members[(tracks.body[members] == -1) | (tracks.body[members] == (-1 if whole is None else whole))]
            if (tracks.streak[members] >= c.confirm).sum() >= c.min_support - 1:
                new = initializer.moving_group(tracks, members[tracks.streak[members] > 0])
                if new is not None:
                    self._found(new, initializer, whole)
        suspected = np.concatenate(suspects)
        self.suspects = suspected[suspected >= 0]
        return scene

    def _found(
        self, group: MovingGroup, initializer: BodyInitializer, whole: int | None = None, far: bool = False
    ) -> None:
        """Make a body of tracks with a common twist; where they belong to another one, they are merged later.

        Args:
            group: the tracks.
            initializer: of bodies.
            whole: id of the body that they are a part of, with a motion of their own; None for none.
            far: whether they were followed for farther than they are wide already.
        """
        tracks, members = self.tracks, group.members
        body = replace(initializer.body(self._next_body, tracks, group), far=far)
        body = replace(self._again(body, whole), apart_from=whole)
        self.bodies[body.id] = body
        self._next_body = max(self._next_body, body.id + 1)
        membership.add_members(body, tracks, members, sure=True)
        self.bodies[body.id] = with_extent(body, tracks.local[members])

    def _again(self, body: Body, whole: int | None) -> Body:
        """A new body, or a known one that was out of view and reappears: that keeps its id, but not its points.

        A part of the body `whole` is compared with earlier parts of that body only.
        """
        tracks, known = self.tracks, None
        parts = {id: b for id, b in self.bodies.items() if whole is None or b.apart_from == whole}
        known = membership.reappeared(parts, body)
        if known is None:
            return body
        tracks.give_up(np.flatnonzero(tracks.body == known.id))
        return continued(body, known)

    def _follow_candidates(self, initializer: BodyInitializer, T_world_left: Array) -> None:
        """Follow the regions that may move; one that has moved for certain becomes a body."""
        c, tracks, times = self.config, self.tracks, initializer.times
        rows = np.flatnonzero(tracks.seen & (tracks.body < 0) & ~tracks.still)
        rows = rows[tracks.count(rows) >= c.min_frames - 1]
        motion = constant_velocity(tracks, rows, times, c.max_speed)
        depth = (motion.position - T_world_left[:3, 3]) @ T_world_left[:3, 2]
        noise = initializer.depth_noise(depth)
        moving = MovingTracks.of(rows, tracks.ids[rows], motion, depth, noise, c.size, c.min_speed)
        followed = follow_candidates(self._candidates, moving, self._dt(times), self.models.acceleration)
        self._candidates = []
        for candidate in followed:
            if not candidate.may_be_body(c.min_speed) or not candidate.is_body(
                c.min_speed, self._shared_error(candidate.state[:3], T_world_left)
            ):
                self._candidates.append(candidate)
            else:
                centre = tracks.position[candidate.members].mean(axis=0)
                twist, uncertainty = candidate.twist(self.models.initial_angular_velocity_sigma)
                self._found(MovingGroup(candidate.members, centre, twist, uncertainty), initializer, far=True)

    def _shared_error(self, place: Array, T_world_left: Array) -> Array:
        """Covariance (3, 3) of a place (3,) as seen from the camera, given that of the camera's pose."""
        J = points_by_pose(transform(inverse(T_world_left), place[None]))[0]
        R = T_world_left[:3, :3]
        return np.asarray(R @ J @ self._pose_covariance @ J.T @ R.T)

    def _change_members(self, initializer: BodyInitializer) -> None:
        """Update the bodies' members; bodies that do not move are dropped."""
        tracks = self.tracks
        measured = {body.id: body for body in self.bodies.values() if body.measured}
        resolved = {body.id for body in self.bodies.values() if initializer.resolves(body.T[:3, 3])}
        gains = membership.update_members(measured, resolved, tracks, self.slot, self.config)
        for id, body in list(self.bodies.items()):
            typical = median(gains[id]) if len(gains.get(id, ())) else 0.0
            body = self.bodies[id] = with_evidence(body, typical)
            if id in gains and typical <= 0 and not body.proven:
                self._drop(body)
            elif id in gains:
                mine = np.flatnonzero((tracks.body == id) & tracks.sure)
                self.bodies[id] = with_extent(body, tracks.local[mine])
        merge(self.bodies, tracks)

    def _begin_tracks(self, features: StereoFeatures, local: Array, T_world_left: Array, landmark: IdArray) -> None:
        """New tracks at stereo features that continue none; give up tracks not seen for long."""
        tracks = self.tracks
        tracks.give_up(np.flatnonzero((tracks.missed > self.config.patience) & (tracks.body < 0)))
        taken = among(len(features), tracks.row[tracks.seen])
        rows = np.flatnonzero(~taken & np.isfinite(local[:, 0]))
        points = transform(T_world_left, local[rows])
        ids = np.arange(self._next_track, self._next_track + len(rows), dtype=np.int64)
        self._next_track += len(rows)
        new = tracks.begin(ids, features, rows, points)
        tracks.landmark[new] = landmark[rows]
        z = measurement_rows(features.uv_left[rows], features.uv_right[rows])
        record(tracks, new, self.slot, *measure(self.rig, T_world_left, points, z, self.sigma))
        fit_positions(tracks, new)

    def _motion_labels(self, features: StereoFeatures) -> MotionLabels:
        tracks = self.tracks
        on, near = membership.tracks_on_bodies(self.bodies, tracks, self.config.margin)
        doubtful = np.flatnonzero(tracks.seen & tracks.doubtful)
        proven = np.isin(tracks.body, [body.id for body in self.bodies.values() if body.proven])
        landmarks = np.unique(tracks.landmark[proven])
        tracks.landmark[proven] = -1
        moving, undecided = np.zeros(len(features), bool), np.zeros(len(features), bool)
        moving[tracks.row[on]] = True
        undecided[tracks.row[near]] = undecided[tracks.row[doubtful]] = True
        return MotionLabels(np.flatnonzero(moving), np.flatnonzero(undecided & ~moving), landmarks[landmarks >= 0])

    def _begin_estimates(self, features: StereoFeatures, cameras: RecentPoses) -> None:
        """Begin the estimates of bodies that have none."""
        tracks = self.tracks
        for id, body in list(self.bodies.items()):
            if body.belief is None and body.measured:
                mine = np.flatnonzero((tracks.body == id) & tracks.seen)
                seen = observed(body, tracks, mine, tracks.row[mine], features, body.T)
                belief = self._estimator.updated(None, id, seen, cameras)
                self.bodies[id] = replace(body, belief=belief, measured_at=features.stamp)
