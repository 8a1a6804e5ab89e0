"""The detector of moving objects: tracks all features, says which move, and estimates the bodies that they form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Estimate, IdArray, IndexArray, RecentPoses, StereoFeatures
from slam.geometry.arrays import among, median
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, transform
from slam.interfaces import Backend
from slam.models import EstimatorModels
from slam.object_data import MotionLabels, MovingObject
from slam.objects import finder, membership
from slam.objects.bodies import Body, advanced, continued, hidden, with_belief, with_evidence, with_extent
from slam.objects.camera import recent_poses, with_estimate
from slam.objects.config import ObjectsConfig
from slam.objects.estimates import reported
from slam.objects.estimator import FRAMES, BodyEstimator
from slam.objects.following import follow
from slam.objects.frame import NO_IDS, Frame, Setup
from slam.objects.measurement import measure
from slam.objects.merging import merge
from slam.objects.modes import ObjectDetector, Places
from slam.objects.parting import parting
from slam.objects.proof import PROOF, Way, by_left_image, with_frame
from slam.objects.recovery import located, observed
from slam.objects.regions import Region, follow_regions
from slam.objects.revision import CorrectRows, revise_tracks
from slam.objects.scene import Scene, displacements
from slam.objects.tracks import Tracks, fit_positions, fit_velocities, make_room, record

_NONE: IndexArray = np.zeros(0, np.intp)
_PATIENCE = 2  # frames that a fresh body is remembered for, besides as many as it was seen
_ESTABLISHED = 0.4  # [s] of measured frames, at the present rate, from which a body is remembered in any case


class MovingObjectDetector(ObjectDetector):
    """Finds moving bodies without being told.

    Args:
        rig: the cameras.
        config: settings.
        models: pixel noise of the estimators, and how they assume that bodies move.
    """

    def __init__(self, rig: StereoRig, config: ObjectsConfig, models: EstimatorModels) -> None:
        self.setup = Setup(rig, config, models)
        self._estimator = BodyEstimator(rig, models)
        self._next_track = 0
        self._next_body = 1
        self.restart()

    def restart(self) -> None:
        """See `slam.objects.modes.ObjectDetector`."""
        window = self.setup.config.window
        self.bodies: dict[int, Body] = {}
        self.tracks = Tracks.empty(0, window)
        self.suspects = NO_IDS
        self._stamps = np.full(window, np.nan)
        self._poses = np.tile(np.eye(4), (window, 1, 1))  # of the left camera in the window's frames
        self._number = -1
        self._parted: dict[int, int] = {}  # landmarks by id: the last frame in which they parted from the rest
        self._path: RecentPoses | None = None
        self._regions: list[Region] = []

    def revise(self, correct: CorrectRows) -> None:
        """See `slam.objects.modes.ObjectDetector`."""
        slot = self._number % self.setup.config.window
        revise_tracks(self.tracks, self.bodies, self._poses, slot, self.setup.rig, correct)

    def parting(
        self, features: StereoFeatures, ids: IdArray, rows: IndexArray, places: Places, T_world_left: Array
    ) -> IdArray:
        """See `slam.objects.modes.ObjectDetector`; a landmark stays in doubt for some frames."""
        now = self._number + 1
        if now > 0 and len(ids):
            parts = parting(self.setup, self.tracks, now, features, ids, rows, places, T_world_left)
            self._parted.update(dict.fromkeys(ids[parts].tolist(), now))
        self._parted = {id: last for id, last in self._parted.items() if now - last <= self.setup.config.confirm}
        return np.array(sorted(self._parted), np.int64)

    def step(
        self, backend: Backend, features: StereoFeatures, estimate: Estimate, landmark: IdArray,
        still: IndexArray = _NONE,
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Follow all tracks into this frame, test them, and find bodies; see `slam.objects.modes.ObjectDetector`."""
        frame = self._begin(backend, features, estimate, landmark)
        tracks = self.tracks
        self._advance_bodies(frame)
        follow(tracks, self.bodies, self._regions, frame, landmark)
        self._measure(frame)
        tracks.still[:] = tracks.seen & among(max(len(features), 1), still)[tracks.row]
        self._fit(frame)
        self._change_members(frame)
        found = finder.find_groups(frame, tracks, self.bodies)
        for group in found.groups:
            moving = finder.lasting(group, tracks, frame)
            new = finder.moving_group(frame, tracks, moving) if len(moving) else None
            if new is not None:
                self._found(new, frame, group[0])
        if self.setup.config.size > 0:  # nothing gains by it where bodies are resolved, see `slam.objects.regions`
            self._follow_regions(frame)
        self._prove(frame, found.scene)
        unproven = np.isin(tracks.body, [body.id for body in self.bodies.values() if not body.proven])
        c = self.setup.config  # of a body that was dropped: nothing is known of these until a group could be found
        unproven |= tracks.expelled & tracks.seen & (tracks.count(np.arange(len(tracks))) < c.min_frames + c.confirm)
        suspected = np.concatenate([tracks.landmark[found.suspects], tracks.landmark[unproven]])
        self.suspects = np.unique(suspected[suspected >= 0])
        self._begin_estimates(frame)
        self._begin_tracks(frame, landmark)
        return self._motion_labels(frame), reported(self.bodies, tracks, self.setup.config)

    def _begin(self, backend: Backend, features: StereoFeatures, estimate: Estimate, landmark: IdArray) -> Frame:
        """Move on by a frame."""
        s, dimensions = self.setup, features.descriptors.shape[1]
        if self.tracks.descriptors.shape[1] != dimensions:  # of frames without features
            self.tracks = Tracks.empty(dimensions, s.config.window)
        self._number += 1
        slot = self._number % s.config.window
        self._stamps[slot], self._poses[slot] = features.stamp, estimate.T_world_left
        local = s.rig.triangulate(features.uv_left, features.uv_right)
        measuring = local[(landmark >= 0) & np.isfinite(local[:, 0])]
        self._path = with_estimate(self._path, estimate, s.rig, s.sigma, measuring, FRAMES + 1)
        cameras = recent_poses(backend, FRAMES + 1, self._path, estimate.covariance)
        return Frame(s, self._number, features, local, self._stamps.copy(), self._poses.copy(), cameras)

    def _advance_bodies(self, frame: Frame) -> None:
        """Predict all bodies; forget those that were not seen for long."""
        now, dt = frame.features.stamp, frame.dt
        for body in list(self.bodies.values()):
            fresh = (body.seen + 0.5) * dt < _ESTABLISHED  # to the nearest frame
            too_long = now - body.seen_at > self.setup.config.forget_after
            if too_long or (fresh and body.missed >= _PATIENCE + body.seen):
                del self.bodies[body.id]
                self.tracks.give_up(np.flatnonzero(self.tracks.body == body.id))
            else:
                self.bodies[body.id] = advanced(body, dt, frame.slot, self.setup.models)

    def _measure(self, frame: Frame) -> None:
        """Estimate the bodies, and add this frame's measurements to the tracks, in world coordinates."""
        tracks, f = self.tracks, frame.features
        for body in list(self.bodies.values()):
            mine = np.flatnonzero((tracks.body == body.id) & tracks.seen)
            front = (other for other in self.bodies.values() if other.proven and other.id != body.id)
            tracks.row[mine[hidden(front, frame.eye, tracks.position[mine])]] = -1
            belief = located(body, tracks, frame, self._estimator)
            if belief is None or not self.setup.models.known(belief.estimate):  # it begins anew once measured again
                body = replace(body, belief=None)
            else:
                body = with_belief(body, belief, frame.slot, f.stamp, self.setup.config.min_speed)
            self.bodies[body.id] = body
            mine = np.flatnonzero(tracks.body == body.id)
            tracks.position[mine] = transform(body.T, tracks.local[mine])
        make_room(tracks, frame.slot)
        self._record(frame, np.flatnonzero(tracks.seen))

    def _record(self, frame: Frame, seen: IndexArray) -> None:
        """Add what tracks measured in this frame."""
        tracks, f = self.tracks, frame.features
        z = measurement_rows(f.uv_left[tracks.row[seen]], f.uv_right[tracks.row[seen]])
        what = measure(self.setup.rig, frame.T_world_left, tracks.position[seen], z, self.setup.sigma)
        record(tracks, seen, frame.slot, *what)

    def _fit(self, frame: Frame) -> None:
        """Positions of free tracks, and velocities of those that may move."""
        tracks, c = self.tracks, self.setup.config
        free = np.flatnonzero((tracks.body < 0) & tracks.seen)
        count = tracks.count(free)
        unsure = (count < c.min_frames) | tracks.doubtful[free] | tracks.velocity[free].any(axis=1)
        fit_positions(tracks, free)
        fit_velocities(tracks, free[unsure & (count > 1)], frame.times, c.max_speed)

    def _change_members(self, frame: Frame) -> None:
        """Update the bodies' members; bodies that do not move are dropped."""
        tracks = self.tracks
        gains = membership.update_members(self.bodies, frame, tracks)
        for id, body in list(self.bodies.items()):
            typical = median(gains[id]) if len(gains.get(id, ())) else 0.0
            body = self.bodies[id] = with_evidence(body, typical)
            if id in gains and typical <= 0 and not body.proven:
                self._drop(body)
            elif id in gains:
                mine = np.flatnonzero((tracks.body == id) & tracks.sure)
                self.bodies[id] = with_extent(body, tracks.local[mine])
        merge(self.bodies, tracks)

    def _follow_regions(self, frame: Frame) -> None:
        """Follow the regions that may move; one that has moved for certain becomes a body."""
        self._regions = follow_regions(self._regions, frame, self.tracks)
        for region in [r for r in self._regions if r.has_moved(frame)]:
            self._regions.remove(region)
            self._found(finder.region_group(frame, self.tracks, region), frame, far=True)

    def _found(self, group: finder.MovingGroup, frame: Frame, whole: int | None = None, far: bool = False) -> None:
        """Make a body of tracks with a common twist, or continue with them one that was out of view.

        That keeps its id, but not its points. Where the tracks belong to another body, both are merged later.

        Args:
            group: the tracks.
            frame: the present one.
            whole: id of the body that they are a part of, with a motion of their own; None for none.
            far: whether they were followed for farther than they are wide already.
        """
        tracks, members = self.tracks, group.members
        body = replace(group.body(self._next_body, frame, tracks), far=far)
        parts = {id: b for id, b in self.bodies.items() if whole is None or b.apart_from == whole}
        known = membership.reappeared(parts, body)
        if known is not None:
            tracks.give_up(np.flatnonzero(tracks.body == known.id))
            body = continued(body, known)
        self._next_body = max(self._next_body, body.id + 1)
        membership.add_members(body, tracks, members, sure=True)
        self.bodies[body.id] = with_extent(replace(body, apart_from=whole), tracks.local[members])

    def _prove(self, frame: Frame, scene: Scene) -> None:
        """Weigh what says that bodies move; those that do not for long, given how long they did, are dropped."""
        s, tracks = self.setup, self.tracks
        for body in list(self.bodies.values()):
            if not body.measured:
                continue
            members = np.flatnonzero((tracks.body == body.id) & tracks.seen)
            members = members[tracks.count(members) >= s.config.min_frames - 1]
            moved = displacements(tracks, members, frame.ages, frame.poses[:, :3, 3], s.slide)
            way = Way.of(body, frame)
            left = 0.0 if body.proven else by_left_image(tracks, members, frame, scene)
            evidence, counts = with_frame(body.evidence, moved, scene, way, left, body.far)
            certain = body.certain + counts
            body = replace(body, evidence=evidence, certain=certain, proven=body.proven or certain >= PROOF)
            self.bodies[body.id] = body
            if evidence == 0.0 if body.proven else body.seen >= membership.PROBATION:
                self._drop(body)

    def _drop(self, body: Body) -> None:
        """Let a body's tracks go; they stay suspected for a while, and need proof to become members of another one."""
        mine = np.flatnonzero(self.tracks.body == body.id)
        membership.remove_members(self.tracks, mine, body)
        self.tracks.expelled[mine] = True
        del self.bodies[body.id]

    def _begin_estimates(self, frame: Frame) -> None:
        """Begin the estimates of bodies that have none."""
        tracks = self.tracks
        for id, body in list(self.bodies.items()):
            if body.belief is None and body.measured:
                mine = np.flatnonzero((tracks.body == id) & tracks.seen)
                seen = observed(body, tracks, mine, tracks.row[mine], frame.features, body.T)
                belief = self._estimator.updated(None, id, seen, frame.cameras)
                self.bodies[id] = replace(body, belief=belief, measured_at=frame.features.stamp)

    def _begin_tracks(self, frame: Frame, landmark: IdArray) -> None:
        """New tracks at stereo features that continue none; give up tracks not seen for long."""
        tracks, f = self.tracks, frame.features
        tracks.give_up(np.flatnonzero((tracks.missed > self.setup.config.patience) & (tracks.body < 0)))
        taken = among(len(f), tracks.row[tracks.seen])
        rows = np.flatnonzero(~taken & np.isfinite(frame.local[:, 0]))
        ids = np.arange(self._next_track, self._next_track + len(rows), dtype=np.int64)
        self._next_track += len(rows)
        new = tracks.begin(ids, f, rows, transform(frame.T_world_left, frame.local[rows]))
        tracks.landmark[new] = landmark[rows]
        self._record(frame, new)
        fit_positions(tracks, new)

    def _motion_labels(self, frame: Frame) -> MotionLabels:
        tracks, n = self.tracks, len(frame.features)
        on, near = membership.tracks_on_bodies(self.bodies, tracks, self.setup.config.margin)
        proven = np.isin(tracks.body, [body.id for body in self.bodies.values() if body.proven])
        landmarks = np.unique(tracks.landmark[proven])
        tracks.landmark[proven] = -1
        moving = among(n, tracks.row[on])
        undecided = among(n, tracks.row[near]) | among(n, tracks.row[tracks.seen & tracks.doubtful])
        return MotionLabels(np.flatnonzero(moving), np.flatnonzero(undecided & ~moving), landmarks[landmarks >= 0])
