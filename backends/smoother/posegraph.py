"""The estimation problem as it grows: records, factors, and the solver that is always up to date with them."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from backends.smoother import uncertainty
from backends.smoother.config import SmootherConfig
from backends.smoother.graph import FactorMaker, to_pose3
from backends.smoother.lag import FixedLag
from backends.smoother.prediction import carried_covariance
from backends.smoother.rebuild import optimise, pose_factor, whole_problem
from backends.smoother.records import IndexArray, Known, Records, Track
from backends.smoother.solver import Change, Solver, SolverError
from backends.smoother.uncertainty import PoseSet, WindowJacobians
from backends.smoother.variables import landmark_key, landmark_threshold, pose_key, thresholds
from slam.data import IdArray
from slam.se3 import Array, transform

#: A landmark unseen for so many frames is seen again: a smart factor over the gap would touch all poses between.
_GAP = 20

#: Landmarks seen within so many frames are likely to be seen again.
_LATE = 60

#: What lies before the window is read back when the window's oldest pose has been revised by so much [m, or sine].
_STALE = 0.005

#: Reading all back takes time in proportion to the run, so it waits for this share of the run, unless the revision is
#: so many times as large.
_SELDOM, _AT_ONCE = 0.01, 20


class PoseGraph:
    """Poses, landmarks and their factors in ISAM2.

    A landmark is a smart factor that grows with each measurement. When its track is long enough the factor is
    finished: the landmark becomes a variable with a factor for each measurement, as long as few of those in view are,
    or else goes on in a new smart factor. No measurement is ever used twice.

    Args:
        make: makes the factors.
        config: limits and thresholds.

    Attributes:
        records: poses, measurements and landmarks as they are believed now.
    """

    def __init__(self, make: FactorMaker, config: SmootherConfig) -> None:
        self.records = Records()
        self._make = make
        self._config = config
        self._thresholds = thresholds(make.stereo, config.relinearise)
        self._solver = Solver(self._thresholds)
        self._lag = None if config.lag is None else FixedLag(self.records, config.lag)
        self._moved = 0.0  # how far the window's oldest pose has been revised since all poses were read back
        self._settled = 0  # number of frames then
        self._window: PoseSet | None = None  # of the present state; None while it has not been asked for
        self._last_window: PoseSet | None = None  # the one before
        self._carried: WindowJacobians | None = None

    @property
    def solver_seconds(self) -> float:
        """CPU time spent in the incremental solver since it was last made anew."""
        return self._solver.seconds

    def append_pose(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame without measurements."""
        self.records.path.append(stamp, T_world_left)
        try:
            self._enter_pose(self._change(), 1.0)
        except SolverError:
            self._recover()

    def append_measured_pose(
        self, stamp: float, T_world_left: Array, slots: IndexArray, z: Array, impulse: float
    ) -> str:
        """Add a frame with measurements (M, 3) of landmarks.

        Args:
            stamp: time [s].
            T_world_left: first value of the pose (4, 4), near the solution.
            slots: landmarks (M,).
            z: their measurements (M, 3).
            impulse: factor on the standard deviation of the motion's impulse.

        Returns:
            what failed, in one line; empty if nothing did. After a failure the frame stands without measurements.
        """
        marks, frame = self.records.landmarks, self.records.path.count
        self.records.path.append(stamp, T_world_left)
        rows = self.records.measurements.append(z, frame, marks.serial[slots])
        change = self._change()
        grown = self._grow(change, slots, rows, z)
        try:
            try:
                new = self._enter_pose(change, impulse)
                for track, place in grown:
                    track.factor = new[place]
            except SolverError:
                self._rebuild()
        except SolverError as error:
            self.records.take_back(slots, rows)
            self._recover()
            return str(error)
        marks.measured(slots, rows, frame)
        try:
            self._read_back(slots)
        except SolverError:
            self._recover()
        self._finish_tracks(slots)
        return ""

    def add_landmarks(self, ids: IdArray, z: Array, local: Array) -> None:
        """Take in landmarks at their first sight, at `local` (M, 3) in the newest camera's coordinates."""
        path, marks, frame = self.records.path, self.records.landmarks, self.records.path.count - 1
        limits = [self._config.track + i % self._config.track for i in ids.tolist()]
        slots = marks.add(ids, transform(path.poses[-1], local), frame, limits)
        rows = self.records.measurements.append(z, frame, marks.serial[slots])
        marks.measured(slots, rows, frame)
        key = pose_key(frame)
        for slot, row, zi in zip(slots.tolist(), rows.tolist(), z.tolist()):
            marks.tracks[slot].append(row, self._make.point(zi), key, stereo=True)
        self._linearise(slots)

    def add_known(self, ids: IdArray, positions: Array, covariances: Array, frame: int | None = None) -> None:
        """Take in landmarks of which much is known, at `positions` (M, 3) with covariances (M, 3, 3).

        In world coordinates, or in the camera's of a frame. They become variables when they are first measured.
        """
        path, marks, newest = self.records.path, self.records.landmarks, self.records.path.count - 1
        T = np.eye(4) if frame is None else path.poses[frame]
        slots = marks.add(ids, transform(T, positions), newest, [self._config.track] * len(ids))
        marks.covariance[slots] = T[:3, :3] @ covariances @ T[:3, :3].T
        information = np.linalg.inv(marks.covariance[slots])
        if frame is None:
            marks.mean[slots], marks.prior[slots] = positions, information
        else:
            marks.older[slots] = information
        for serial, position, covariance in zip(marks.serial[slots].tolist(), positions, covariances):
            self.records.history.known[serial] = Known(position.copy(), covariance.copy(), frame)
        self._carried = None

    def remove_landmarks(self, slots: IndexArray) -> None:
        """Take landmarks out of the map; what they have told about the poses stays known."""
        marks = self.records.landmarks
        for slot in slots.tolist():
            self.records.finish(marks.tracks[slot])
        marks.remove(slots)

    def window(self) -> PoseSet:
        """The newest poses with their joint covariance; computed once per state."""
        if self._window is None:
            count = self.records.path.count
            frames = np.arange(max(0, count - self._config.window), count)
            P = self._joint_covariance(frames) if count else np.zeros((0, 0))
            self._window = PoseSet(frames, self.records.path.poses[frames], P)
            self._last_window = self._window if count else None
        return self._window

    def _joint_covariance(self, frames: IndexArray) -> Array:
        """Joint covariance of poses; where the solver cannot give it, the last one carried on by the motion model."""
        keys = [pose_key(i) for i in frames.tolist()]
        try:
            return self._solver.joint_covariance(keys)
        except SolverError:
            self._recover()
        try:
            return self._solver.joint_covariance(keys)
        except SolverError:
            return carried_covariance(self._make.models, self.records.path, self._last_window, frames)

    def landmarks_by_window(self, slots: IndexArray) -> Array:
        """Jacobians (M, 3, 6 W) of landmark positions by the poses of the window."""
        window, marks = self.window(), self.records.landmarks
        if self._carried is None or self._carried.window is not window:
            self._carried = WindowJacobians(window, len(marks.ids))
        return self._carried.of(self.records.measurements, marks, slots)

    def settled_poses(self) -> Array:
        """All poses (F, 4, 4) as the solver has them now; those on record may lag a little behind."""
        try:
            return self._solved_poses()
        except SolverError:
            self._recover()
            return self.records.path.poses.copy()

    def settle(self) -> None:
        """Bring all poses and landmarks on record up to what the solver has."""
        path = self.records.path
        if path.count:
            path.poses[:] = self._solved_poses()
            if self.records.measurements.count:
                self._place(self.records.landmarks.used())
            self._moved, self._settled = 0.0, path.count

    def _solved_poses(self) -> Array:
        """All poses, those that are variables as the solver has them."""
        poses = self.records.path.poses.copy()
        first = 0 if self._lag is None else self._lag.first
        if len(poses):
            values = self._solver.values()
            poses[first:] = [values.atPose3(pose_key(i)).matrix() for i in range(first, len(poses))]
        return poses

    # --- factors ---

    def _change(self) -> Change:
        """The change that comes with the newest pose, empty but for what leaves."""
        change = Change()
        if self._lag is not None:
            self._lag.advance(change)
        return change

    def _enter_pose(self, change: Change, impulse: float) -> list[int]:
        """Add the newest pose with its prior or motion to the change, and solve; returns the new factors' slots."""
        path = self.records.path
        i = path.count - 1
        if i >= 3:
            self._eliminate_late(change)
        self.records.history.impulses.append(impulse)
        change.values.insert(pose_key(i), to_pose3(path.poses[i]))
        change.factors.add(pose_factor(self._make, path, i, impulse))
        self._window = None
        return self._solver.update(change)

    def _eliminate_late(self, change: Change) -> None:
        """Have the landmarks of late eliminated late, and the newest poses last."""
        marks, frame = self.records.landmarks, self.records.path.count - 1
        landmarks, poses = change.late
        poses.update(pose_key(i) for i in range(max(0, frame + 1 - self._config.window), frame + 1))
        recent = (marks.variable >= 0) & (marks.last > frame - _LATE)
        landmarks.update(marks.variable[recent].tolist())

    def _grow(self, change: Change, slots: IndexArray, rows: IndexArray, z: Array) -> list[tuple[Track, int]]:
        """Put measurements into factors; returns tracks with the places of their new smart factors in the change."""
        make, marks, frame = self._make, self.records.landmarks, self.records.path.count - 1
        key, explicit = pose_key(frame), self.records.history.explicit
        self._enter_known(change, slots)
        variables, again = marks.variable[slots], (frame - marks.last[slots] > _GAP).tolist()
        room = self._config.explicit - int((variables >= 0).sum())
        grown = []
        columns = (slots.tolist(), variables.tolist(), rows.tolist(), z.tolist(), np.isfinite(z[:, 2]).tolist(), again)
        for slot, variable, row, zi, stereo, long_unseen in zip(*columns):
            point = make.point(zi)
            if variable >= 0:
                explicit[variable].append(row)
                change.factors.add(make.explicit(point, key, variable))
                continue
            track = marks.tracks[slot]
            if long_unseen and room <= 0:
                self.records.finish(track)
            track.append(row, point, key, stereo)
            if not track.informative:
                continue
            if track.factor >= 0:
                change.removed.append(track.factor)
            change.late[1].update(track.keys)
            if (long_unseen or len(track) >= track.limit) and room > 0 and self._well_known(slot):
                room -= 1
                self._make_variable(change, slot, track)
                continue
            grown.append((track, change.factors.size()))
            change.factors.add(make.smart(track.points, track.keys))
        return grown

    def _well_known(self, slot: int) -> bool:
        """Whether a landmark's position is known to a tenth of its distance: else it is no good as a variable."""
        marks = self.records.landmarks
        offset = marks.position[slot] - self.records.path.poses[-1][:3, 3]
        return bool(np.trace(marks.covariance[slot]) < 0.01 * (offset @ offset))

    def _make_variable(self, change: Change, slot: int, track: Track) -> None:
        """Give a landmark a variable of its own, with all that its track holds."""
        key = self._new_variable(change, slot)
        self.records.history.explicit[key] = track.rows
        for point, pose in zip(track.points, track.keys):
            change.factors.add(self._make.explicit(point, pose, key))
        track.restart()

    def _known(self, slot: int) -> Known | None:
        """What was known of a landmark beforehand, as long as what it hangs on is in the solver."""
        known = self.records.history.known.get(int(self.records.landmarks.serial[slot]))
        gone = known is not None and known.frame is not None and self._lag is not None and known.frame < self._lag.first
        return None if gone else known

    def _enter_known(self, change: Change, slots: IndexArray) -> None:
        """Give landmarks that were known beforehand variables of their own, where they have none yet."""
        if not self.records.history.known:
            return
        marks = self.records.landmarks
        for slot in slots[marks.variable[slots] < 0].tolist():
            known = self._known(slot)
            if known is None or len(marks.tracks[slot]):
                continue
            key = self._new_variable(change, slot)
            change.factors.add(self._make.known(key, known))
            if known.frame is not None:
                change.late[1].add(pose_key(known.frame))
            self.records.history.explicit[key] = []

    def _new_variable(self, change: Change, slot: int) -> int:
        """A variable for a landmark, placed where the landmark is believed to be."""
        history, marks = self.records.history, self.records.landmarks
        place = marks.position[slot].copy()
        distance = float(np.linalg.norm(place - self.records.path.poses[-1][:3, 3]))
        threshold = landmark_threshold(self._make.stereo, distance, self._config.relinearise)
        key = landmark_key(history.variables, threshold)
        history.variables += 1
        marks.variable[slot], history.places[key] = key, place
        change.values.insert(key, place)
        if self._lag is not None:
            self._lag.enter(key)
        return key

    def _finish_tracks(self, slots: IndexArray) -> None:
        """Finish the smart factors that are long enough."""
        marks = self.records.landmarks
        for slot in slots[marks.variable[slots] < 0].tolist():
            track = marks.tracks[slot]
            if len(track.rows) >= track.limit:
                self.records.finish(track)

    # --- the way back from the solver ---

    def _read_back(self, slots: IndexArray) -> None:
        """Poses of the window and the landmarks just measured, as the solver has them now.

        What lies further back changes seldom: it follows once the window's oldest pose has been revised by as much as
        makes the solver linearise anew.
        """
        path = self.records.path
        first = max(0, path.count - self._config.window)
        before = path.poses[first].copy()
        path.poses[first:] = self._solver.poses(pose_key(i) for i in range(first, path.count))
        self._moved += float(np.abs(path.poses[first] - before).max())
        waited = path.count - self._settled >= _SELDOM * path.count
        if self._moved > (_STALE if waited else _AT_ONCE * _STALE):
            self.settle()
        else:
            self._place(slots)

    def _place(self, slots: IndexArray) -> None:
        """Positions of landmarks that fit the poses on record."""
        marks = self.records.landmarks
        variables = marks.variable[slots]
        explicit = variables >= 0
        marks.position[slots[explicit]] = self._solver.points(variables[explicit].tolist())
        marks.position[slots[~explicit]] += self._linearise(slots)[~explicit]

    def _linearise(self, slots: IndexArray) -> Array:
        """Covariances of landmarks by their recent measurements; returns steps (M, 3) to better positions."""
        r, marks = self.records, self.records.landmarks
        E, residuals = uncertainty.linearise(
            self._make.stereo,
            self._make.sigma,
            r.path.poses,
            r.measurements,
            marks.position[slots],
            marks.recent[slots],
        )
        offset = marks.mean[slots] - marks.position[slots]
        step, marks.covariance[slots] = uncertainty.position_step(
            E, residuals, marks.older[slots], marks.prior[slots], offset
        )
        marks.information[slots] = np.swapaxes(E, 2, 3) @ E
        self._carried = None
        return step

    # --- failures ---

    def _recover(self) -> None:
        """Rebuild; where the problem has no solution, as it stands; where not even that, without what was measured.

        Where the solver takes nothing at all, it stays broken, and the next step tries again.
        """
        for solved, forget in ((True, False), (False, False), (False, True)):
            if forget:
                self.records.forget_measurements()
            with suppress(SolverError):
                self._rebuild(solved)
                return

    def _rebuild(self, solved: bool = True) -> None:
        """A new solver for all that is on record, solved as a whole first.

        Raises:
            SolverError: that cannot be solved either.
        """
        change, places = whole_problem(self._make, self.records)
        if solved:
            change.values = optimise(change)
        solver = Solver(self._thresholds)
        new = solver.update(change)
        for track in self.records.landmarks.tracks.values():
            track.factor = -1
        for track, place in places:
            track.factor = new[place]
        self._solver, self._window = solver, None
        if self._lag is not None:
            self._lag.restart()
        self.settle()
