"""The steps of the window back end: functions from a state to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.window.slide import problem, slid
from backends.window.state import WindowConfig, WindowLandmarks, WindowState
from slam.data import IdArray, IndexArray, UpdateReport, UpdateStatus
from slam.geometry.arrays import among, changed
from slam.geometry.kernels import seen
from slam.geometry.se3 import Array, points_by_pose
from slam.window import chart_kernels, motion, pose_only
from slam.window.consensus import landmarks_pose
from slam.window.gating import MIN_CONSENSUS
from slam.window.problem import Motion, Places, RelativePrior, Rows
from slam.window.recovery import Agreement, agreement, unknown_turn, world_covariance
from slam.window.solver import Solution, solve
from slam.window.stereo import RectifiedMeasurement

#: numerics: share of its noise that a row's residual has at least, to be tested. Where a row alone tells something of
#: the pose, its residual and the variance of that are nearly 0, and what the solution leaves of them would decide.
_TESTED = 0.01
_SOLVED_AGAIN = 2  # numerics: how often an update is solved again without observations that disagree with the others
_STILL = np.zeros((6, 6))


@dataclass(frozen=True, eq=False)
class Steps(RectifiedMeasurement):
    """What the steps need besides the state."""

    config: WindowConfig  # options

    def predicted(self, s: WindowState, stamp: float, rests: bool) -> WindowState:
        """With a pose at `stamp` [s], by the motion model, or that before if the camera rests.

        Where the window is full, a pose leaves it first.
        """
        if not len(s.frames):
            T = self.models.initial_pose
            sigmas = np.repeat([self.models.initial_rotation_sigma, self.models.initial_position_sigma], 3)
            P, prior = np.diag(sigmas**2), RelativePrior.of_pose(T, np.diag(sigmas**2), s.by_rig)
            first = np.zeros(1, np.int64)
            return changed(s, frames=first, stamps=np.array([stamp]), poses=T[None], covariance=P, prior=prior)
        if len(s.frames) >= self.config.poses:
            try:
                s = slid(s, self.stereo, self.config, self.field)
            except np.linalg.LinAlgError:  # covariances that differ by more than their digits, as after long gaps
                s = _begun_anew(s, s.poses[-1], s.covariance[-6:, -6:])
        K, t, begins = len(s.frames), s.stamps, s.frames[-1] == s.begun
        before = None if begins else min(t[-1] - t[-2], motion.LONGEST)
        dt = min(stamp - t[-1], motion.LONGEST)
        T, by_last, noise, unknown = motion.predicted(self.models, s.poses[-2:], before, dt, rests)
        J = np.zeros((6, 6 * K))
        J[:, -12:] = by_last[:, -6 * K :]
        cross = J @ s.covariance
        own = cross @ J.T + noise
        P = np.empty((6 * K + 6, 6 * K + 6))
        P[:-6, :-6], P[-6:, :-6], P[:-6, -6:], P[-6:, -6:] = s.covariance, cross, cross.T, 0.5 * (own + own.T)
        moves = s.motion
        if begins or rests or s.frames[-1] == s.frames[-2] + 1:  # else the velocity before has left the window
            one = np.array([[-1 if unknown else K - 2, K - 1, K]])
            sigma = np.full(6, motion.STANDS / dt) if rests else motion.velocity_sigmas(self.models, dt, unknown)
            moves = moves.joined(Motion(one, np.array([[before or 1.0, dt]]), np.zeros((1, 6)), sigma[None] ** 2))
        return changed(
            s, frames=np.append(s.frames, s.frames[-1] + 1), stamps=np.append(t, stamp), motion=moves,
            poses=np.concatenate([s.poses, T[None]]), covariance=P, measured=False,
            by_rig=np.concatenate([s.by_rig, J @ s.by_rig]),
        )  # fmt: skip

    def in_view(self, s: WindowState) -> tuple[IndexArray, Array, Array, Array]:
        """Landmarks in the angle of view (paper A, Fig. 3), their pixels, and innovation covariances (M, 2, 2)."""
        marks, T = s.landmarks, s.poses[-1]
        rows = marks.order[self.visible(T, marks.position[marks.order])]
        local, C = _seen_from_newest(s, rows, s.relative(s.solved))
        in_world = marks.information[rows, 0, 0] > 0
        if in_world.any():
            C[in_world] = _seen_from_newest(s, rows[in_world], s.covariance[-6:, -6:])[1]
        return rows, *self.pixels(local, C)

    def updated(self, s: WindowState, ids: IdArray, z: Array, guess: Array | None) -> tuple[WindowState, UpdateReport]:
        """After measurements z (M, 3) of landmarks."""
        points, s = s.landmarks.rows_of(ids), changed(s, measured=True)
        if not len(points):
            return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        try:
            found = self._agreement(s, points, z, guess)
            s = changed(s, contradicted=found.contradicted)
            few = MIN_CONSENSUS if unknown_turn(s.relative(s.solved)) else 1  # of fewer no linearisation would hold
            if found.used.sum() < few:
                reason = "no observation passed the gate, or too few to tell how the camera is turned"
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, reason, ids.copy())
            return self._solved(s, found, points, ids, z)
        except np.linalg.LinAlgError as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"window: the pose cannot be solved for: {error}")

    def added(self, s: WindowState, ids: IdArray, z: Array) -> WindowState:
        """With new landmarks at their first sight z (M, 3) in the newest pose (paper A, Eqs. 8 and 10).

        Raises MeasurementError where one is in the map already, or has no right pixel or no positive depth.
        """
        s.landmarks.require_new(ids)
        s = _with_new(s, ids, *self.first_sight(ids, z))
        points = np.arange(len(s.landmarks) - len(z), len(s.landmarks))
        return changed(s, rows=s.rows.joined(self._rows(s, points, z)))

    def removed(self, s: WindowState, ids: IdArray) -> WindowState:
        """Without landmarks; what their measurements say of the poses stays.

        Raises MeasurementError where one is not in the map.
        """
        left = s.landmarks.ids.copy()
        left[s.landmarks.rows_of(ids)] = -1
        return changed(s, landmarks=changed(s.landmarks, ids=left))

    def inserted(self, s: WindowState, ids: IdArray, positions: Array, covariances: Array) -> WindowState:
        """With landmarks known in the world; see `slam.interfaces.MapBackend.insert`."""
        R = (s.poses[s.solved] if len(s.poses) else self.models.initial_pose)[:3, :3]
        information = np.linalg.inv(covariances)
        information = 0.5 * (information + np.swapaxes(information, 1, 2))
        return _with(s, WindowLandmarks(
            ids, s.serials + np.arange(len(ids)), positions, R.T @ covariances @ R, covariances, np.full(len(ids), -1),
            positions, information, np.zeros((len(ids), 3, s.by_rig.shape[1])),
        ))  # fmt: skip

    def placed(self, s: WindowState, ids: IdArray, local: Array, covariances: Array) -> WindowState:
        """With landmarks known in the newest camera's coordinates; see `slam.interfaces.MapBackend.place`."""
        s = _with_new(s, ids, local, covariances, np.zeros((len(ids), 3, s.by_rig.shape[1])))
        points = np.arange(len(s.landmarks) - len(ids), len(s.landmarks))
        return changed(s, places=s.places.joined(_places(s, points, local, covariances)))

    # --- parts of an update ---

    def _rows(self, s: WindowState, points: IndexArray, z: Array) -> Rows:
        """Measurements from the newest pose."""
        return Rows.of(len(s.frames) - 1, points, z, self.models.pixel_sigma)

    def _agreement(self, s: WindowState, points: IndexArray, z: Array, guess: Array | None) -> Agreement:
        """Initial value of the newest pose, and which measurements agree with it."""
        T, position = s.poses[-1], s.landmarks.position[points]
        local, own = _seen_from_newest(s, points)
        noise = pose_only.residual_noise(self.stereo, self.models.pixel_sigma, local, own, z)
        in_world = (s.landmarks.information[points, 0, 0] > 0).any() or s.solved == len(s.frames) - 1
        information = np.linalg.inv(s.covariance[-6:, -6:] if in_world else s.relative(s.solved))
        one = pose_only.PoseProblem(self.stereo, position, z, noise, T, information, self.models.gate_probability)

        def search() -> Array | None:
            return landmarks_pose(self, position, z, T, int(s.frames[-1]))

        return agreement(one, T if guess is None else guess, search, s.contradicted, _lost(s))

    def _solved(
        self, s: WindowState, found: Agreement, points: IndexArray, ids: IdArray, z: Array
    ) -> tuple[WindowState, UpdateReport]:
        """The state after an update with what agrees, solved again without rows that disagree with all others."""
        used, before = found.used.copy(), s.rows
        if found.jump is not None:
            s = _restarted(s, found.T, points)
            before = s.rows
        poses = np.concatenate([s.poses[:-1], found.T[None]])
        limits = self.limits(z)
        s = changed(s, poses=poses, rows=before.joined(self._rows(s, points[used], z[used])))
        w = changed(problem(s, self.stereo), asked=among(len(s.landmarks), points[used]))
        fresh = unknown_turn(s.covariance[-6:, -6:])
        for again in range(_SOLVED_AGAIN + 1):
            solution = solve(w, fresh=fresh)
            covariances = solution.point_covariances(len(poses) - 1)
            its = covariances[0][points[used]]
            distances = solution.left_out_distances(-1, points[used], z[used], its, self.models.pixel_sigma, _TESTED)
            bad = distances > limits[used]
            if not bad.any() or again == _SOLVED_AGAIN:
                break
            used[np.flatnonzero(used)[bad]] = False
            if not used.any():
                raise np.linalg.LinAlgError("no observation agrees with the others")
            s = changed(s, rows=before.joined(self._rows(s, points[used], z[used])))
            w = changed(solution.window, rows=s.rows)
        nis = max(solution.cost - s.cost, 0.0) if found.jump is None else float("nan")
        s = _after(s, solution, covariances, solution.by_rig(self.field(s.rows.z)), points[used])
        return s, UpdateReport(UpdateStatus.OK, "", ids[used], ids[~used], nis, int(np.isfinite(z[used]).sum()))


def _lost(s: WindowState) -> bool:
    """Whether the newest pose that saw landmarks may have turned anyhow since the problem began."""
    saw = np.flatnonzero(np.bincount(s.rows.pose, minlength=len(s.frames)) >= MIN_CONSENSUS)
    if not len(saw):
        return False
    i, R = 6 * saw[-1], s.poses[saw[-1], :3, :3]
    return unknown_turn(R @ s.covariance[i : i + 3, i : i + 3] @ R.T - s.turned)


def _seen_from_newest(s: WindowState, rows: IndexArray, by_motion: Array = _STILL) -> tuple[Array, Array]:
    """Landmarks in the newest camera's coordinates (M, 3), and covariances (M, 3, 3) there.

    They are for a known last solved pose, from which the camera has moved by what has the covariance (6, 6) given.
    """
    marks = s.landmarks
    return seen(s.poses[-1], s.poses[s.solved], marks.position[rows], marks.local[rows], by_motion)


def _with(s: WindowState, new: WindowLandmarks) -> WindowState:
    return changed(s, landmarks=s.landmarks.joined(new), serials=s.serials + len(new))


def _with_new(s: WindowState, ids: IdArray, local: Array, covariances: Array, by_rig: Array) -> WindowState:
    """With new landmarks at `local` (M, 3) in the newest camera, where errors of the rig move them by (M, 3, m)."""
    T, n = s.poses[-1], len(ids)
    R = T[:3, :3]
    by_pose = R @ points_by_pose(local)
    world = R @ covariances @ R.T + by_pose @ s.covariance[-6:, -6:] @ np.swapaxes(by_pose, 1, 2)
    turn = s.poses[s.solved][:3, :3].T @ R
    return _with(changed(s, measured=True), WindowLandmarks(
        ids, s.serials + np.arange(n), local @ R.T + T[:3, 3], turn @ covariances @ turn.T,
        0.5 * (world + np.swapaxes(world, 1, 2)), np.full(n, int(s.frames[-1])), np.zeros((n, 3)), np.zeros((n, 3, 3)),
        R @ by_rig - by_pose @ s.by_rig[-6:],
    ))  # fmt: skip


def _places(s: WindowState, points: IndexArray, local: Array, covariances: Array) -> Places:
    """Landmarks `points` at `local` (M, 3) in the newest camera, with covariances (M, 3, 3)."""
    T = s.poses[-1]
    world = local @ T[:3, :3].T + T[:3, 3]
    basis, _ = chart_kernels.relative_charts(T, world)
    axes = np.tile(T[:3, :3], (len(local), 1, 1))
    origin, D, _ = chart_kernels.chart_changes(T, world, basis, axes)
    root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(D @ covariances @ np.swapaxes(D, 1, 2))), 1, 2)
    return Places(np.full(len(points), len(s.frames) - 1), points, basis, origin, np.ascontiguousarray(root))


def _begun_anew(s: WindowState, T: Array, P: Array) -> WindowState:
    """A window of the newest pose alone, which is T (4, 4) with covariance P (6, 6); landmarks stay as they are."""
    turn, by_rig = T[:3, :3].T @ s.poses[s.solved][:3, :3], s.by_rig[-6:]
    return WindowState(
        s.frames[-1:], s.stamps[-1:], T[None], P, by_rig, begun=int(s.frames[-1]),
        turned=T[:3, :3] @ P[:3, :3] @ T[:3, :3].T,
        prior=RelativePrior.of_pose(T, P, by_rig), serials=s.serials, measured=s.measured, contradicted=s.contradicted,
        landmarks=changed(s.landmarks, local=turn @ s.landmarks.local @ turn.T),
    )  # fmt: skip


def _restarted(s: WindowState, T: Array, points: IndexArray) -> WindowState:
    """A window of one pose T (4, 4), where the landmarks say; they are placed relative to it."""
    local, own = _seen_from_newest(changed(s, poses=np.concatenate([s.poses[:-1], T[None]])), points)
    one = _begun_anew(s, T, world_covariance(s.covariance[-6:, -6:]))
    return changed(one, places=_places(one, points, local, own))


def _after(
    s: WindowState, solution: Solution, covariances: tuple[Array, Array], by_rig: tuple[Array, Array],
    measured: IndexArray,
) -> WindowState:  # fmt: skip
    """The state at a solution; landmarks that take no part become less certain with the motion since the last one."""
    marks, w, (local, world) = s.landmarks, solution.window, covariances
    part = (w.layout.place >= 0) | (np.diff(w.layout.first) > 0)
    there = changed(s, poses=w.poses, covariance=solution.pose_covariance, by_rig=by_rig[0])
    known = part & (np.einsum("nii->ni", local) > 0).all(axis=1) & (np.einsum("nii->ni", world) > 0).all(axis=1)
    others, last = np.flatnonzero(~known & (marks.ids >= 0)), marks.last.copy()
    if len(others):
        local[others] = _seen_from_newest(there, others, there.relative(s.solved))[1]
        world[others] = marks.world[others]
    last[measured] = s.frames[-1]
    marks = changed(
        marks, position=w.points, local=local, world=world, last=last,
        by_rig=np.where(part[:, None, None], by_rig[1], marks.by_rig),
    )  # fmt: skip
    return changed(there, cost=solution.cost, solved=len(s.frames) - 1, landmarks=marks)
