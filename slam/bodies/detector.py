"""The detector of moving objects: tracks all features, says which move, and estimates the bodies that they form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter

import numpy as np

from slam.bodies import finder, membership
from slam.bodies.bodies import (
    Body,
    advanced,
    continued,
    hidden,
    of_bodies,
    reported,
    returned,
    with_belief,
    with_evidence,
    with_extent,
)
from slam.bodies.config import CLEAR, MIN_FRAMES, RUN, WINDOW, ObjectsConfig
from slam.bodies.estimator import FRAMES, BodyEstimator
from slam.bodies.finder import Scene, parting
from slam.bodies.fits import fit, fit_positions, record, revise_tracks
from slam.bodies.following import follow, found_again, located, observed
from slam.bodies.frame import NO_IDS, Frame, Setup
from slam.bodies.membership import merge
from slam.bodies.proof import Way, with_frame
from slam.bodies.regions import Region, follow_regions
from slam.data import BoolArray, Estimate, IdArray, IndexArray, RecentPoses, StereoFeatures
from slam.geometry.arrays import among, changed, isin, median
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.models import EstimatorModels
from slam.object_data import MotionLabels, MovingObject
from slam.third_party import OnlinePose, derived_recent
from slam.tracks.alignment import Aligner, shifted_as
from slam.tracks.table import Tracks

_FORGOTTEN = 8.0  # [s] after which an unseen body is forgotten


class ObjectDetector:
    """What the system asks of a detector of moving objects in every step; by itself it takes everything for still.

    `parting` and `suspects` are asked before the back end's update, `step` comes after it.
    """

    #: Number of frames for which the table of tracks keeps what it measured.
    window: int = 0
    #: Ids of landmarks that may move: they do not measure the camera's next pose.
    suspects: IdArray = np.zeros(0, np.int64)

    def parting(
        self, tracks: Tracks, features: StereoFeatures, at: IndexArray, rows: IndexArray, T_world_left: Array
    ) -> IdArray:
        """Ids of landmarks that may have begun to move: of those `at` rows of the table (K,), found as `rows` (K,).

        The table is as the last frame left it, the pose (4, 4) that before the back end's update.
        """
        return np.zeros(0, np.int64)

    def restart(self) -> None:
        """Forget all tracks and bodies, after a kidnapping for instance; ids are not used again."""

    def revise(self, tracks: Tracks, correct: Callable[[Array], Array]) -> None:
        """Take note that `correct` takes rectified rows (uL, vL, uR) (N, 3) [px] of before to what they are now."""

    def step(
        self, recent: RecentPoses | None, tracks: Tracks, features: StereoFeatures, estimate: Estimate,
        still: IndexArray, measured: StereoFeatures, aligner: Aligner | None,
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Say which features move, before any of them becomes a landmark, and report the bodies.

        The table changes in place; landmarks that were found have their feature already. `estimate` is that after the
        update, `recent` the last poses if the back end knows how their errors hang together, `still` are rows of
        features that stay at their pixels while the camera stands. `measured` are the features before the calibration
        corrected them: those of proven bodies are moved by the `aligner`, where there is one.
        """
        none = np.zeros(0, np.intp)
        return MotionLabels(none, none, np.zeros(0, np.int64)), ()


class MovingObjectDetector(ObjectDetector):
    """Finds moving bodies without being told; `models` say how noisy pixels are, and how bodies move."""

    def __init__(self, rig: StereoRig, config: ObjectsConfig, models: EstimatorModels) -> None:
        self.setup = Setup(rig, config, models.objects, models.pixel_sigma)
        self.window = WINDOW
        self._estimator = BodyEstimator(rig, models)
        self._next_track = 0
        self._next_body = 1
        self.restart()

    def restart(self) -> None:
        """See `ObjectDetector`."""
        window = self.window
        self.bodies: dict[int, Body] = {}
        self.suspects = NO_IDS
        self._stamps = np.full(window, np.nan)
        self._poses = np.tile(np.eye(4), (window, 1, 1))  # of the left camera in the window's frames
        self._number = -1
        self._path: list[OnlinePose] = []
        self._regions: list[Region] = []

    def revise(self, tracks: Tracks, correct: Callable[[Array], Array]) -> None:
        """See `ObjectDetector`."""
        if self._number >= 0:
            slot = self._number % self.window
            revise_tracks(tracks, self.bodies, self._poses, slot, self.setup.rig, correct)

    def parting(
        self, tracks: Tracks, features: StereoFeatures, at: IndexArray, rows: IndexArray, T_world_left: Array
    ) -> IdArray:
        """See `ObjectDetector`; a landmark stays in doubt for some frames."""
        followed = tracks.number[at] >= 0
        at, rows, now = at[followed], rows[followed], self._number + 1
        if not now:
            return NO_IDS
        parts = parting(self.setup, tracks, now, self._poses[:, :3, 3], features, at, rows, T_world_left)
        tracks.parted[parts] = 1 + RUN if now >= WINDOW else 1
        return np.sort(tracks.ids[(tracks.ids >= 0) & (tracks.parted > 0)])

    def step(
        self, recent: RecentPoses | None, tracks: Tracks, features: StereoFeatures, estimate: Estimate,
        still: IndexArray = NO_IDS, measured: StereoFeatures | None = None, aligner: Aligner | None = None,
    ) -> tuple[MotionLabels, tuple[MovingObject, ...]]:  # fmt: skip
        """Follow all tracks into this frame, test them, and find bodies; see `ObjectDetector`."""
        frame = self._begin(recent, tracks, features, estimate)
        self._advance_bodies(tracks, frame)
        follow(tracks, self.bodies, frame)
        if measured is not None and aligner is not None:
            frame, measured = self._aligned(tracks, frame, measured, aligner)
        self._measure(tracks, frame)
        np.maximum(tracks.parted - 1, 0, out=tracks.parted)
        tracks.still[:] = tracks.found & among(max(len(frame.local), 1), still)[tracks.row]
        self._fit(tracks, frame)
        self._change_members(tracks, frame)
        scenes, suspects, groups = finder.find_groups(frame, tracks, self.bodies)
        for group in groups:
            moving = finder.lasting(group, tracks, frame)
            new = finder.moving_group(frame, tracks, moving) if len(moving) else None
            if new is not None:
                self._found(*new, tracks, group[0])
        if self.setup.config.size > 0:  # nothing gains by it where bodies are resolved, see `slam.bodies.regions`
            self._regions, moved = follow_regions(self._regions, frame, tracks)
            for region in moved:
                self._found(region.rows, finder.body_of_region(frame, tracks, region), tracks, far=True)
        self._prove(tracks, frame, scenes)
        proven = of_bodies(tracks, (body for body in self.bodies.values() if body.proven))
        unproven = (tracks.body >= 0) & ~proven
        expelled = np.flatnonzero(tracks.expelled & tracks.found)
        # of a body that was dropped: nothing is known of these until a group could be found
        unproven[expelled[tracks.count(expelled) < MIN_FRAMES + RUN]] = True
        suspected = np.concatenate([tracks.ids[suspects], tracks.ids[unproven]])
        self.suspects = np.unique(suspected[suspected >= 0])
        self._begin_estimates(tracks, frame)
        if measured is not None and aligner is not None:
            self._take_patches(tracks, frame, measured, aligner)
        self._begin_tracks(tracks, frame)
        return self._motion_labels(tracks, frame, proven), reported(self.bodies, tracks, frame.slot)

    def _begin(self, recent: RecentPoses | None, tracks: Tracks, features: StereoFeatures, estimate: Estimate) -> Frame:
        """Move on by a frame; nothing is followed into the first one."""
        s = self.setup
        self._number += 1
        if self._number == 0:
            tracks.number[:], tracks.body[:], tracks.dof[:] = -1, -1, 0
        slot = self._number % WINDOW
        self._stamps[slot], self._poses[slot] = features.stamp, estimate.T_world_left
        local = s.rig.triangulate(features.uv_left, features.uv_right)
        measured = among(len(local), tracks.row[tracks.row >= 0])
        measuring = local[measured & np.isfinite(local[:, 0])]
        self._path = [*self._path[-FRAMES:], OnlinePose(s.rig, s.sigma, estimate, measuring)]
        cameras = recent
        if cameras is None or len(cameras) < len(self._path):  # as of a back end that has corrected its past
            cameras = derived_recent(self._path)
        return Frame(s, self._number, features, local, self._stamps.copy(), self._poses.copy(), cameras)

    def _advance_bodies(self, tracks: Tracks, frame: Frame) -> None:
        """Predict all bodies; forget those not seen for long, and those gone before they were proven."""
        now, dt = frame.features.stamp, frame.dt
        for body in list(self.bodies.values()):
            if now - body.seen_at > _FORGOTTEN or (body.gone and not body.proven):
                del self.bodies[body.id]
                tracks.give_up(np.flatnonzero(tracks.body == body.id))
            else:
                self.bodies[body.id] = advanced(body, dt, frame.slot, self.setup.models)

    def _aligned(
        self, tracks: Tracks, frame: Frame, measured: StereoFeatures, aligner: Aligner
    ) -> tuple[Frame, StereoFeatures]:
        """The frame and its measured features, those of bodies' members aligned with earlier images."""
        now = measured
        for body in filter(attrgetter("proven"), self.bodies.values()):
            mine = np.flatnonzero((tracks.body == body.id) & tracks.found)
            T = inverse(body.T) @ frame.T_world_left
            now = aligner.align(now, tracks.row[mine], tracks, mine, T, tracks.local[mine], body.id)
        if now is measured:
            return frame, measured
        features = shifted_as(frame.features, measured, now)
        local = frame.setup.rig.triangulate(features.uv_left, features.uv_right)
        return changed(frame, features=features, local=local), now

    def _take_patches(self, tracks: Tracks, frame: Frame, measured: StereoFeatures, aligner: Aligner) -> None:
        """Members of measured bodies that have no image patch yet get one."""
        for body in self.bodies.values():
            if body.proven and body.belief is not None and body.belief.estimate.measured:
                used = isin(tracks.number, body.belief.estimate.used)
                mine = np.flatnonzero((tracks.body == body.id) & tracks.found & used)
                T = inverse(body.T) @ frame.T_world_left
                aligner.take_patches(measured, tracks.row[mine], tracks, mine, T, body.id)

    def _measure(self, tracks: Tracks, frame: Frame) -> None:
        """Estimate the bodies, and add this frame's measurements to the tracks, in world coordinates."""
        for body in list(self.bodies.values()):
            body = self.bodies[body.id] = self._estimated(body, tracks, frame)
            mine = np.flatnonzero(tracks.body == body.id)
            tracks.position[mine] = transform(body.T, tracks.local[mine])
        unfound = np.flatnonzero((tracks.number >= 0) & (tracks.row < 0))
        for column in (tracks.A, tracks.p, tracks.dof):  # what the slot held leaves the window
            column[unfound, frame.slot] = 0
        record(tracks, np.flatnonzero(tracks.found), frame)

    def _estimated(self, body: Body, tracks: Tracks, frame: Frame) -> Body:
        """The body after this frame."""
        slot, stamp = frame.slot, frame.features.stamp
        T = found_again(body, tracks, frame) if body.gone else None
        if T is not None:
            return returned(body, T, slot, stamp)
        front = [b for b in self.bodies.values() if b.proven and not b.gone and b.id != body.id]
        if front:
            mine = np.flatnonzero((tracks.body == body.id) & tracks.found)
            tracks.row[mine[hidden(front, frame.eye, tracks.position[mine])]] = -1
        belief = located(body, tracks, frame, self._estimator)
        if belief is None or not self.setup.models.known(belief.estimate):  # it begins anew once it is found again
            return changed(body, belief=None)
        return with_belief(body, belief, slot, stamp, self.setup.config.min_speed)

    def _fit(self, tracks: Tracks, frame: Frame) -> None:
        """Positions of free tracks, and velocities of those that may move."""
        free = np.flatnonzero((tracks.body < 0) & tracks.found)
        fit(tracks, free, frame.times, self.setup.config.max_speed)

    def _change_members(self, tracks: Tracks, frame: Frame) -> None:
        """Update the bodies' members; bodies that do not move are dropped."""
        said = membership.update_members(self.bodies, frame, tracks)
        for id, body in list(self.bodies.items()):
            gains, against = said.get(id, (np.zeros(0), 0))
            typical = median(gains) if len(gains) else 0.0
            body = self.bodies[id] = with_evidence(body, typical, int((gains > CLEAR).sum()), against)
            if id in said and typical <= 0 and not body.proven:
                self._drop(tracks, body)
            elif id in said:
                mine = np.flatnonzero((tracks.body == id) & tracks.sure)
                self.bodies[id] = with_extent(body, tracks.local[mine])
        merge(self.bodies, tracks)

    def _found(
        self, members: IndexArray, body: Body, tracks: Tracks, whole: int | None = None, far: bool = False
    ) -> None:
        """Keep a new body of tracks `members` (K,), or continue with it one that was out of view under its id.

        `whole` is the body that they are a part of, with a motion of their own; `far` says that they were followed for
        farther than they are wide already.
        """
        body = changed(body, id=self._next_body, far=far)
        known = membership.reappeared(self.bodies, body, self.setup.config.max_speed, whole)
        if known is not None:
            tracks.give_up(np.flatnonzero(tracks.body == known.id))
            body = continued(body, known)
        self._next_body = max(self._next_body, body.id + 1)
        membership.add_members(body, tracks, members, sure=True)
        self.bodies[body.id] = with_extent(changed(body, apart_from=whole), tracks.local[members])

    def _prove(self, tracks: Tracks, frame: Frame, scenes: Mapping[int | None, Scene]) -> None:
        """Weigh what says that bodies move; those that do not for long, given how long they did, are dropped."""
        for body in list(self.bodies.values()):
            whole = self.bodies.get(-1 if body.apart_from is None else body.apart_from)
            if not body.measured or (whole is not None and whole.id not in scenes):
                continue
            members = np.flatnonzero((tracks.body == body.id) & tracks.found)
            both = (tracks.dof[members] == 3).sum() / max(tracks.count(members).sum(), 1)
            members = members[tracks.count(members) >= MIN_FRAMES - 1]
            scene = scenes[None if whole is None else whole.id]
            moved, way = finder.moved_in(whole, tracks, members, frame), Way.of(body, frame, whole)
            far = body.far or (self.setup.config.size > 0 and body.went > body.across)
            evidence, counts = with_frame(body.evidence, moved, scene, way, far, both)
            body = changed(body, evidence=evidence, certain=body.certain + counts, far=far)
            self.bodies[body.id] = body
            if evidence == 0.0 if body.proven else body.seen >= 2 * WINDOW:  # the first holds how it started
                self._drop(tracks, body)

    def _drop(self, tracks: Tracks, body: Body) -> None:
        """Let a body's tracks go; they stay suspected for a while, and need proof to become members of another one."""
        mine = np.flatnonzero(tracks.body == body.id)
        membership.remove_members(tracks, mine, body)
        tracks.expelled[mine] = True
        del self.bodies[body.id]

    def _begin_estimates(self, tracks: Tracks, frame: Frame) -> None:
        """Begin the estimates of bodies that have none."""
        for id, body in list(self.bodies.items()):
            if body.belief is None and body.measured:
                mine = np.flatnonzero((tracks.body == id) & tracks.found)
                seen = observed(body, tracks, mine, frame.features)
                belief = self._estimator.updated(None, id, seen, frame.cameras)
                self.bodies[id] = changed(body, belief=belief)

    def _begin_tracks(self, tracks: Tracks, frame: Frame) -> None:
        """Follow landmarks and stereo features that are not followed yet; give up what was not found for long."""
        f, deep = frame.features, np.isfinite(frame.local[:, 0])
        lost = (tracks.number >= 0) & (tracks.body < 0) & (tracks.unfound > RUN)
        tracks.give_up(np.flatnonzero(lost))
        found = np.flatnonzero(tracks.row >= 0)
        anew = found[(tracks.number[found] < 0) & deep[tracks.row[found]]]
        rows = np.flatnonzero(~among(len(deep), tracks.row[found]) & deep)
        unused = np.flatnonzero(~tracks.used)[: len(rows)]
        tracks.row[unused] = rows
        new = np.concatenate([anew, unused])
        numbers = np.arange(self._next_track, self._next_track + len(new))
        self._next_track += len(new)
        tracks.begin(new, numbers, f, transform(frame.T_world_left, frame.local[tracks.row[new]]))
        record(tracks, new, frame)
        fit_positions(tracks, new)

    def _motion_labels(self, tracks: Tracks, frame: Frame, proven: BoolArray) -> MotionLabels:
        n = len(frame.local)
        on, near = membership.tracks_on_bodies(self.bodies, tracks)
        moving = among(n, tracks.row[on])
        undecided = among(n, np.append(tracks.row[near], tracks.row[tracks.found & tracks.doubtful]))
        landmarks = np.sort(tracks.ids[proven & (tracks.ids >= 0)])
        return MotionLabels(np.flatnonzero(moving), np.flatnonzero(undecided & ~moving), landmarks)
