"""The smoother's factor graph: solved incrementally, and rebuilt from the measurement log if that fails."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from copy import copy

import numpy as np

from backends.smoother.config import SmootherConfig
from backends.smoother.factor_builder import FactorBuilder
from backends.smoother.factors import FactorMaker, to_pose3
from backends.smoother.lag import overdue, reference_pose, without_old
from backends.smoother.landmarks import Known
from backends.smoother.marginal import reference_prior
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.positions import linearise, place
from backends.smoother.rebuild import optimise, pose_factor, stepped, whole_problem
from backends.smoother.reference_pose import ReferencePose
from backends.smoother.solver import Change, Solver, SolverError
from backends.smoother.variables import pose_key, thresholds
from slam.data import IdArray, IndexArray
from slam.geometry.se3 import Array, transform
from slam.window.gating import chi_square_gate

#: cost: Poses before the window and all landmarks are read from the solver again once the window's oldest pose has been
#: revised by so much [m, or sine of an angle].
_STALE = 0.005

#: cost: That takes time in proportion to the run, so it waits until the run is longer by this share, unless the
#: revision is so many times as large.
_SELDOM, _AT_ONCE = 0.01, 20

#: cost: Relinearising a variable eliminates all that was measured since it was first seen, so it is done for many
#: variables together every so many frames. A variable that is off by so many times the threshold does not wait.
_EVERY, _OFF = 10, 10.0

#: numerics: Gauss-Newton steps that move landmarks to where their changed measurements put them.
_REFINED = 3

#: numerics: When all is solved to convergence, variables are relinearised until they are within so much [px].
_LAST = 1e-4
_ROUNDS = 6  # numerics: of relinearising everything, at most


class FactorGraph:
    """Poses, landmarks and their factors in ISAM2. Which factors: see `backends.smoother.factor_builder`.

    All measurements are in the measurement log as well, and the solver's results are written back to it. A solver that
    fails is replaced by a new one, built from the log.

    Args:
        make: makes the factors.
        config: limits and thresholds.

    Attributes:
        config: limits and thresholds.
        log: poses, measurements and landmarks, with the latest values of poses and positions.
        solver: holds the factors.
        solutions: counts solutions for the poses: results derived from them are out of date once it has changed.
        placements: the same for the landmarks.
        rebuilds: how often a new solver was built.
    """

    def __init__(self, make: FactorMaker, config: SmootherConfig) -> None:
        self.log = MeasurementLog()
        self.config = config
        self._make = make
        self._factor_builder = FactorBuilder(make, config, self.log)
        self._often, self._seldom, self._last = (
            thresholds(make.stereo, config.relinearise, share) for share in (_OFF, 1.0, _LAST / config.relinearise)
        )
        self.solver = self._new_solver()
        self._seconds = 0.0  # CPU time of former solvers, and of solving from scratch
        self.rebuilds = 0
        self._rebuilt = -_EVERY  # number of frames when the solver was last rebuilt
        self._broken = False  # whether a call was interrupted since
        self._moved = 0.0  # how far the window's oldest pose has been revised since all poses were read back
        self._converged = 0  # number of frames then
        self.solutions = 0
        self.placements = 0

    @property
    def solver_seconds(self) -> float:
        """CPU time spent in gtsam's solvers [s]."""
        return self._seconds + self.solver.seconds

    def interrupted(self) -> None:
        """Note that solver and log may differ after an interrupt: the solver is rebuilt before the next operation."""
        self._broken = True
        self._out_of_date()

    def _out_of_date(self) -> None:
        """Note that poses and landmarks have changed."""
        self.solutions += 1
        self.placements += 1

    def repair(self) -> None:
        """Build a new solver after an interruption."""
        if self._broken:
            self.recover()
            self._broken = False

    def append_pose(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame without measurements."""
        self.log.path.append(stamp, T_world_left)
        try:
            self._enter_pose(Change())
        except SolverError:
            self.recover()
        self._advance()

    def append_measured_pose(self, stamp: float, T_world_left: Array, slots: IndexArray, z: Array) -> str:
        """Add a frame with measurements (M, 3) of landmarks.

        Args:
            stamp: time [s].
            T_world_left: first value of the pose (4, 4), near the solution.
            slots: landmarks (M,).
            z: their measurements (M, 3).

        Returns:
            what failed, in one line; empty if nothing did. After a failure the frame has no measurements.
        """
        marks, frame = self.log.landmarks, self.log.path.count
        self.log.path.append(stamp, T_world_left)
        rows = self.log.measurements.append(z, frame, marks.serial[slots])
        change = Change()
        grown = self._factor_builder.grow(change, slots, rows, z)
        try:
            try:
                new = self._enter_pose(change)
                marks.put_in_factors({slot: new[number] for slot, number in grown.items()})
            except SolverError:
                self._rebuild()
        except SolverError as error:
            self.log.take_back(slots, rows)
            self.recover()
            self._advance()
            return str(error)
        marks.measured(slots, rows, frame)
        self.log.path.note_measured()
        try:
            self._read_back(slots)
            if self._diverged(slots, z):
                self._rebuild()
        except SolverError:
            self.recover()
        self._factor_builder.finish_tracks(slots)
        self._advance()
        return ""

    def restart(
        self, stamp: float, T_world_left: Array, covariance: Array, covariances: Array, slots: IndexArray, z: Array
    ) -> str:
        """Add a frame whose pose is set by the landmarks, not by the poses before it.

        Earlier poses stay as they are. Landmarks keep their position relative to the new pose.

        Args:
            stamp: time [s].
            T_world_left: the pose (4, 4).
            covariance: its covariance in the world (6, 6).
            covariances: of all landmarks (N, 3, 3), by slot, relative to the newest pose that measured any.
            slots: landmarks (M,) measured.
            z: their measurements (M, 3).

        Returns:
            what failed, as in `append_measured_pose`.
        """
        log, frame = self.log, self.log.path.count
        log.path.append(stamp, T_world_left)
        log.restart(reference_prior(pose_key(frame), T_world_left, covariance), covariances)
        self._out_of_date()
        self._broken = True
        rows = log.measurements.append(z, frame, log.landmarks.serial[slots])
        self._factor_builder.grow(Change(), slots, rows, z)
        try:
            self._rebuild()
        except SolverError as error:
            log.take_back(slots, rows)
            self.recover()
            return str(error)
        log.landmarks.measured(slots, rows, frame)
        log.path.note_measured()
        self._place(slots)
        return ""

    def add_landmarks(self, ids: IdArray, z: Array, local: Array) -> None:
        """Add new landmarks at `local` (M, 3) in the newest camera's coordinates."""
        path, marks, frame = self.log.path, self.log.landmarks, self.log.path.count - 1
        limits = [self.config.track + i % self.config.track for i in ids.tolist()]
        slots = marks.add(ids, transform(path.poses[-1], local), frame, limits)
        rows = self.log.measurements.append(z, frame, marks.serial[slots])
        marks.measured(slots, rows, frame)
        path.note_measured()
        key = pose_key(frame)
        for slot, row, zi in zip(slots.tolist(), rows.tolist(), z.tolist()):
            marks.tracks[slot] = marks.tracks[slot].longer(row, self._make.point(zi), key, stereo=True)
        linearise(self._make, self.log, slots)
        self.placements += 1

    def add_known(self, ids: IdArray, positions: Array, covariances: Array, frame: int | None = None) -> None:
        """Add landmarks with a prior: `positions` (M, 3) with covariances (M, 3, 3).

        In world coordinates, or in the camera's of a frame. They become variables when they are first measured.
        """
        path, marks, newest = self.log.path, self.log.landmarks, self.log.path.count - 1
        T = np.eye(4) if frame is None else path.poses[frame]
        slots = marks.add(ids, transform(T, positions), newest, [self.config.track] * len(ids))
        marks.covariance[slots] = T[:3, :3] @ covariances @ T[:3, :3].T
        information = np.linalg.inv(marks.covariance[slots])
        if frame is None:
            marks.mean[slots], marks.prior[slots] = positions, information
        else:
            marks.older[slots] = information
            path.note_measured()
        for serial, position, covariance in zip(marks.serial[slots].tolist(), positions, covariances):
            self.log.history.known[serial] = Known(position.copy(), covariance.copy(), frame)
        self.placements += 1

    def remove_landmarks(self, slots: IndexArray) -> None:
        """Remove landmarks from the map; what their measurements said about the poses is kept."""
        marks = self.log.landmarks
        for slot in slots.tolist():
            self.log.finish(slot)
        marks.remove(slots)

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """Correct all measurements by `correct` and solve the problem again."""
        marks = self.log.landmarks
        self.log.revise(correct, self._make.point)
        try:
            self._rebuild(near=True)
        except SolverError:
            self.recover()
        with suppress(SolverError):  # of a problem that could not be solved: the landmarks stay where they were
            for _ in range(_REFINED):
                self._place(marks.used())

    def joint_covariance(self, keys: list[int]) -> Array:
        """Joint covariance of pose variables, as if none was held (see `backends.smoother.reference_pose`).

        Raises:
            SolverError: the solver cannot give it.
        """
        held = self.log.history.reference
        if held is None:
            return self.solver.joint_covariance(keys)
        others = [key for key in keys if key != held.key]
        P = self.solver.joint_covariance([held.key, *others])
        P = held.released(P, P[:, :6], P[:6, :6])
        return P if len(others) < len(keys) else P[6:, 6:]

    def converged(self) -> FactorGraph:
        """The same problem, solved until no variable moves any more, in a graph of its own; this one stays as it is.

        Takes time in proportion to the run.

        Raises:
            SolverError: it cannot be solved.
        """
        other = copy(self)
        other.log = self.log.copied()
        other._factor_builder = FactorBuilder(self._make, self.config, other.log)
        other._rebuild(solved=False)
        change = Change()
        other._factor_builder.eliminate_late(change)
        other.solver.converge(change, self._last, _ROUNDS)
        other._read_all()
        other.solutions += 1
        return other

    def _read_all(self, before: Array | None = None) -> None:
        """Write all poses and landmarks from the solver to the log; `before` are the poses as they were."""
        path = self.log.path
        if path.count:
            before = path.poses.copy() if before is None else before
            path.poses[:] = self._solved_poses()
            if self.log.measurements.count:
                self._place(self.log.landmarks.used(), before)
            self._moved, self._converged = 0.0, path.count

    def _solved_poses(self) -> Array:
        """All poses, those that are variables as the solver has them."""
        poses = self.log.path.poses.copy()
        first = self.log.history.first
        if len(poses):
            values = self.solver.values()
            poses[first:] = [values.atPose3(pose_key(i)).matrix() for i in range(first, len(poses))]
        return poses

    def _new_solver(self) -> Solver:
        """An empty solver, sized for the variables to come."""
        c = self.config
        return Solver(self._seldom, None if c.lag is None else c.lag + c.explicit)

    # --- factors ---

    def _enter_pose(self, change: Change) -> list[int]:
        """Add the newest pose with its prior or motion to the change, and solve; returns the new factors' slots."""
        path = self.log.path
        i = path.count - 1
        if i >= 3:
            self._factor_builder.eliminate_late(change)
        change.values.insert(pose_key(i), to_pose3(path.poses[i]))
        change.factors.add(pose_factor(self._make, path, i))
        self.solutions += 1
        thorough = path.count % _EVERY == 0 and self._overdue() is None  # a new solver relinearises all
        return self.solver.update(change, self._seldom if thorough else self._often)

    # --- the lag ---

    def _overdue(self) -> int | None:
        """Frame of the oldest pose to keep, if poses are to be marginalised in this frame; else None."""
        return overdue(self.log, self.config.lag)

    def poses_leave(self) -> bool:
        """Whether poses are marginalised before anything else is done, as one that is predicted joins them."""
        return self.log.path.predicted is not None and overdue(self.log, self.config.lag, coming=1) is not None

    def _advance(self) -> None:
        """Marginalise what is older than the lag, and go on with a new solver; after a failure the next frame tries."""
        first = self._overdue()
        if first is None:
            return
        try:
            rest = without_old(self.log, self.solver, first, self.config.explicit)
            self._factor_builder.eliminate_late(rest.change, first, rest.gone)
            solver = self._new_solver()
            new = solver.update(rest.change)
            held = _with_covariance(rest.held, solver)
            left = self.solver.poses(pose_key(i) for i in range(self.log.history.first, first))
        except SolverError:
            return
        marks = self.log.landmarks
        self.log.path.poses[first - len(left) : first] = left
        marks.variable[np.isin(marks.variable, rest.gone)] = -1
        for slot in rest.finished:
            marks.tracks[slot] = marks.tracks[slot].restarted()
        held_by = {slot: track.factor for slot, track in marks.tracks.items() if track.factor >= 0}
        marks.put_in_factors({slot: new[rest.slots[factor]] for slot, factor in held_by.items()})
        self.log.advance(first, rest.gone, rest.prior, held)
        self._seconds += self.solver.seconds
        self.solver = solver
        self._out_of_date()

    # --- the way back from the solver ---

    def _read_back(self, slots: IndexArray) -> None:
        """Poses of the window and the landmarks just measured, as the solver has them now.

        Older poses change seldom: they are read once the window's oldest pose has moved beyond the threshold of
        relinearisation.
        """
        path = self.log.path
        first = max(self.log.history.first, path.count - self.config.window)
        before = path.poses.copy()
        path.poses[first:] = self.solver.poses(pose_key(i) for i in range(first, path.count))
        self._moved += float(np.abs(path.poses[first] - before[first]).max())
        waited = path.count - self._converged >= _SELDOM * path.count
        if self._moved > (_STALE if waited else _AT_ONCE * _STALE):
            self._read_all(before)
        else:
            self._place(slots, before)

    def _place(self, slots: IndexArray, before: Array | None = None) -> None:
        """Positions of landmarks that fit the poses on record; see `backends.smoother.positions.place`."""
        self.placements += 1
        place(self._make, self.log, self.solver, slots, before)

    # --- failures ---

    def _diverged(self, slots: IndexArray, z: Array) -> bool:
        """Whether most of the newest measurements fail the gate after the step: ISAM2 does not check that a step helps.

        A rebuild takes long, so this is not reported twice within a few frames.
        """
        T, marks = self.log.path.poses[-1], self.log.landmarks
        if self.log.path.count < self._rebuilt + _EVERY:
            return False
        h, _ = self._make.stereo.project((marks.position[slots] - T[:3, 3]) @ T[:3, :3])
        noise = np.broadcast_to(self._make.sigma**2 * np.eye(3), (len(z), 3, 3))
        passed = chi_square_gate(z - h, noise, self._make.models.gate_probability)
        return 2 * int(passed.sum()) < len(z)

    def recover(self) -> None:
        """Rebuild: solved as a whole; if that fails, at the present values; if that fails too, without measurements.

        If the solver refuses everything, it stays broken, and the next step tries again.
        """
        for solved, forget in ((True, False), (False, False), (False, True)):
            if forget:
                self.log.forget_measurements()
            with suppress(SolverError):
                self._rebuild(solved)
                return

    def _rebuild(self, solved: bool = True, near: bool = False) -> None:
        """A new solver with everything in the log, solved as a whole first; by a single step if the values are `near`.

        Raises:
            SolverError: that cannot be solved either.
        """
        self.rebuilds += 1
        change, places = whole_problem(self._make, self.log)
        self._factor_builder.eliminate_late(change)
        start = time.process_time()
        prior = self.log.history.prior
        held = None if prior is None else reference_pose(self.log, prior, change.values)
        if held is not None:  # before all is solved: poses that have left would not follow if it moved
            change.factors.add(held.factor())
        try:
            if solved:
                change.values = stepped(change) if near else optimise(change)
        finally:
            self._seconds += time.process_time() - start
        solver = self._new_solver()
        new = solver.update(change)
        with suppress(SolverError):
            held = _with_covariance(held, solver)
        self._broken = True  # until all of the following has been done
        self.log.history.reference = held
        marks = self.log.landmarks
        marks.put_in_factors({slot: new[places[slot]] if slot in places else -1 for slot in marks.tracks})
        self._seconds += self.solver.seconds
        self.solver, self._rebuilt = solver, self.log.path.count
        self.solutions += 1
        self._read_all()
        self._broken = False


def _with_covariance(held: ReferencePose | None, solver: Solver) -> ReferencePose | None:
    """The held pose with its covariance from a new solver."""
    return None if held is None else held.with_covariance_from(solver.joint_covariance([held.key]))
