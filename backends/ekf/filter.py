"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, wraps
from typing import Any, TypeVar

import numpy as np
from scipy.linalg.blas import dgemm, dgemv
from threadpoolctl import ThreadpoolController

from backends.ekf.angles import LIMIT, anchor, attitude, pose_jacobian, reanchor
from backends.ekf.config import EkfConfig
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.measurement import chained, innovation_covariances, linearise
from backends.ekf.solve import Gated, Problem, Solution, UnsolvableError, gate, solve
from slam import se3
from slam.data import Estimate, IdArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.euler import angles, body_rate_matrix
from slam.models import EstimatorModels
from slam.rig import StereoRig
from slam.se3 import Array
from slam.trajectory import Trajectory

_F = TypeVar("_F", bound=Callable[..., Any])

#: By how much an impulse may exceed its standard deviation where most observations say so.
_SURPRISES = (3.0, 10.0)
_ENOUGH = 6  # observations that can be judged to agree with each other


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    """The BLAS libraries that are loaded, looked up once."""
    return ThreadpoolController()


def _one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread: the same sums in the same order on every machine, and no waiting on a busy one."""

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited  # type: ignore[return-value]


class EkfBackend:
    """Extended Kalman filter over the camera's motion and the landmarks, the papers' state estimator.

    The state is ``[r, φ, v, ω]`` (12), world position, Euler angles, world velocity and angle rates (paper B, section
    2), then three world coordinates per landmark. The camera moves at constant velocity disturbed by impulses, with
    the printed A and W. A landmark enters with its full cross-covariance (paper A, Eqs. 8 and 10). See
    `backends.ekf.angles` for the angles' world and for what the Euler model costs.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        options: see `EkfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = EkfConfig.from_options(options)
        self._stamps: list[float] = []
        self._poses: list[Array] = []
        self._ids = np.zeros(0, np.int64)  # by slot
        self._slots: dict[int, int] = {}
        self._points = np.zeros((0, 3))  # by slot
        self._R_world_angles, phi = anchor(models.initial_pose[:3, :3])
        self._camera = np.concatenate([models.initial_pose[:3, 3], phi, np.zeros(6)])
        self._covariance = Covariance(self._initial_covariance())

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @_one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        if not np.isfinite(stamp) or (self._stamps and stamp <= self._stamps[-1]):
            last = f" after {self._stamps[-1]}" if self._stamps else ""
            raise MeasurementError(f"ekf: stamp {stamp}{last}: time must be finite and increase")
        if self._stamps:
            self._advance(stamp - self._stamps[-1])
        self._stamps.append(float(stamp))
        self._poses.append(self._pose())
        return self._prediction()

    @_one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        self._require_started("update")
        slots = self._slots_of(observations.ids)
        if not len(slots):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        G = self._covariance.gather(slots)
        try:
            problem = self._problem(observations, slots, G, guess)
            problem, gated, surprise = self._gated(problem)
            solution = solve(problem, gated)
            if solution is not None:
                self._correct(G, solution, surprise)
        except UnsolvableError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"ekf: {error}")
        if solution is None:
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", observations.ids)
        used = solution.used
        dof = int(np.isfinite(problem.z[used]).sum())
        return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], solution.nis, dof)

    @_one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._require_started("add")
        for i in observations.ids.tolist():
            if i in self._slots:
                raise MeasurementError(f"ekf: landmark {i} is in the map already")
        if not len(observations):
            return
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)  # paper A, Eq. (8)
        bad = ~np.isfinite(h).all(axis=1)
        if bad.any():
            raise MeasurementError(f"ekf: landmark {observations.ids[bad][0]} has no right pixel or no positive depth")
        R, E = self._rotation(), body_rate_matrix(self._camera[3:6])
        J = np.tile(np.eye(3, POSE), (len(h), 1, 1))
        J[:, :, 3:] = -R @ se3.hat(h) @ E  # turning by δθ = E δφ about the camera's axes moves h by δθ × h
        noise = R @ self.rig.triangulation_covariance(h, self.models.pixel_sigma) @ R.T
        self._covariance.append(J, noise)
        self._points = np.concatenate([self._points, self._camera[:3] + h @ R.T])  # paper A, Eq. (10)
        self._slots.update(zip(observations.ids.tolist(), range(len(self._ids), len(self._ids) + len(h))))
        self._ids = np.concatenate([self._ids, observations.ids])

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`."""
        ids = np.unique(np.asarray(ids, np.int64))
        self._slots_of(ids)
        count = len(self._ids)
        for i in ids.tolist():
            slot, count = self._slots.pop(i), count - 1
            self._covariance.drop(slot)
            if slot != count:
                self._ids[slot], self._points[slot] = self._ids[count], self._points[count]
                self._slots[int(self._ids[slot])] = slot
        self._ids, self._points = self._ids[:count], self._points[:count]

    @_one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        self._require_started("estimate")
        slots = np.argsort(self._ids) if landmarks else np.zeros(0, np.intp)
        return Estimate(
            self._stamps[-1], self._poses[-1].copy(), self._pose_covariance(),
            self._ids[slots], self._points[slots], self._covariance.blocks(slots),
        )  # fmt: skip

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self._points[self._slots_of(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was believed at each stamp, never revised."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))

    # --- the filter's parts ---

    def _initial_covariance(self) -> Array:
        """The camera's prior (12, 12): isotropic in body axes, hence through the angles' rate matrix."""
        m, P = self.models, np.zeros((CAMERA, CAMERA))
        E = np.linalg.inv(body_rate_matrix(self._camera[3:6]))
        P[0:3, 0:3] = m.initial_position_sigma**2 * np.eye(3)
        P[3:6, 3:6] = m.initial_rotation_sigma**2 * E @ E.T
        P[6:9, 6:9] = m.initial_velocity_sigma**2 * np.eye(3)
        P[9:12, 9:12] = m.initial_angular_velocity_sigma**2 * E @ E.T
        return P

    def _advance(self, dt: float) -> None:
        """The printed transition (paper B, section 2), in pieces where it would run into the angles' singularity."""
        if abs(self._camera[4] + self._camera[10] * dt) > LIMIT:
            self._reanchor()
        pieces = int(np.clip(np.ceil(abs(self._camera[10]) * dt / LIMIT), 1, 64))
        for _ in range(pieces):
            self._transition(dt / pieces)
            self._reanchor_if_needed()

    def _transition(self, dt: float) -> None:
        """``x ← f(x)`` and ``P ← A P Aᵀ + W Q Wᵀ`` with the printed A and W."""
        self._camera[:POSE] += dt * self._camera[POSE:]
        self._covariance.move_camera(dt, self._motion_noise(dt))

    def _motion_noise(self, dt: float) -> Array:
        """``W Q Wᵀ`` (12, 12)."""
        W = np.concatenate([dt * np.eye(6), np.eye(6)])
        linear, angular = self.models.motion.velocity_variance(dt)
        return W @ np.diag([linear] * 3 + [angular] * 3) @ W.T

    def _reanchor_if_needed(self) -> None:
        """Choose a new angles' world where φy comes near its singularity."""
        if abs(np.sin(self._camera[4])) > np.sin(LIMIT) or np.cos(self._camera[4]) < 0:
            self._reanchor()

    def _reanchor(self) -> None:
        self._R_world_angles, self._camera, J = reanchor(self._R_world_angles, self._camera)
        self._covariance.transform_camera(J)

    def _rotation(self) -> Array:
        return attitude(self._R_world_angles, self._camera[3:6])

    def _pose(self) -> Array:
        return se3.pose(self._rotation(), self._camera[:3])

    def _pose_covariance(self) -> Array:
        J = pose_jacobian(self._poses[-1][:3, :3], self._camera[3:6])
        return J @ self._covariance.pose @ J.T

    def _prediction(self) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        T, covariance = self._poses[-1].copy(), self._covariance
        R, phi = T[:3, :3], self._camera[3:6]
        h = (self._points - T[:3, 3]) @ R
        slots = np.flatnonzero(self.rig.left.in_view(h))
        h = h[slots]
        line = chained(*self.rig.left.project_with_jacobian(h), h, R, phi)
        right = self.rig.right.project((h + self.rig.b) @ self.rig.R.T)
        S = innovation_covariances(
            line, covariance.pose, covariance.cross(slots), covariance.blocks(slots), self.models.pixel_sigma
        )
        return Prediction(self._stamps[-1], T, self._pose_covariance(), self._ids[slots], line.z, right, S)

    def _problem(self, observations: Observations, slots: Array, G: Array, guess: Array | None) -> Problem:
        """The update in the coordinates [r, φ, measured landmarks]; G are their columns of the covariance."""
        z = np.concatenate([observations.uv_left, observations.uv_right[:, :1]], axis=1)
        if self.config.measurement == "left":
            z[:, 2] = np.nan
        rows = np.concatenate([np.arange(POSE), (CAMERA + 3 * slots[:, None] + np.arange(3)).reshape(-1)])
        prior = np.concatenate([self._camera[:POSE], self._points[slots].reshape(-1)])
        R = self._R_world_angles
        return Problem(
            prior, G[rows], z, self.models.pixel_sigma,
            lambda x: linearise(self.rig, R, x[:POSE], x[POSE:].reshape(-1, 3)),
            self.config.iterations, self.models.gate_probability,
            None if guess is None else self._change_to(guess),
        )  # fmt: skip

    def _change_to(self, T_world_left: Array) -> Array:
        """The change of [r, φ] (6,) that moves the pose to `T_world_left`."""
        phi, before = angles(self._R_world_angles.T @ T_world_left[:3, :3]), self._camera[3:6]
        twin = np.array([phi[0] + np.pi, np.pi - phi[1], phi[2] + np.pi])  # the same rotation
        changes = np.stack([phi, twin]) - before
        changes -= 2 * np.pi * np.round(changes / (2 * np.pi))
        nearest = changes[np.argmin(np.linalg.norm(changes, axis=1))]
        return np.concatenate([T_world_left[:3, 3] - self._camera[:3], nearest])

    def _gated(self, problem: Problem) -> tuple[Problem, Gated, Array | None]:
        """Gate the observations; where most fail together, the prediction is at fault and not they.

        It may be so far off that its linearisation does not hold: then the guess may serve. Or an impulse (or a turn
        that the Euler model does not follow) was larger than the motion model expects: then all predictions are off
        together, while the observations agree with each other. If a wider motion noise lets most of them pass, that
        noise was there: it joins the prediction's covariance. What still disagrees is taken out later by `solve`.

        Returns:
            the problem, its gate, and the noise (12, 12) to add to the camera's covariance, or None.
        """
        first = gate(problem)
        most = max(_ENOUGH, (len(problem.z) + 1) // 2)
        if len(problem.z) < most or first.used.sum() >= most or len(self._stamps) < 2:
            return problem, first, None
        for factor in (0.0, *_SURPRISES):
            noise = factor**2 * self._motion_noise(self._stamps[-1] - self._stamps[-2])
            covariance = problem.covariance.copy()
            covariance[:POSE, :POSE] += noise[:POSE, :POSE]
            wider = replace(problem, covariance=covariance)
            for at_guess in (False,) if problem.guess is None else (False, True):
                gated = gate(wider, at_guess)
                if gated.used.sum() >= most:
                    return wider, gated, noise
        return problem, first, None

    def _correct(self, G: Array, solution: Solution, surprise: Array | None) -> None:
        """Change the whole state and covariance, or nothing; `surprise` (12, 12) adds to the camera's covariance.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        if surprise is not None:
            G[:CAMERA, :POSE] += surprise[:, :POSE]
        change, W = dgemv(1.0, G, solution.s), dgemm(1.0, G, solution.B)
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if surprise is not None:
            self._covariance.move_camera(0.0, surprise)
        self._camera = self._camera + change[:CAMERA]
        self._points = self._points + change[CAMERA : self._covariance.size].reshape(-1, 3)
        self._covariance.subtract(W)
        self._reanchor_if_needed()
        self._poses[-1] = self._pose()

    def _slots_of(self, ids: IdArray | Sequence[int]) -> Any:
        """Slots (M,) of landmark ids."""
        try:
            return np.array([self._slots[int(i)] for i in ids], np.intp)
        except KeyError as error:
            raise MeasurementError(f"ekf: landmark {error.args[0]} is not in the map") from None

    def _require_started(self, what: str) -> None:
        if not self._stamps:
            raise MeasurementError(f"ekf: {what} before the first predict")
