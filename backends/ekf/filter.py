"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from backends.ekf.angles import LIMIT, anchor, attitude, pose_jacobian, reanchor
from backends.ekf.config import EkfConfig
from backends.ekf.covariance import CAMERA, POSE, Covariance, SlotArray
from backends.ekf.landmarks import COORDINATES, Landmarks, far_charts
from backends.ekf.measurement import StereoMeasurement, chained, innovation_covariances
from backends.ekf.objects import ObjectFilter
from backends.ekf.objects_body import CameraBelief
from backends.ekf.solve import Gated, Problem, Solution, UnsolvableError, gate, solve
from slam.data import Estimate, IdArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.geometry.euler import angles, body_rate_matrix, rotation
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.mapping.known_landmarks import require_known
from slam.models import EstimatorModels
from slam.object_data import ObjectEstimate, ObjectObservations
from slam.options import from_options
from slam.runtime.blas import one_blas_thread

#: By how much an impulse may exceed its standard deviation where most observations say so.
_SURPRISES = (3.0, 10.0)
_PIECES = 64  # at most, of one step through the angles' singularity
_SMALL_TURN = 0.2  # of a step whose error may be carried as a turn about the world's axes [rad]
_ENOUGH = 6  # observations that can be judged to agree with each other


class EkfBackend:
    """Extended Kalman filter over the camera's motion and the landmarks, the papers' state estimator.

    The state is ``[r, φ, v, ω]`` (12), world position, Euler angles, world velocity and angle rates (paper B, section
    2), then three coordinates per landmark. The camera moves at constant velocity disturbed by impulses, with
    the printed A and W. A landmark enters with its full cross-covariance (paper A, Eqs. 8 and 10). See
    `backends.ekf.angles` for the angles' world and for what the Euler model costs.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        options: see `EkfConfig`.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    #: Of a known map: with more, the joint covariance (72 N² bytes, and copies of it while it grows) is too large.
    most_landmarks = 2000

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(EkfConfig, "ekf", options)
        self._stamps: list[float] = []
        self._poses: list[Array] = []
        self._landmarks = Landmarks(COORDINATES[self.config.landmarks])
        self._R_world_angles, phi = anchor(models.initial_pose[:3, :3])
        self._camera = np.concatenate([models.initial_pose[:3, 3], phi, np.zeros(6)])
        self._covariance = Covariance(self._initial_covariance())
        self._objects = ObjectFilter(rig, models, self.config.iterations)
        self._has_objects = False

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
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

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        self._require_started("update")
        slots = self._landmarks.slots(observations.ids)
        if not len(slots):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        joined = self._covariance.make_local(slots)
        if self._consistent:
            self._refer_landmarks(joined)
        try:
            problem = self._problem(observations, slots, guess)
            problem, gated, surprise = self._gated(problem)
            solution = solve(problem, gated)
            if solution is not None:
                self._correct(slots, solution, surprise)
        except UnsolvableError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"ekf: {error}")
        if solution is None:
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", observations.ids)
        used = solution.used
        dof = int(np.isfinite(problem.z[used]).sum())
        return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], solution.nis, dof)

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._require_started("add")
        self._landmarks.require_new(observations.ids)
        if not len(observations):
            return
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)  # paper A, Eq. (8)
        bad = ~np.isfinite(h).all(axis=1)
        if bad.any():
            raise MeasurementError(f"ekf: landmark {observations.ids[bad][0]} has no right pixel or no positive depth")
        self._place(observations.ids, h, self.rig.triangulation_covariance(h, self.models.pixel_sigma))

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`."""
        ids = np.unique(np.asarray(ids, np.int64))
        holes, movers = self._covariance.drop(self._landmarks.slots(ids))
        self._landmarks.remove(ids, holes, movers)
        self._objects.landmarks_dropped(holes, movers, len(self._landmarks))

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        self._require_started("estimate")
        marks = self._landmarks
        slots = np.argsort(marks.ids) if landmarks else np.zeros(0, np.intp)
        D = marks.jacobian(slots)
        return Estimate(
            self._stamps[-1], self._poses[-1].copy(), self._pose_covariance(),
            marks.ids[slots], marks.points[slots], D @ self._covariance.of_landmarks(slots)[0] @ D.transpose(0, 2, 1),
        )  # fmt: skip

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self._landmarks.points[self._landmarks.slots(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was believed at each stamp, never revised."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        require_known("ekf", ids, positions, covariances)
        self._landmarks.require_new(ids)
        if len(ids):
            D = self._landmarks.append(ids, far_charts(positions, covariances), positions)
            self._append(np.zeros((len(ids), 3, POSE)), D @ covariances @ D.transpose(0, 2, 1))

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        self._require_started("place")
        require_known("ekf", ids, local, covariances)
        self._landmarks.require_new(ids)
        if len(ids):
            self._place(ids, local, covariances)

    # --- moving bodies (documented in slam.interfaces.ObjectBackend) ---

    @one_blas_thread
    def update_objects(self, observations: Sequence[ObjectObservations]) -> list[ObjectEstimate]:
        """See `slam.interfaces.ObjectBackend.update_objects`."""
        self._require_started("update_objects")
        self._has_objects = self._has_objects or bool(observations)
        T, columns = self._poses[-1], self._covariance.columns(np.zeros(0, np.intp))
        camera = CameraBelief(T, pose_jacobian(T[:3, :3], self._camera[3:6]), columns)
        return self._objects.update(observations, self._stamps[-1], camera)

    def remove_objects(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.ObjectBackend.remove_objects`."""
        self._objects.remove(ids)
        self._has_objects = bool(self._objects.count)

    # --- the filter's parts ---

    def _place(self, ids: IdArray, h: Array, covariances: Array) -> None:
        """Landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10)."""
        R, E = self._rotation(), body_rate_matrix(self._camera[3:6])
        J = np.tile(np.eye(3, POSE), (len(h), 1, 1))
        J[:, :, 3:] = -R @ se3.hat(h) @ E  # turning by δθ = E δφ about the camera's axes moves h by δθ × h
        noise = R @ covariances @ R.T
        anchors = np.tile(self._pose()[:3], (len(h), 1, 1))
        D = self._landmarks.append(ids, anchors, self._camera[:3] + h @ R.T)
        self._append(D @ J, D @ noise @ D.transpose(0, 2, 1))

    def _append(self, J: Array, noise: Array) -> None:
        """Landmarks join with derivatives (M, 3, 6) by [r, φ] and covariances (M, 3, 3) of what does not hang on it."""
        self._covariance.append(J, noise)
        self._objects.landmarks_appended(J)

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
        turn = float(self._camera[10]) * dt
        if abs(float(self._camera[4]) + turn) > LIMIT:
            self._reanchor()
            turn = float(self._camera[10]) * dt
        pieces = max(1, math.ceil(min(abs(turn) / LIMIT, _PIECES)))
        for _ in range(pieces):
            self._transition(dt / pieces)
            self._reanchor_if_needed()

    def _transition(self, dt: float) -> None:
        """``x ← f(x)`` and ``P ← A P Aᵀ + W Q Wᵀ`` with the printed A and W."""
        before = self._camera.copy()
        self._camera[:POSE] += dt * self._camera[POSE:]
        if self._consistent and np.abs(self._camera[3:6] - before[3:6]).max() < _SMALL_TURN:
            self._turn_with(before)
        self._covariance.move_camera(dt, self._motion_noise(dt))
        self._objects.camera_moved(dt)

    def _motion_noise(self, dt: float) -> Array:
        """``W Q Wᵀ`` (12, 12)."""
        noise, each = np.zeros((2, POSE, 2, POSE)), np.arange(POSE)
        variances = np.repeat(self.models.motion.velocity_variance(dt), 3)
        noise[:, each, :, each] = variances[:, None, None] * np.array([[dt * dt, dt], [dt, 1.0]])
        return noise.reshape(CAMERA, CAMERA)

    def _reanchor_if_needed(self) -> None:
        """Choose a new angles' world where φy comes near its singularity."""
        if abs(math.sin(self._camera[4])) > math.sin(LIMIT) or math.cos(self._camera[4]) < 0:
            self._reanchor()

    def _reanchor(self) -> None:
        self._R_world_angles, self._camera, J = reanchor(self._R_world_angles, self._camera)
        self._covariance.transform_camera(J)
        self._objects.camera_transformed(J)

    def _rotation(self) -> Array:
        return attitude(self._R_world_angles, self._camera[3:6])

    def _pose(self) -> Array:
        return se3.pose(self._rotation(), self._camera[:3])

    def _pose_covariance(self) -> Array:
        J = pose_jacobian(self._poses[-1][:3, :3], self._camera[3:6])
        return J @ self._covariance.pose @ J.T

    def _prediction(self) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        T, covariance, marks = self._poses[-1].copy(), self._covariance, self._landmarks
        R = T[:3, :3]
        h = (marks.points - T[:3, 3]) @ R
        slots = np.flatnonzero(self.rig.left.in_view(h))
        h = h[slots]
        z, J = self.rig.project_stereo(h)
        right = z[:, [2, 1]] if self.rig.is_rectified else self.rig.project(h)[1]
        line = chained(z[:, :2], J[:, :2], h, R, self._camera[3:6], marks.jacobian(slots))
        blocks, cross = covariance.of_landmarks(slots)
        S = innovation_covariances(line, covariance.pose, cross, blocks, self.models.pixel_sigma)
        return Prediction(self._stamps[-1], T, self._pose_covariance(), marks.ids[slots], line.z, right, S)

    def _problem(self, observations: Observations, slots: SlotArray, guess: Array | None) -> Problem:
        """The update in the coordinates [r, φ, measured landmarks]."""
        z = np.concatenate([observations.uv_left, observations.uv_right[:, :1]], axis=1)
        if self.config.measurement == "left":
            z[:, 2] = np.nan
        marks = self._landmarks
        prior = np.concatenate([self._camera[:POSE], marks.state[slots].reshape(-1)])
        model = StereoMeasurement(self.rig, self._R_world_angles, marks.coordinates, marks.anchors[slots])
        return Problem(
            prior, self._covariance.marginal(slots), z, self.models.pixel_sigma, model,
            self.config.iterations, self.models.gate_probability,
            None if guess is None else self._change_to(guess),
        )  # fmt: skip

    def _change_to(self, T_world_left: Array) -> Array:
        """The change of [r, φ] (6,) that moves the pose to `T_world_left`."""
        phi, before = angles(self._R_world_angles.T @ T_world_left[:3, :3]), self._camera[3:6]
        rectified_rig = np.array([phi[0] + np.pi, np.pi - phi[1], phi[2] + np.pi])  # the same rotation
        changes = np.stack([phi, rectified_rig]) - before
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
        if len(problem.z) < most or first.used.sum() >= most:
            return problem, first, None
        started = len(self._stamps) > 1
        dt = self._stamps[-1] - self._stamps[-2] if started else 0.0
        for factor in (0.0, *_SURPRISES) if started else (0.0,):
            noise = factor**2 * self._motion_noise(dt)
            covariance = problem.covariance.copy()
            covariance[:POSE, :POSE] += noise[:POSE, :POSE]
            wider = replace(problem, covariance=covariance)
            for at_guess in (False,) if problem.guess is None else (False, True):
                gated = gate(wider, at_guess)
                if gated.used.sum() >= most:
                    return wider, gated, noise
        return problem, first, None

    def _correct(self, slots: SlotArray, solution: Solution, surprise: Array | None) -> None:
        """Change the whole state and covariance, or nothing; `surprise` (12, 12) adds to the camera's covariance.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        covariance = self._covariance
        if surprise is not None:
            covariance.move_camera(0.0, surprise)
        change = covariance.times(slots, solution.s)
        if not np.isfinite(change).all():
            if surprise is not None:
                covariance.move_camera(0.0, -surprise)
            raise UnsolvableError("the corrected state is not finite")
        if self._has_objects:
            self._objects.camera_corrected(slots, solution, covariance.columns(slots) @ solution.B)
        covariance.subtract(slots, solution.B)
        before = self._camera
        self._camera = self._camera + change[:CAMERA]
        self._landmarks.move(change[CAMERA:].reshape(-1, 3))
        if self._consistent and solution.at_prior:
            self._transport(before)
        elif self._consistent:  # it refers to about the corrected state already
            self._landmarks.transport(covariance.local)
        self._reanchor_if_needed()
        self._poses[-1] = self._pose()

    # --- what nothing measures ---

    @property
    def _consistent(self) -> bool:
        """Whether the covariance is referred to the corrected state. The bodies' correlation with it cannot follow."""
        return self.config.consistent and self.config.measurement == "stereo" and not self._has_objects

    def _transport(self, before: Array) -> None:
        """Refer the covariance to the corrected state; `before` is the camera's (12,) that it still refers to.

        Nothing measures a displacement of camera and landmarks together. What it changes in each coordinate depends on
        the state, though (how far the world's origin is, which way is depth), and an update moves the state. A filter
        that goes on with the same covariance believes to have measured such displacements, in time very well (Huang,
        Mourikis and Roumeliotis, 2010). So the error is taken to be the displacement, in old coordinates and in new,
        and what it leaves, which stays as it is: the error of an invariant filter (Barrau and Bonnabel, 2015).
        """
        A, A_before = self._turning(self._camera), self._turning(before)
        change, J = self._camera - before, np.eye(CAMERA)
        J[:3, 3:6] = -se3.hat(change[:3]) @ A_before
        J[3:6, 3:6] = np.linalg.solve(A, A_before)
        J[6:9, 3:6] = -se3.hat(change[6:9]) @ A_before
        self._covariance.transform_camera(J)
        self._objects.camera_transformed(J)
        self._refer_landmarks(self._covariance.local)

    def _turn_with(self, before: Array) -> None:
        """Carry the attitude's error through a step as a turn about the world's axes, not as one of the angles φ.

        The printed transition has constant rates of the angles, which is not the same in another world. The difference
        is of second order; in long steps, where it would not be, the transition is left as printed.
        """
        J = np.eye(CAMERA)
        J[3:6, 3:6] = np.linalg.solve(self._turning(self._camera), self._turning(before))
        self._covariance.transform_camera(J)
        self._objects.camera_transformed(J)

    def _refer_landmarks(self, slots: SlotArray) -> None:
        """The same for landmarks, those that became local last, by the displacement that the camera's [r, φ] has."""
        if not len(slots):
            return
        world, A = np.eye(6), self._turning(self._camera)
        world[:3, 3:], world[3:, 3:] = se3.hat(self._camera[:3]) @ A, A
        K = self._landmarks.transport(slots) @ world
        if K.any():
            self._covariance.transform_landmarks(K)

    def _turning(self, camera: Array) -> Array:
        """Derivative (3, 3) of the attitude, turned about the world's axes, by the angles φ."""
        return self._R_world_angles @ rotation(camera[3:6]) @ body_rate_matrix(camera[3:6])

    def _require_started(self, what: str) -> None:
        if not self._stamps:
            raise MeasurementError(f"ekf: {what} before the first predict")
