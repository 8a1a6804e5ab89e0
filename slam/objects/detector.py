"""The detector of moving objects: tracks all features, judges which move, and keeps the bodies that they make up.

A step has two parts, called after the back end's update: `judge` says which features move, before any of them becomes
a landmark; `update` gives the bodies' observations to the back end and reports the bodies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.data import Estimate, IdArray, StereoFeatures
from slam.gating import chi_square_limits
from slam.interfaces import Backend, ObjectBackend
from slam.models import EstimatorModels
from slam.objects import membership
from slam.objects.bodies import Body, advanced, from_estimate, from_fit, new_body, with_extent
from slam.objects.clusters import displacements, judge_scene, limit
from slam.objects.config import ObjectsConfig
from slam.objects.data import Judgement, MovingObject, ObjectObservations
from slam.objects.following import follow
from slam.objects.measurement import View, measure, pose_information
from slam.objects.recovery import locate
from slam.objects.tracks import Tracks, fit, make_room, record
from slam.objects.twists import fit_twist
from slam.rig import StereoRig
from slam.se3 import Array, inverse, transform

_DEPTH = 0.5  # weight of log-depth against directions [rad], where tracks are clustered
_TRUST = 1.0  # a body is remembered for as long as it was seen, at most
_FARTHEST = 4.0  # a track's depth must be so many times its deviation
_LAG = 4  # frames between the older and the recent measurements, about


class MovingObjectDetector:
    """Finds moving bodies without being told.

    Args:
        rig: the cameras.
        config: settings.
        models: pixel noise and motion model of the estimators.
    """

    def __init__(self, rig: StereoRig, config: ObjectsConfig, models: EstimatorModels) -> None:
        self.rig = rig
        self.config = config
        self.sigma = models.pixel_sigma
        self.acceleration = models.motion.acceleration
        self.bodies: dict[int, Body] = {}
        self.tracks: Tracks | None = None
        self._stamps = np.full(config.window, np.nan)
        self._centres = np.zeros((config.window, 3))  # of the camera
        self._frame = -1
        self._next_track = 0
        self._next_body = 1
        self._forgotten: list[int] = []
        self._estimated: set[int] = set()  # bodies that the back end knows
        self._held = np.zeros(0, np.intp)
        self.suspects = np.zeros(0, np.int64)

    # ------------------------------------------------------------------------------------------- a step, first part

    def judge(
        self, features: StereoFeatures, estimate: Estimate, landmark: IdArray, used: NDArray[np.intp]
    ) -> Judgement:
        """Follow all tracks into this frame, judge them, and find bodies; see `slam.objects.modes.ObjectDetector`."""
        times = self._begin(features, estimate)
        view = self._view(estimate, features, used)
        self._advance_bodies(times)
        tracks = self.tracks
        assert tracks is not None
        follow(tracks, self.bodies, view, features, self._dt(times), self.rig, self.sigma, self.config)
        self._measure(tracks, features, view)
        seen = np.flatnonzero(tracks.seen)
        known = seen[landmark[tracks.row[seen]] >= 0]
        tracks.landmark[known] = landmark[tracks.row[known]]
        free = np.flatnonzero((tracks.body < 0) & tracks.seen)
        fit(tracks, free, times, self.config.max_speed, self._floor(times))
        self._change_members(times, view)
        self._find_bodies(times, view)
        self._begin_tracks(features, view, landmark)
        return self._judgement(features, view)

    def _begin(self, features: StereoFeatures, estimate: Estimate) -> Array:
        """Move on by a frame; times of the window's slots less the present (W,) [s], zero where there is none yet."""
        if self.tracks is None:
            self.tracks = Tracks.empty(features.descriptors.shape[1], self.config.window)
        self._frame += 1
        self._stamps[self.slot] = features.stamp
        self._centres[self.slot] = estimate.T_world_left[:3, 3]
        return np.nan_to_num(self._stamps - features.stamp)

    @property
    def slot(self) -> int:
        """The present frame's place in the window."""
        return self._frame % self.config.window

    def _dt(self, times: Array) -> float:
        """Time since the previous frame [s]."""
        return float(-times[(self.slot - 1) % self.config.window])

    def _floor(self, times: Array) -> float:
        """Standard deviation of a still point's apparent velocity that no noise explains [m/s]."""
        oldest = int(np.argmin(times))
        if times[oldest] == 0:
            return 0.0
        gone = np.linalg.norm(self._centres[self.slot] - self._centres[oldest])
        return float(self.config.speed_floor * gone / -times[oldest])

    def _view(self, estimate: Estimate, features: StereoFeatures, used: NDArray[np.intp]) -> View:
        """The camera's pose with the covariance that matters within the window.

        The drift that all frames of the window share cannot make a still point move. What differs from frame to frame
        is what this frame's landmarks leave open; where they are few, the estimate's own covariance takes over.
        """
        rows = used[features.has_stereo[used]]
        local = self.rig.triangulate(features.uv_left[rows], features.uv_right[rows])
        measured = pose_information(self.rig, local, np.ones(len(rows), bool), np.sqrt(2.0) * self.sigma)
        prior = np.linalg.inv(estimate.covariance + 1e-12 * np.eye(6))
        return View(estimate.T_world_left, np.linalg.inv(measured + prior))

    def _advance_bodies(self, times: Array) -> None:
        """Predict all bodies; forget those that were not seen for long."""
        now, dt = self._stamps[self.slot], self._dt(times)
        for body in list(self.bodies.values()):
            if now - body.seen_at > min(self.config.forget_after, _TRUST * body.seen * dt):
                self._forget(body.id)
            else:
                self.bodies[body.id] = advanced(body, dt, self.slot, self.acceleration)

    def _forget(self, id: int) -> None:
        assert self.tracks is not None
        del self.bodies[id]
        self._forgotten.append(id)
        self.tracks = self.tracks.select(self.tracks.body != id)

    # ------------------------------------------------------------------------------------------- measuring

    def _measure(self, tracks: Tracks, features: StereoFeatures, view: View) -> None:
        """Enter this frame's pixels into the tracks: free ones in world coordinates, others in their body's."""
        c = self.config
        views = {-1: view}
        for body in list(self.bodies.values()):
            located = locate(body, tracks, features, view, self.rig, self.sigma, c, self._frame)
            if located is not None:
                self.bodies[body.id] = replace(body.placed(located.T_world_object, self.slot), measured=True,
                                               seen_at=features.stamp, seen=body.seen + 1)  # fmt: skip
                views[body.id] = located.view
        make_room(tracks, self.slot)
        for frame, seen_from in views.items():
            mine = np.flatnonzero(tracks.seen & (tracks.body == frame))
            at = tracks.position[mine] if frame < 0 else tracks.local[mine]
            z = membership.measured(features, tracks.row[mine])
            record(tracks, mine, self.slot, *measure(self.rig, seen_from.T_frame_left, at, z, self.sigma))

    # ------------------------------------------------------------------------------------------- bodies and members

    def _find_bodies(self, times: Array, view: View) -> None:
        """Test every spatial cluster of free tracks against the rest; one that moves for long becomes a body."""
        c, tracks = self.config, self.tracks
        assert tracks is not None
        able = tracks.seen & (tracks.body < 0) & (tracks.count >= c.min_frames)
        local = transform(inverse(view.T_frame_left), tracks.position)
        depth_sigma = np.sqrt(np.maximum(np.trace(tracks.covariance, axis1=1, axis2=2), 0))
        able &= local[:, 2] > _FARTHEST * depth_sigma
        rows, local = np.flatnonzero(able), local[able]
        ages = (self.slot - np.arange(c.window)) % c.window
        moved = displacements(tracks, rows, ages, view.T_frame_left[:3, 3])
        place = np.column_stack([local[:, :2] / local[:, 2:], _DEPTH * np.log(local[:, 2])])
        scene = judge_scene(moved, place, c.suspect, c.min_support)
        tracks.moving &= ~able
        tracks.moving[rows] = (scene.alone > c.certain) & (tracks.residual[rows] < _residual_limit(tracks)[rows])
        tracks.doubtful &= ~able
        tracks.doubtful[rows] = scene.alone > c.doubtful
        alike = np.zeros(len(tracks), bool)
        suspects = [np.zeros(0, np.int64)]
        for members, test, away in zip(scene.clusters, scene.tests, scene.away):
            suspects.append(tracks.landmark[rows[members]])
            if test > limit(c.group_test, len(members)) and away > _LAG * self._dt(times) * c.min_speed:
                alike[rows[members]] = True
                self._perhaps_found(rows[members], times)
        tracks.streak = np.where(alike & (tracks.body < 0), tracks.streak + 1, 0)
        suspects.append(tracks.landmark[tracks.moving])
        self.suspects = np.concatenate(suspects)

    def _perhaps_found(self, members: NDArray[np.intp], times: Array) -> None:
        """Make a body of tracks that move alike, if they have done so for long enough."""
        c, tracks = self.config, self.tracks
        assert tracks is not None
        if (tracks.streak[members] + 1 >= c.confirm).sum() < c.min_support:
            return
        whose = membership.overlapped(self.bodies, tracks, members)
        if whose is not None:
            membership.enter(whose, tracks, members)
            return
        centre = tracks.position[members].mean(axis=0)
        weight = np.linalg.inv(tracks.velocity_covariance[members])
        twist, _ = fit_twist(tracks.position[members], tracks.velocity[members], weight, centre)
        body = new_body(self._next_body, centre, twist, times, self._stamps[self.slot])
        self._next_body += 1
        body = membership.found(body, tracks, members, times, self.slot)
        body = with_extent(body, tracks.local[members])
        membership.admit(body, tracks, self.slot, c)
        self.bodies[body.id] = with_extent(body, tracks.local[tracks.body == body.id])

    def _change_members(self, times: Array, view: View) -> None:
        """Tracks that fit a body better than the still world join it; those that do not fit it any more leave."""
        tracks = self.tracks
        assert tracks is not None
        for body in list(self.bodies.values()):
            mine = np.flatnonzero((tracks.body == body.id) & tracks.seen)
            fit(tracks, mine, times, self.config.max_speed, 0.0)
            membership.dismiss(body, tracks, mine, self.config)
            if body.measured:
                membership.admit(body, tracks, self.slot, self.config)
                if body.moving:
                    self.bodies[body.id] = with_extent(body, tracks.local[tracks.body == body.id])
                if membership.never_moved(body, view, self.rig.left.fu):
                    membership.leave(tracks, np.flatnonzero(tracks.body == body.id), body)
                    del self.bodies[body.id]
                    self._forgotten.append(body.id)

    def _begin_tracks(self, features: StereoFeatures, view: View, landmark: IdArray) -> None:
        """New tracks at stereo features that continue none; give up tracks not seen for long."""
        tracks = self.tracks
        assert tracks is not None
        taken = np.zeros(len(features), bool)
        taken[tracks.row[tracks.seen]] = True
        rows = np.flatnonzero(~taken & features.has_stereo)
        local = self.rig.triangulate(features.uv_left[rows], features.uv_right[rows])
        rows, local = rows[np.isfinite(local[:, 0])], local[np.isfinite(local[:, 0])]
        points = transform(view.T_frame_left, local)
        ids = np.arange(self._next_track, self._next_track + len(rows), dtype=np.int64)
        self._next_track += len(rows)
        new = Tracks.new(ids, features, rows, points, self.config.window)
        new.landmark[:] = landmark[rows]
        z = membership.measured(features, rows)
        p, A, dof = measure(self.rig, view.T_frame_left, points, z, self.sigma)
        record(new, np.arange(len(rows)), self.slot, p, A, dof)
        fit(new, np.arange(len(rows)), np.zeros(self.config.window), self.config.max_speed, 0.0)
        keep = (tracks.missed <= self.config.patience) | (tracks.body >= 0)
        self.tracks = tracks.select(keep).joined(new)

    def _judgement(self, features: StereoFeatures, view: View) -> Judgement:
        tracks = self.tracks
        assert tracks is not None
        c = self.config
        moving = tracks.seen & (tracks.moving | (tracks.body >= 0))
        self._held = membership.held(self.bodies, tracks, features, view, self.rig, self.sigma, self.config)
        landmarks = np.unique(tracks.landmark[(tracks.moving | (tracks.body >= 0)) & (tracks.landmark >= 0)])
        tracks.landmark[(tracks.moving | (tracks.body >= 0))] = -1
        decided = tracks.seen & (tracks.count >= c.min_frames) & ~tracks.doubtful
        undecided = np.ones(len(features), bool)
        undecided[tracks.row[decided]] = False
        moving_rows = np.unique(np.concatenate([tracks.row[moving], self._held]))
        return Judgement(moving_rows, np.flatnonzero(undecided), landmarks)

    # ------------------------------------------------------------------------------------------- a step, second part

    def update(self, backend: Backend, features: StereoFeatures) -> tuple[MovingObject, ...]:
        """Give the bodies' observations to the back end, and report what it makes of them; nothing where it cannot."""
        dt = self._dt(np.nan_to_num(self._stamps - features.stamp))
        if not isinstance(backend, ObjectBackend):
            for body in list(self.bodies.values()):
                if body.measured and body.estimate is None and dt > 0:
                    self.bodies[body.id] = from_fit(body, body.T, dt, self.slot)
            return ()
        known = {body.id for body in self.bodies.values() if body.estimate is not None}
        gone = [id for id in self._forgotten if id in self._estimated]
        if gone:
            backend.remove_objects(gone)
        self._forgotten.clear()
        observations = [self._observations(body, features) for body in self.bodies.values() if body.measured]
        fit_to_start = [o for o in observations if o.id in known or o.has_stereo.sum() >= 3]
        estimates = backend.update_objects(fit_to_start)
        self._estimated = {e.id for e in estimates}
        reported = []
        for estimate in estimates:
            body = self.bodies[estimate.id]
            body = from_estimate(body, estimate, self.slot, self.config.min_speed)
            self.bodies[body.id] = body
            membership.reject(self.tracks, estimate.rejected)
            reported.append(self._report(body))
        return tuple(reported)

    def _observations(self, body: Body, features: StereoFeatures) -> ObjectObservations:
        tracks = self.tracks
        assert tracks is not None
        mine = np.flatnonzero((tracks.body == body.id) & tracks.seen & (tracks.misfit == 0))
        rows = tracks.row[mine]
        return ObjectObservations(body.id, tracks.ids[mine], features.uv_left[rows], features.uv_right[rows], body.T)

    def _report(self, body: Body) -> MovingObject:
        tracks, estimate = self.tracks, body.estimate
        assert tracks is not None and estimate is not None
        rows = tracks.row[(tracks.body == body.id) & tracks.seen]
        T = estimate.T_world_object
        return MovingObject(
            body.id, np.sort(rows), estimate, T @ inverse(body.T_reported), T @ inverse(body.T_found),
            np.stack([body.lower, body.upper]), body.moving,
        )  # fmt: skip


def _residual_limit(tracks: Tracks) -> Array:
    """Largest χ² per degree of freedom that an even motion may leave (N,): 99.9 %."""
    dof = np.maximum(tracks.dof.sum(axis=1).astype(int) - 6, 1)
    return chi_square_limits(dof, 0.999) / dof
