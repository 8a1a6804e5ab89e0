"""The estimation problem as it grows: records, factors, and the solver that is always up to date with them."""

from __future__ import annotations

import numpy as np

from backends.smoother import uncertainty
from backends.smoother.config import SmootherConfig
from backends.smoother.graph import FactorMaker, to_pose3
from backends.smoother.rebuild import optimise, pose_factor, whole_problem
from backends.smoother.records import IndexArray, Records, Track
from backends.smoother.solver import Change, Solver, SolverError
from backends.smoother.uncertainty import PoseSet
from backends.smoother.variables import landmark_key, landmark_threshold, pose_key, thresholds
from slam.data import IdArray
from slam.se3 import Array, transform

#: A landmark unseen for so many frames is seen again: a smart factor over the gap would touch all poses between.
_GAP = 20

#: Landmarks seen within so many frames are likely to be seen again.
_LATE = 60

#: What lies before the window is read back when the window's oldest pose has been revised by so much [m, or sine].
_STALE = 0.005


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
        self._moved = 0.0  # how far the window's oldest pose has been revised since all poses were read back
        self._window: PoseSet | None = None  # of the present state; None while it has not been asked for

    def append_pose(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame without measurements."""
        self.records.path.append(stamp, T_world_left)
        try:
            self._enter_pose(Change(), 1.0)
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
        change = Change()
        grown = self._grow(change, slots, rows, z)
        try:
            try:
                new = self._enter_pose(change, impulse)
                for track, place in grown:
                    track.factor = new[place]
            except SolverError:
                self._rebuild()
        except SolverError as error:
            self._take_back(slots, rows)
            self._recover()
            return str(error)
        marks.measured(slots, rows, frame)
        self._read_back(slots)
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

    def remove_landmarks(self, slots: IndexArray) -> None:
        """Take landmarks out of the map; what they have told about the poses stays known."""
        marks = self.records.landmarks
        for slot in slots.tolist():
            self._finish(marks.tracks[slot])
        marks.remove(slots)

    def window(self) -> PoseSet:
        """The newest poses with their joint covariance; computed once per state."""
        if self._window is None:
            count = self.records.path.count
            first = max(0, count - self._config.window)
            keys = [pose_key(i) for i in range(first, count)]
            try:
                P = self._solver.joint_covariance(keys)
            except SolverError:
                self._recover()
                P = self._solver.joint_covariance(keys)
            self._window = PoseSet(np.arange(first, count), self.records.path.poses[first:].copy(), P)
        return self._window

    def landmarks_by_window(self, slots: IndexArray) -> Array:
        """Jacobians (M, 3, 6 W) of landmark positions by the poses of the window."""
        return uncertainty.by_poses(self.window(), self.records.measurements, self.records.landmarks, slots)

    def settled_poses(self) -> Array:
        """All poses (F, 4, 4) as the solver has them now; those on record may lag a little behind."""
        count = self.records.path.count
        if not count:
            return np.zeros((0, 4, 4))
        values = self._solver.values()
        return np.array([values.atPose3(pose_key(i)).matrix() for i in range(count)])

    def settle(self) -> None:
        """Bring all poses and landmarks on record up to what the solver has."""
        path = self.records.path
        if path.count:
            path.poses[: path.count] = self.settled_poses()
            self._place(self.records.landmarks.used())
            self._moved = 0.0

    # --- factors ---

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
        variables, stereo, again = marks.variable[slots], np.isfinite(z[:, 2]), frame - marks.last[slots] > _GAP
        room = self._config.explicit - int((variables >= 0).sum())
        grown = []
        for i, (slot, variable) in enumerate(zip(slots.tolist(), variables.tolist())):
            row, point = int(rows[i]), make.point(z[i].tolist())
            if variable >= 0:
                explicit[variable].append(row)
                change.factors.add(make.explicit(point, key, variable))
                continue
            track = marks.tracks[slot]
            if again[i] and room <= 0:
                self._finish(track)
            track.append(row, point, key, bool(stereo[i]))
            if not track.informative:
                continue
            if track.factor >= 0:
                change.removed.append(track.factor)
            change.late[1].update(track.keys)
            if (again[i] or len(track) >= track.limit) and room > 0 and self._well_known(slot):
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
        history, marks = self.records.history, self.records.landmarks
        place = marks.position[slot].copy()
        distance = float(np.linalg.norm(place - self.records.path.poses[-1][:3, 3]))
        threshold = landmark_threshold(self._make.stereo, distance, self._config.relinearise)
        key = landmark_key(int(marks.serial[slot]), threshold)
        marks.variable[slot], history.explicit[key], history.places[key] = key, track.rows, place
        for point, pose in zip(track.points, track.keys):
            change.factors.add(self._make.explicit(point, pose, key))
        change.values.insert(key, place)
        track.restart()

    def _finish_tracks(self, slots: IndexArray) -> None:
        """Finish the smart factors that are long enough."""
        tracks = self.records.landmarks.tracks
        for slot in slots.tolist():
            if len(tracks[slot]) >= tracks[slot].limit:
                self._finish(tracks[slot])

    def _finish(self, track: Track) -> None:
        if track.informative:
            self.records.history.finished.append(np.array(track.rows))
        track.restart()

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
        if self._moved > _STALE:
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
        step, marks.covariance[slots] = uncertainty.position_step(E, residuals, marks.older[slots])
        marks.information[slots] = np.swapaxes(E, 2, 3) @ E
        return step

    # --- failures ---

    def _rebuild(self) -> None:
        """A new solver for all that is on record.

        Raises:
            SolverError: that cannot be solved either.
        """
        change, places = whole_problem(self._make, self.records)
        change.values = optimise(change)
        solver = Solver(self._thresholds)
        new = solver.update(change)
        for track in self.records.landmarks.tracks.values():
            track.factor = -1
        for track, place in places:
            track.factor = new[place]
        self._solver, self._window = solver, None
        self.settle()

    def _recover(self) -> None:
        """Rebuild; where not even that is possible, go on from the poses as they are, without what was measured."""
        try:
            self._rebuild()
        except SolverError:
            history = self.records.history
            history.finished, history.explicit, history.places = [], {}, {}
            for track in self.records.landmarks.tracks.values():
                track.restart()
            self.records.landmarks.variable[:] = -1
            self._rebuild()

    def _take_back(self, slots: IndexArray, rows: IndexArray) -> None:
        """Take the newest measurements out of the records again."""
        marks, measurements = self.records.landmarks, self.records.measurements
        measurements.landmark[rows] = -1
        for slot, row in zip(slots.tolist(), rows.tolist()):
            track = marks.tracks[slot]
            if marks.variable[slot] >= 0:
                self.records.history.explicit[int(marks.variable[slot])].remove(row)
            elif track.rows and track.rows[-1] == row:
                track.drop_last(bool(np.isfinite(measurements.z[row, 2])))
