"""The window back end: the last poses and the landmarks that they see, solved together in every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from backends.smoother import pose_only
from backends.smoother.prediction import residual_noise
from backends.smoother.recovery import Agreement, agreement, world_covariance
from backends.smoother.stereo import RectifiedStereo
from backends.window import motion
from backends.window.config import WindowConfig
from backends.window.problem import problem
from backends.window.slide import slid
from backends.window.state import Landmarks, State
from slam.checks import require_guess, require_stamp
from slam.chi_square import chi_square_limits
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose
from slam.geometry.trajectory import Trajectory
from slam.mapping.known_landmarks import require_known
from slam.models import EstimatorModels
from slam.options import from_options
from slam.runtime.blas import one_blas_thread
from slam.tracking.agreement import landmarks_pose
from slam.window import kernels
from slam.window.problem import Camera, Places, RelativePrior, Rows
from slam.window.solver import Solution, linearised, solve


class WindowBackend:
    """A sliding-window filter (Sibley, Matthies and Sukhatme, J. Field Robotics 2010) with a relative marginal prior.

    Args:
        rig: the cameras; measurements of any rig are rectified first.
        models: noise, priors, motion and gate.
        options: see `WindowConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(WindowConfig, "window", options)
        self._stereo = RectifiedStereo.of(rig)
        self._camera = Camera.of(rig)
        self._sigma = models.pixel_sigma * self._stereo.scale
        self._state = State.empty()
        self._stamps: list[float] = []
        self._final: list[Array] = []

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        s = self._state
        require_stamp("window", stamp, float(s.stamps[-1]) if len(s.stamps) else None)
        left = None
        if not len(s.frames):
            T = self.models.initial_pose
            sigmas = np.repeat([self.models.initial_rotation_sigma, self.models.initial_position_sigma], 3)
            P = np.diag(sigmas**2)
            s = replace(
                s, frames=np.zeros(1, np.int64), stamps=np.array([float(stamp)]), poses=T[None], covariance=P,
                prior=RelativePrior.of_pose(T, P),
            )  # fmt: skip
        else:
            if len(s.frames) >= self.config.poses:
                before = s
                s = slid(s, self._camera, self.models, self.config)
                left = np.setdiff1d(before.frames, s.frames)[0]
                left = int(left), before.poses[np.searchsorted(before.frames, left)]
            s = self._advanced(s, float(stamp))
        prediction = self._in_view(s)
        frame = int(s.frames[-1])
        if left is not None:
            self._final[left[0]] = left[1]
        del self._stamps[frame:], self._final[frame:]
        self._stamps.append(float(stamp))
        self._final.append(s.poses[-1])
        self._state = s
        return prediction

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        s = self._started("update")
        require_guess("window", guess)
        points = s.landmarks.rows_of(observations.ids)
        if not len(points):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        z = self._measure(observations)
        try:
            found = self._agreement(s, points, z, observations, guess)
            if not found.used.any():
                self._state = replace(s, contradicted=found.contradicted)
                return UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", observations.ids)
            s, used, nis = self._solved(replace(s, contradicted=found.contradicted), found, points, z)
        except np.linalg.LinAlgError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"window: the pose cannot be solved for: {error}")
        self._state = s
        dof = int(np.isfinite(z[used]).sum())
        return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], nis, dof)

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        s = self._started("add")
        s.landmarks.require_new(observations.ids)
        if not len(observations):
            return
        z = self._measure(observations)
        local = self._triangulated(z)
        bad = ~np.isfinite(local).all(axis=1)
        if bad.any():
            raise MeasurementError(f"window: landmark {observations.ids[bad][0]} has no right pixel or no positive depth")
        covariance = self._triangulation_covariance(local)
        s = _with_new(s, observations.ids, local, covariance)
        points = np.arange(len(s.landmarks) - len(z), len(s.landmarks))
        self._state = replace(s, rows=_joined(s.rows, self._rows(s, points, z)))

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`. What its measurements said about the poses is kept."""
        s = self._state
        rows = s.landmarks.rows_of(np.unique(np.asarray(ids, np.int64)))
        left = s.landmarks.ids.copy()
        left[rows] = -1
        self._state = replace(s, landmarks=replace(s.landmarks, ids=left))

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        s = self._started("estimate")
        rows = s.landmarks.order if landmarks else np.zeros(0, np.intp)
        marks = s.landmarks
        return Estimate(
            float(s.stamps[-1]), s.poses[-1].copy(), s.covariance[-6:, -6:].copy(), marks.ids[rows],
            marks.position[rows], marks.world[rows],
        )  # fmt: skip

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        marks = self._state.landmarks
        return marks.position[marks.rows_of(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: poses that have left the window are final."""
        poses = np.array(self._final).reshape(-1, 4, 4)
        poses[self._state.frames] = self._state.poses
        return Trajectory(np.array(self._stamps), poses)

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        require_known("window", ids, positions, covariances)
        s = self._state
        s.landmarks.require_new(ids)
        if not len(ids):
            return
        R = s.poses[-1][:3, :3] if len(s.poses) else np.eye(3)
        information = np.linalg.inv(covariances)
        new = Landmarks(
            np.array(ids, np.int64), s.serials + np.arange(len(ids)), np.array(positions, float), R.T @ covariances @ R, np.array(covariances, float),
            np.full(len(ids), -1), np.array(positions, float), 0.5 * (information + np.swapaxes(information, 1, 2)),
        )  # fmt: skip
        self._done(_with(s, new), ("insert", np.array(ids), positions.copy(), covariances.copy()))

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        require_known("window", ids, local, covariances)
        s.landmarks.require_new(ids)
        if len(ids):
            s = _with_new(s, ids, local, covariances)
            points = np.arange(len(s.landmarks) - len(ids), len(s.landmarks))
            self._state = replace(s, places=_placed(s, points, local, covariances))

    # --- parts ---

    def _started(self, what: str) -> State:
        if not len(self._state.frames):
            raise MeasurementError(f"window: {what} before the first predict")
        return self._state

    def _measure(self, observations: Observations) -> Array:
        """Rectified (uL, vL, uR) (M, 3)."""
        rectified = self.rig.rectified
        z = np.empty((len(observations), 3))
        z[:, :2] = rectified.rectify_left(observations.uv_left)
        z[:, 2] = rectified.rectify_right(observations.uv_right)[:, 0]
        return z

    def _triangulated(self, z: Array) -> Array:
        shifted = z.copy()
        shifted[:, 2] -= self._stereo.doffs
        return self._stereo.triangulate(shifted)

    def _triangulation_covariance(self, local: Array) -> Array:
        _, J = self._stereo.project(local)
        inv = np.linalg.inv(J)
        return self._sigma**2 * inv @ np.swapaxes(inv, 1, 2)

    def _rows(self, s: State, points: IndexArray, z: Array) -> Rows:
        newest = np.full(len(points), len(s.frames) - 1)
        return Rows(newest, points, z, np.full(len(points), 1 / self._sigma))

    def _advanced(self, s: State, stamp: float) -> State:
        """The state with the next pose, by the motion model."""
        K, t = len(s.frames), s.stamps
        dt = min(stamp - t[-1], motion.LONGEST)
        J = np.zeros((6, 6 * K))
        first = s.frames[-1] == s.begun
        if first or K < 2:
            T, J[:, -6:], Jw = motion.predict_from_rest(s.poses[-1], dt)
        else:
            T, J[:, -12:-6], J[:, -6:], Jw = motion.predict(s.poses[-2], s.poses[-1], min(t[-1] - t[-2], motion.LONGEST), dt)
        sigmas = motion.velocity_sigmas(self.models, dt, bool(first))
        P = np.empty((6 * K + 6, 6 * K + 6))
        P[:-6, :-6] = s.covariance
        P[-6:, :-6] = J @ s.covariance
        P[:-6, -6:] = P[-6:, :-6].T
        P[-6:, -6:] = P[-6:, :-6] @ J.T + (Jw * sigmas**2) @ Jw.T
        P[-6:, -6:] = 0.5 * (P[-6:, -6:] + P[-6:, -6:].T)
        return replace(
            s, frames=np.append(s.frames, s.frames[-1] + 1), stamps=np.append(t, stamp),
            poses=np.concatenate([s.poses, T[None]]), covariance=P,
        )  # fmt: skip

    def _in_view(self, s: State) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        T, marks, rig = s.poses[-1], s.landmarks, self.rig
        rows = marks.order
        rows = rows[rig.left.in_view((marks.position[rows] - T[:3, 3]) @ T[:3, :3])]
        local, own = _seen_from(s, rows)
        by_pose = points_by_pose(local)
        C = own + by_pose @ _between(s, s.solved) @ np.swapaxes(by_pose, 1, 2)
        uv, J = rig.left.project_with_jacobian(local)
        right = rig.right.project((local + rig.b) @ rig.R.T)
        S = J @ C @ np.swapaxes(J, 1, 2) + self.models.pixel_sigma**2 * np.eye(2)
        S = 0.5 * (S + np.swapaxes(S, 1, 2))
        return Prediction(float(s.stamps[-1]), T.copy(), s.covariance[-6:, -6:].copy(), marks.ids[rows], uv, right, S)

    def _agreement(
        self, s: State, points: IndexArray, z: Array, observations: Observations, guess: Array | None
    ) -> Agreement:
        """Initial value of the newest pose, and which measurements agree with it."""
        T = s.poses[-1]
        local, own = _seen_from(s, points)
        shifted = z.copy()
        shifted[:, 2] -= self._stereo.doffs
        noise = residual_noise(self._stereo, self._sigma, local, own, shifted)
        known = (s.landmarks.information[points, 0, 0] > 0).any()
        P = s.covariance[-6:, -6:] if known or s.solved == len(s.frames) - 1 else _between(s, s.solved)
        position = s.landmarks.position[points]
        probability = self.models.gate_probability
        one = pose_only.PoseProblem(self._stereo, position, shifted, noise, T, np.linalg.inv(P), probability)

        def search() -> Array | None:
            rows = measurement_rows(observations.uv_left, observations.uv_right)
            return landmarks_pose(self.rig, position, rows, self.models, T, int(s.frames[-1]))

        return agreement(one, T if guess is None else guess, search, s.contradicted, False)

    def _solved(self, s: State, found: Agreement, points: IndexArray, z: Array) -> tuple[State, Array, float]:
        """The state after an update, which observations were used, and their NIS."""
        used = found.used.copy()
        predicted = s
        if found.jump is not None:
            s = self._restarted(s, found, points)
        poses = s.poses.copy()
        poses[-1] = found.T
        start = replace(s, poses=poses)
        limits = chi_square_limits(2 + np.isfinite(z[:, 2]), self.models.gate_probability)
        for _ in range(3):
            with_rows = replace(start, rows=_joined(s.rows, self._rows(s, points[used], z[used])))
            p = problem(with_rows, self._camera, self.models)
            solution = solve(p.window)
            camera, world = solution.point_covariances(len(s.frames) - 1)
            index = np.searchsorted(p.points, points[used])
            distances = kernels.left_out_distances(
                self._camera.parameters, self._camera.R_left, solution.window.poses[-1], solution.window.points[index],
                z[used], camera[index], self._sigma,
            )  # fmt: skip
            bad = distances > limits[used]
            if not bad.any():
                break
            used[np.flatnonzero(used)[bad]] = False
            if not used.any():
                raise np.linalg.LinAlgError("no observation agrees with the others")
        nis = max(solution.cost - s.cost, 0.0) if found.jump is None else float("nan")
        return _after(with_rows, predicted, solution, p.points, camera, world, points[used]), used, nis

    def _restarted(self, s: State, found: Agreement, points: IndexArray) -> State:
        """A window of one pose, where the landmarks say; they are placed relative to it."""
        P = world_covariance(s.covariance[-6:, -6:])
        local, own = _seen_from(replace(s, poses=np.concatenate([s.poses[:-1], found.T[None]])), points)
        one = replace(
            s, frames=s.frames[-1:], stamps=s.stamps[-1:], poses=found.T[None], covariance=P, solved=0,
            begun=int(s.frames[-1]), rows=Rows.none(), places=Places.none(), prior=RelativePrior.of_pose(found.T, P),
            cost=0.0,
        )  # fmt: skip
        return replace(one, places=_placed(one, points, local, own))


def _joined(first: Rows, second: Rows) -> Rows:
    return Rows(*(np.concatenate([a, b]) for a, b in zip(vars(first).values(), vars(second).values())))


def _seen_from(s: State, rows: IndexArray) -> tuple[Array, Array]:
    """Landmarks in the newest camera's coordinates (M, 3), and covariances (M, 3, 3) relative to the last solved pose."""
    T, marks = s.poses[-1], s.landmarks
    turn = T[:3, :3].T @ s.poses[s.solved][:3, :3]
    return (marks.position[rows] - T[:3, 3]) @ T[:3, :3], turn @ marks.local[rows] @ turn.T


def _between(s: State, earlier: int) -> Array:
    """Covariance (6, 6) of the newest pose relative to an earlier one of the window."""
    if earlier == len(s.frames) - 1:
        return np.zeros((6, 6))
    i = 6 * earlier
    A = adjoint(inverse(s.poses[-1]) @ s.poses[earlier])
    P, cross = s.covariance, A @ s.covariance[i : i + 6, -6:]
    return P[-6:, -6:] + A @ P[i : i + 6, i : i + 6] @ A.T - cross - cross.T


def _with_new(s: State, ids: IdArray, local: Array, covariances: Array) -> State:
    """With new landmarks at `local` in the newest camera."""
    T = s.poses[-1]
    R = T[:3, :3]
    by_pose = R @ points_by_pose(local)
    world = R @ covariances @ R.T + by_pose @ s.covariance[-6:, -6:] @ np.swapaxes(by_pose, 1, 2)
    turn = s.poses[s.solved][:3, :3].T @ R
    n = len(ids)
    new = Landmarks(
        np.array(ids, np.int64), s.serials + np.arange(n), local @ R.T + T[:3, 3], turn @ covariances @ turn.T,
        0.5 * (world + np.swapaxes(world, 1, 2)), np.full(n, int(s.frames[-1])), np.zeros((n, 3)), np.zeros((n, 3, 3)),
    )  # fmt: skip
    return _with(s, new)


def _with(s: State, new: Landmarks) -> State:
    return replace(s, landmarks=s.landmarks.joined(new), serials=s.serials + len(new))


def _placed(s: State, points: IndexArray, local: Array, covariances: Array) -> Places:
    """The state's places with landmarks `points` at `local` in the newest camera."""
    T = s.poses[-1]
    world = local @ T[:3, :3].T + T[:3, 3]
    basis, _ = kernels.relative_charts(T, world)
    turn = np.ascontiguousarray(np.broadcast_to(T[:3, :3], (len(local), 3, 3)))
    origin, D, _ = kernels.chart_changes(T, world, basis, turn)
    root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(D @ covariances @ np.swapaxes(D, 1, 2))), 1, 2)
    new = Places(np.full(len(points), len(s.frames) - 1), points, basis, origin, np.ascontiguousarray(root))
    return Places(*(np.concatenate([a, b]) for a, b in zip(vars(s.places).values(), vars(new).values())))


def _after(
    s: State, predicted: State, solution: Solution, points: IndexArray, camera: Array, world: Array, seen: IndexArray
) -> State:
    """The state at a solution."""
    marks, w = s.landmarks, solution.window
    position, local, whole, last = marks.position.copy(), marks.local, marks.world.copy(), marks.last.copy()
    P = solution.pose_covariance
    there = replace(s, poses=w.poses, covariance=P)
    # Landmarks that take no part become less certain with the motion since the last solution.
    turn = w.poses[-1][:3, :3].T @ w.poses[s.solved][:3, :3]
    by_pose = points_by_pose((position - w.poses[-1][:3, 3]) @ w.poses[-1][:3, :3])
    local = turn @ local @ turn.T + by_pose @ _between(there, s.solved) @ np.swapaxes(by_pose, 1, 2)
    position[points], local[points], whole[points] = w.points, camera, world
    last[seen] = s.frames[-1]
    return replace(
        there, cost=solution.cost, solved=len(s.frames) - 1,
        landmarks=replace(marks, position=position, local=local, world=whole, last=last),
    )  # fmt: skip
