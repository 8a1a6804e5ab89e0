"""The estimation problem as it grows: records, factors, and the solver that is always up to date with them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from backends.smoother import recovery, uncertainty
from backends.smoother.config import SmootherConfig
from backends.smoother.factor_builder import FactorBuilder
from backends.smoother.graph import FactorMaker, to_pose3
from backends.smoother.lag import held_pose, overdue, without_old
from backends.smoother.marginal import Held, reference_prior
from backends.smoother.measurement_log import IndexArray, Known, MeasurementLog
from backends.smoother.prediction import carried_covariance
from backends.smoother.rebuild import optimise, pose_factor, whole_problem
from backends.smoother.solver import Change, Solver, SolverError
from backends.smoother.uncertainty import PoseSet, WindowJacobians
from backends.smoother.variables import pose_key, thresholds
from slam.data import IdArray
from slam.geometry.se3 import Array, inverse, transform
from slam.tracking.gating import chi_square_gate

#: What lies before the window is read back when the window's oldest pose has been revised by so much [m, or sine].
_STALE = 0.005

#: Reading all back takes time in proportion to the run, so it waits for this share of the run, unless the revision is
#: so many times as large.
_SELDOM, _AT_ONCE = 0.01, 20

#: Each time a variable is linearised anew, all that was seen since it was first seen is eliminated again, so it is done
#: for many together: every so many frames. What is off by so many times as much is not left to wait.
_EVERY, _OFF = 10, 10.0

#: A landmark is solved anew where a single step would change its sum of squares by so much.
_FAR = 1.0

#: Steps that take landmarks to where their mended measurements put them.
_REFINED = 3

#: The last word on all poses and landmarks is linearised to within so much [px].
_LAST = 1e-4
_ROUNDS = 6  # of relinearising everything at most


class PoseGraph:
    """Poses, landmarks and their factors in ISAM2. Which factors: see `backends.smoother.factor_builder`.

    Args:
        make: makes the factors.
        config: limits and thresholds.

    Attributes:
        measurement_log: poses, measurements and landmarks as they are believed now.
        rebuilds: how often all was put into a new solver.
    """

    def __init__(self, make: FactorMaker, config: SmootherConfig) -> None:
        self.measurement_log = MeasurementLog()
        self._make = make
        self._config = config
        self._factor_builder = FactorBuilder(make, config, self.measurement_log)
        self._often, self._seldom, self._last = (
            thresholds(make.stereo, config.relinearise, share) for share in (_OFF, 1.0, _LAST / config.relinearise)
        )
        self._solver = self._new_solver()
        self._seconds = 0.0  # CPU time of former solvers, and of solving from scratch
        self.rebuilds = 0
        self._rebuilt = -_EVERY  # number of frames when the solver was last made anew
        self._broken = False  # whether a call was interrupted since
        self._solved = True  # whether all is solved to the last
        self._moved = 0.0  # how far the window's oldest pose has been revised since all poses were read back
        self._converged = 0  # number of frames then
        self._window: PoseSet | None = None  # of the present state; None while it has not been asked for
        self._last_window: PoseSet | None = None  # the one before
        self._carried: WindowJacobians | None = None

    @property
    def solver_seconds(self) -> float:
        """CPU time spent in gtsam's solvers [s]."""
        return self._seconds + self._solver.seconds

    def interrupted(self) -> None:
        """Note that the solver may hold what is not on record: it is made anew before anything else is done."""
        self._broken, self._window, self._carried = True, None, None

    def mend(self) -> None:
        """Make the solver anew after an interruption."""
        if self._broken:
            self._recover()
            self._broken = False

    def append_pose(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame without measurements."""
        self.measurement_log.path.append(stamp, T_world_left)
        try:
            self._enter_pose(Change())
        except SolverError:
            self._recover()
        self._advance()

    def append_measured_pose(self, stamp: float, T_world_left: Array, slots: IndexArray, z: Array) -> str:
        """Add a frame with measurements (M, 3) of landmarks.

        Args:
            stamp: time [s].
            T_world_left: first value of the pose (4, 4), near the solution.
            slots: landmarks (M,).
            z: their measurements (M, 3).

        Returns:
            what failed, in one line; empty if nothing did. After a failure the frame stands without measurements.
        """
        marks, frame = self.measurement_log.landmarks, self.measurement_log.path.count
        self.measurement_log.path.append(stamp, T_world_left)
        rows = self.measurement_log.measurements.append(z, frame, marks.serial[slots])
        change = Change()
        grown = self._factor_builder.grow(change, slots, rows, z)
        try:
            try:
                new = self._enter_pose(change)
                for track, place in grown:
                    track.factor = new[place]
            except SolverError:
                self._rebuild()
        except SolverError as error:
            self.measurement_log.take_back(slots, rows)
            self._recover()
            self._advance()
            return str(error)
        marks.measured(slots, rows, frame)
        self.measurement_log.path.note_measured()
        try:
            self._read_back(slots)
            if self._diverged(slots, z):
                self._rebuild()
        except SolverError:
            self._recover()
        self._factor_builder.finish_tracks(slots)
        self._advance()
        return ""

    def start_anew(self, stamp: float, T_world_left: Array, covariance: Array, slots: IndexArray, z: Array) -> str:
        """Add a frame whose pose follows from the landmarks and not from the poses before it.

        Those stay as they are, and the landmarks stay where they are before the new pose.

        Args:
            stamp: time [s].
            T_world_left: the pose (4, 4).
            covariance: what is known of it in the world (6, 6).
            slots: landmarks (M,) measured.
            z: their measurements (M, 3).

        Returns:
            what failed, as in `append_measured_pose`.
        """
        log, frame = self.measurement_log, self.measurement_log.path.count
        covariances = self._covariances_from_measured(log.landmarks.used())
        log.path.append(stamp, T_world_left)
        log.start_anew(reference_prior(pose_key(frame), T_world_left, covariance), covariances)
        self._window, self._carried, self._solved, self._broken = None, None, False, True
        rows = log.measurements.append(z, frame, log.landmarks.serial[slots])
        self._factor_builder.grow(Change(), slots, rows, z)
        try:
            self._rebuild()
        except SolverError as error:
            log.take_back(slots, rows)
            self._recover()
            return str(error)
        log.landmarks.measured(slots, rows, frame)
        log.path.note_measured()
        self._place(slots)
        return ""

    def add_landmarks(self, ids: IdArray, z: Array, local: Array) -> None:
        """Take in landmarks at their first sight, at `local` (M, 3) in the newest camera's coordinates."""
        path, marks, frame = (
            self.measurement_log.path,
            self.measurement_log.landmarks,
            self.measurement_log.path.count - 1,
        )
        limits = [self._config.track + i % self._config.track for i in ids.tolist()]
        slots = marks.add(ids, transform(path.poses[-1], local), frame, limits)
        rows = self.measurement_log.measurements.append(z, frame, marks.serial[slots])
        marks.measured(slots, rows, frame)
        path.note_measured()
        key = pose_key(frame)
        for slot, row, zi in zip(slots.tolist(), rows.tolist(), z.tolist()):
            marks.tracks[slot].append(row, self._make.point(zi), key, stereo=True)
        self._linearise(slots)

    def add_known(self, ids: IdArray, positions: Array, covariances: Array, frame: int | None = None) -> None:
        """Take in landmarks of which much is known, at `positions` (M, 3) with covariances (M, 3, 3).

        In world coordinates, or in the camera's of a frame. They become variables when they are first measured.
        """
        path, marks, newest = (
            self.measurement_log.path,
            self.measurement_log.landmarks,
            self.measurement_log.path.count - 1,
        )
        T = np.eye(4) if frame is None else path.poses[frame]
        slots = marks.add(ids, transform(T, positions), newest, [self._config.track] * len(ids))
        marks.covariance[slots] = T[:3, :3] @ covariances @ T[:3, :3].T
        information = np.linalg.inv(marks.covariance[slots])
        if frame is None:
            marks.mean[slots], marks.prior[slots] = positions, information
        else:
            marks.older[slots] = information
            path.note_measured()
        for serial, position, covariance in zip(marks.serial[slots].tolist(), positions, covariances):
            self.measurement_log.history.known[serial] = Known(position.copy(), covariance.copy(), frame)
        self._carried = None

    def remove_landmarks(self, slots: IndexArray) -> None:
        """Take landmarks out of the map; what they have told about the poses stays known."""
        marks = self.measurement_log.landmarks
        for slot in slots.tolist():
            self.measurement_log.finish(marks.tracks[slot])
        marks.remove(slots)

    def revise(self, mend: Callable[[Array], Array]) -> None:
        """Mend all measurements and solve anew."""
        marks = self.measurement_log.landmarks
        self.measurement_log.revise(mend, self._make.point)
        self._recover()
        with suppress(SolverError):  # of a problem that could not be solved: the landmarks stay where they were
            for _ in range(_REFINED):
                self._place(marks.used())

    def window(self) -> PoseSet:
        """The newest poses with their joint covariance; computed once per state."""
        if self._window is None:
            count = self.measurement_log.path.count
            frames = np.array(self._factor_builder.newest(), np.intp)
            P = self._joint_covariance(frames) if count else np.zeros((0, 0))
            self._window = PoseSet(frames, self.measurement_log.path.poses[frames], P)
            self._last_window = self._window if count else None
        return self._window

    def last_poses(self, count: int) -> PoseSet:
        """The window, or the last `count` poses where it leaves some of them out: those without measurements."""
        window, path = self.window(), self.measurement_log.path
        frames = np.arange(max(self._factor_builder.oldest, path.count - count), path.count)
        if np.isin(frames, window.frames).all():
            return window
        try:
            return PoseSet(frames, path.poses[frames], self._covariance_of([pose_key(i) for i in frames.tolist()]))
        except SolverError:
            return window

    def _joint_covariance(self, frames: IndexArray) -> Array:
        """Joint covariance of poses; where the solver cannot give it, the last one carried on by the motion model."""
        keys = [pose_key(i) for i in frames.tolist()]
        try:
            return self._covariance_of(keys)
        except SolverError:
            self._recover()
        try:
            return self._covariance_of(keys)
        except SolverError:
            return carried_covariance(self._make.models, self.measurement_log.path, self._last_window, frames)

    def _covariance_of(self, keys: list[int]) -> Array:
        """Joint covariance of poses as it is while none is held."""
        held = self.measurement_log.history.held
        if held is None:
            return self._solver.joint_covariance(keys)
        others = [key for key in keys if key != held.key]
        P = self._solver.joint_covariance([held.key, *others])
        P = held.let_go(P, P[:, :6], P[:6, :6])
        return P if len(others) < len(keys) else P[6:, 6:]

    def landmarks_by_window(self, slots: IndexArray) -> Array:
        """Jacobians (M, 3, 6 W) of landmark positions by the poses of the window."""
        window, marks = self.window(), self.measurement_log.landmarks
        if self._carried is None or self._carried.window is not window:
            self._carried = WindowJacobians(window, len(marks.ids))
        return self._carried.of(self.measurement_log.measurements, marks, slots)

    def landmark_covariances(self, slots: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmark positions.

        From the solver where it has them at hand: of variables that were measured lately. Those of others take what is
        older than the window to move with its oldest pose, which makes them a little too large.
        """
        marks = self.measurement_log.landmarks
        if not self.measurement_log.path.count:  # a map that is known, and no pose in it yet
            return marks.covariance[slots]
        P = uncertainty.quadratic(self.landmarks_by_window(slots), self.window().covariance) + marks.covariance[slots]
        variables = marks.variable[slots].tolist()
        try:
            exact = self._solver.point_covariances(
                variables, pose_key(self.measurement_log.path.count - 1), self.measurement_log.history.held
            )
        except SolverError:
            self._recover()
            return P
        for row, key in enumerate(variables):
            if key in exact:
                P[row] = exact[key]
        return P

    def _covariances_from_measured(self, slots: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmark positions as seen from the newest pose that measured any, in world axes."""
        window, marks, measured = self.window(), self.measurement_log.landmarks, self.measurement_log.path.measured
        place = int(np.searchsorted(window.frames, measured[-1])) if measured else len(window) - 1
        J = self.landmarks_by_window(slots).copy()
        J[:, :, 6 * place : 6 * place + 6] -= uncertainty.carried(window.poses[place], marks.position[slots])
        return uncertainty.quadratic(J, window.covariance) + marks.covariance[slots]

    def lost(self) -> bool:
        """Whether what is in view hangs on a pose that is turned by an unknown angle: no linearisation holds there."""
        window, path, enough = self.window(), self.measurement_log.path, recovery.CONFIRMED
        if not path.measured or not recovery.unknown_turn(window.covariance[-6:, -6:]):
            return False
        newest = path.measured[-1]
        if np.count_nonzero(self.measurement_log.measurements.frame == newest) < enough:
            return False
        with suppress(SolverError):  # the oldest pose, where it is held, may be turned in the world by any angle
            return recovery.unknown_turn(self._solver.joint_covariance([pose_key(newest)]))
        return False

    def converge(self) -> None:
        """Solve to the last: every variable is linearised anew where it stands until nothing moves any more."""
        if self._solved:
            return
        try:
            change = Change()
            self._factor_builder.eliminate_late(change)
            self._solver.converge(change, self._last, _ROUNDS)
            self._read_all()
        except SolverError:
            self._recover()
        self._solved, self._window = True, None

    def _read_all(self, before: Array | None = None) -> None:
        """Bring all poses and landmarks on record up to what the solver has; `before` are the poses as they were."""
        path = self.measurement_log.path
        if path.count:
            before = path.poses.copy() if before is None else before
            path.poses[:] = self._solved_poses()
            if self.measurement_log.measurements.count:
                self._place(self.measurement_log.landmarks.used(), before)
            self._moved, self._converged = 0.0, path.count

    def _solved_poses(self) -> Array:
        """All poses, those that are variables as the solver has them."""
        poses = self.measurement_log.path.poses.copy()
        first = self.measurement_log.history.first
        if len(poses):
            values = self._solver.values()
            poses[first:] = [values.atPose3(pose_key(i)).matrix() for i in range(first, len(poses))]
        return poses

    def _new_solver(self) -> Solver:
        """An empty solver for as many variables as there will be."""
        c = self._config
        return Solver(self._seldom, None if c.lag is None else 2 * (c.lag + c.explicit))

    # --- factors ---

    def _enter_pose(self, change: Change) -> list[int]:
        """Add the newest pose with its prior or motion to the change, and solve; returns the new factors' slots."""
        path = self.measurement_log.path
        i = path.count - 1
        if i >= 3:
            self._factor_builder.eliminate_late(change)
        change.values.insert(pose_key(i), to_pose3(path.poses[i]))
        change.factors.add(pose_factor(self._make, path, i))
        self._window, self._solved = None, False
        thorough = path.count % _EVERY == 0 and self._overdue() is None  # a new solver linearises all anew
        return self._solver.update(change, self._seldom if thorough else self._often)

    # --- the lag ---

    def _overdue(self) -> int | None:
        """Frame of the oldest pose that shall stay, where others leave in this frame."""
        return None if self._config.lag is None else overdue(self.measurement_log, self._config.lag)

    def _advance(self) -> None:
        """Marginalise what is older than the lag and go on with a new solver; after a failure the next frame tries."""
        first = self._overdue()
        if first is None:
            return
        try:
            rest = without_old(self.measurement_log, self._solver, first, self._config.explicit)
            self._factor_builder.eliminate_late(rest.change, first, rest.gone)
            solver = self._new_solver()
            new = solver.update(rest.change)
            held = _informed(rest.held, solver)
            left = self._solver.poses(pose_key(i) for i in range(self.measurement_log.history.first, first))
        except SolverError:
            return
        marks = self.measurement_log.landmarks
        self.measurement_log.path.poses[first - len(left) : first] = left
        marks.variable[np.isin(marks.variable, rest.gone)] = -1
        for track in rest.finished:
            track.restart()
        for track in marks.tracks.values():
            track.factor = new[rest.slots[track.factor]] if track.factor >= 0 else -1
        self.measurement_log.advance(first, rest.gone, rest.prior, held)
        self._seconds += self._solver.seconds
        self._solver, self._window, self._carried = solver, None, None

    # --- the way back from the solver ---

    def _read_back(self, slots: IndexArray) -> None:
        """Poses of the window and the landmarks just measured, as the solver has them now.

        What lies further back changes seldom: it follows once the window's oldest pose has been revised by as much as
        makes the solver linearise anew.
        """
        path = self.measurement_log.path
        first = max(self.measurement_log.history.first, path.count - self._config.window)
        before = path.poses.copy()
        path.poses[first:] = self._solver.poses(pose_key(i) for i in range(first, path.count))
        self._moved += float(np.abs(path.poses[first] - before[first]).max())
        waited = path.count - self._converged >= _SELDOM * path.count
        if self._moved > (_STALE if waited else _AT_ONCE * _STALE):
            self._read_all(before)
        else:
            self._place(slots, before)

    def _place(self, slots: IndexArray, before: Array | None = None) -> None:
        """Positions of landmarks that fit the poses on record.

        `before` (F, 4, 4) are the poses as they were; a landmark first goes with the last one that measured it.
        """
        r, marks = self.measurement_log, self.measurement_log.landmarks
        variables = marks.variable[slots]
        explicit = variables >= 0
        others = slots[~explicit]
        if before is not None:
            last = marks.last[others]
            moved = r.path.poses[last] @ inverse(before[last])
            turned = moved[:, :3, :3] @ marks.position[others][:, :, None]
            marks.position[others] = turned[:, :, 0] + moved[:, :3, 3]
        marks.position[slots[explicit]] = self._solver.points(variables[explicit].tolist())
        step, gain = self._linearise(slots)
        far = ~explicit & (gain > _FAR)
        if far.any():
            marks.position[slots[far]] = uncertainty.refined(
                self._make.stereo, self._make.sigma, r.path.poses, r.measurements, marks, slots[far]
            )
            step[far] = self._linearise(slots[far])[0]
        near = ~explicit & (gain <= _FAR)
        marks.position[slots[near]] += step[near]

    def _linearise(self, slots: IndexArray) -> tuple[Array, Array]:
        """Covariances of landmarks by their recent measurements; returns steps (M, 3) to better positions and gains."""
        r, marks = self.measurement_log, self.measurement_log.landmarks
        position = marks.position[slots]
        E, residuals = uncertainty.linearise(
            self._make.stereo, self._make.sigma, r.path.poses, r.measurements, position, marks.recent[slots]
        )
        step, marks.covariance[slots], gain = uncertainty.position_step(
            E, residuals, marks.older[slots], np.zeros_like(position), marks.prior[slots], marks.mean[slots] - position
        )
        marks.information[slots] = np.swapaxes(E, 2, 3) @ E
        self._carried = None
        return step, gain

    # --- failures ---

    def _diverged(self, slots: IndexArray, z: Array) -> bool:
        """Whether most of the newest measurements would not pass the gate any more: ISAM2 steps without looking.

        Solving all anew takes long, so it is not said twice in a few frames.
        """
        T, marks = self.measurement_log.path.poses[-1], self.measurement_log.landmarks
        if self.measurement_log.path.count < self._rebuilt + _EVERY:
            return False
        h, _ = self._make.stereo.project((marks.position[slots] - T[:3, 3]) @ T[:3, :3])
        passed = chi_square_gate(z - h, self._noise(len(z)), self._make.models.gate_probability)
        return 2 * int(passed.sum()) < len(z)

    def _noise(self, count: int) -> Array:
        return np.broadcast_to(self._make.sigma**2 * np.eye(3), (count, 3, 3))

    def _recover(self) -> None:
        """Rebuild; where the problem has no solution, as it stands; where not even that, without what was measured.

        Where the solver takes nothing at all, it stays broken, and the next step tries again.
        """
        for solved, forget in ((True, False), (False, False), (False, True)):
            if forget:
                self.measurement_log.forget_measurements()
            with suppress(SolverError):
                self._rebuild(solved)
                return

    def _rebuild(self, solved: bool = True) -> None:
        """A new solver for all that is on record, solved as a whole first.

        Raises:
            SolverError: that cannot be solved either.
        """
        self.rebuilds += 1
        change, places = whole_problem(self._make, self.measurement_log)
        start = time.process_time()
        try:
            if solved:
                change.values = optimise(change)
            prior = self.measurement_log.history.prior
            held = None if prior is None else held_pose(self.measurement_log, prior, change.values)
        finally:
            self._seconds += time.process_time() - start
        if held is not None:
            change.factors.add(held.factor())
        solver = self._new_solver()
        new = solver.update(change)
        with suppress(SolverError):
            held = _informed(held, solver)
        self._broken = True  # until all of the following has been done
        self.measurement_log.history.held = held
        for track in self.measurement_log.landmarks.tracks.values():
            track.factor = -1
        for track, place in places:
            track.factor = new[place]
        self._seconds += self._solver.seconds
        self._solver, self._window, self._rebuilt = solver, None, self.measurement_log.path.count
        self._read_all()
        self._broken = False


def _informed(held: Held | None, solver: Solver) -> Held | None:
    """What is known of the pose that is held, by a solver that is new."""
    return None if held is None else held.informed(solver.joint_covariance([held.key]))
