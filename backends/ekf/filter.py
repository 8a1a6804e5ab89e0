"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from backends.ekf.angles import LIMIT, anchor, attitude, pose_jacobian, reanchor
from backends.ekf.atomic import all_or_nothing
from backends.ekf.config import EkfConfig
from backends.ekf.covariance import CAMERA, POSE, Covariance, SlotArray
from backends.ekf.landmarks import COORDINATES, Landmarks, far_charts
from backends.ekf.measurement import StereoMeasurement, chained, innovation_covariances
from backends.ekf.objects import ObjectFilter
from backends.ekf.objects_body import CameraBelief
from backends.ekf.recovery import Agreement, agreement, landmarks_pose
from backends.ekf.solve import Problem, Solution, UnsolvableError
from slam.checks import require_guess, require_stamp
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
_ANY_ATTITUDE = 2 * np.pi  # standard deviation of angles that say nothing of an attitude [rad]
_ANYWHERE = 1e3  # standard deviation of a position of which nothing is known [m]
_PIXELS = 1e5  # no pixel of an image is further from its origin; such a measurement is rejected in any case
_DISPARITY = 0.01  # below this [px] a disparity is none: the landmark is put where it would be so large
_VAGUE = 1e3  # deviation of an innovation, in those of a pixel, above which all of P is brought up to date
_PIECES = 64  # at most, of one step through the angles' singularity
_SMALL_TURN = 0.2  # of a step whose error may be carried as a turn about the world's axes [rad]


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
        self._farthest = rig.left.fu * float(np.linalg.norm(rig.b)) / _DISPARITY  # depth of a new landmark [m]

    def saved(self) -> Callable[[], None]:
        """A function that puts everything back as it is now."""
        parts = (self._covariance.saved(), self._landmarks.saved(), self._objects.saved())
        before, count, last = (self._camera, self._R_world_angles), len(self._stamps), self._poses[-1:]

        def restore() -> None:
            for part in parts:
                part()
            self._camera, self._R_world_angles = before
            del self._stamps[count:], self._poses[count:]
            self._poses[count - len(last) :] = last

        return restore

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    @all_or_nothing
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        require_stamp("ekf", stamp, self._stamps[-1] if self._stamps else None)
        if self._stamps:
            self._advance(stamp - self._stamps[-1])
        self._stamps.append(float(stamp))
        self._poses.append(self._pose())
        return self._prediction()

    @one_blas_thread
    @all_or_nothing
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        self._require_started("update")
        require_guess("ekf", guess)
        slots = self._landmarks.slots(observations.ids)
        if not len(slots):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        joined = self._covariance.make_local(slots)
        if self._consistent:
            self._refer_landmarks(joined)
        problem = self._problem(observations, slots, guess)
        try:
            found = agreement(problem, self._surprises(), lambda: self._landmarks_pose(problem, slots), self.models)
            if found is None:
                reason = "no observation, or only a minority, agrees with the prediction"
                return UpdateReport.nothing(UpdateStatus.EMPTY, reason, observations.ids)
            if found.solution.uncertainty(problem.sigma) > _VAGUE:
                self._make_all_local()
            self._correct(slots, found)
        except UnsolvableError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"ekf: {error}")
        solution = found.solution
        used = solution.used
        dof = int(np.isfinite(problem.z[used]).sum())
        return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], solution.nis, dof)

    @one_blas_thread
    @all_or_nothing
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._require_started("add")
        self._landmarks.require_new(observations.ids)
        if not len(observations):
            return
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)  # paper A, Eq. (8)
        bad = ~(np.isfinite(h).all(axis=1) & (np.abs(observations.uv_left) < _PIXELS).all(axis=1))
        if bad.any():
            raise MeasurementError(
                f"ekf: landmark {observations.ids[bad][0]} has no right pixel, no positive depth or no pixel that a "
                "camera has"
            )
        h = h * np.minimum(1.0, self._farthest / h[:, 2:])
        self._place(observations.ids, h, self.rig.triangulation_covariance(h, self.models.pixel_sigma))

    @all_or_nothing
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
        blocks = D @ self._covariance.of_landmarks(slots)[0] @ D.transpose(0, 2, 1)
        return Estimate(
            self._stamps[-1], self._poses[-1].copy(), self._pose_covariance(),
            marks.ids[slots], marks.points[slots], 0.5 * (blocks + blocks.transpose(0, 2, 1)),
        )  # fmt: skip

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self._landmarks.points[self._landmarks.slots(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was believed at each stamp, never revised."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    @all_or_nothing
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        require_known("ekf", ids, positions, covariances)
        self._landmarks.require_new(ids)
        if len(ids):
            D = self._landmarks.append(ids, far_charts(positions, covariances), positions)
            self._append(np.zeros((len(ids), 3, POSE)), D @ covariances @ D.transpose(0, 2, 1))

    @one_blas_thread
    @all_or_nothing
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        self._require_started("place")
        require_known("ekf", ids, local, covariances)
        self._landmarks.require_new(ids)
        if len(ids):
            self._place(ids, local, covariances)

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    revises_path = False

    def revise(self, mend: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: landmarks in view move to where they are seen at from now on.

        The measurements are gone; what they made of the path stays. But landmarks that were placed by pixels as they
        were corrected before, and seen at pixels as they are now, would look as if the camera had moved.
        """
        marks, rectified_rig = self._landmarks, self.rig.rectified
        if not len(marks) or not self._poses:
            return
        T = self._poses[-1] @ rectified_rig.T_left_rectified
        z, _ = rectified_rig.rig.project_stereo(se3.transform(se3.inverse(T), marks.points), jacobian=False)
        rows = np.flatnonzero(rectified_rig.rig.left.in_image(z[:, :2]))
        z = mend(z[rows])
        if not np.isfinite(z).all():
            raise MeasurementError("ekf: a mended measurement is not finite")
        points = se3.transform(T, rectified_rig.rig.triangulate(z[:, :2], z[:, [2, 1]]))
        good = np.isfinite(points).all(axis=1)
        change = np.zeros_like(marks.state)
        rows, points = rows[good], points[good]
        change[rows] = marks.coordinates.of(marks.anchors[rows], points) - marks.state[rows]
        if np.isfinite(change).all():
            marks.move(change)

    # --- moving bodies (documented in slam.interfaces.ObjectBackend) ---

    @one_blas_thread
    @all_or_nothing
    def update_objects(self, observations: Sequence[ObjectObservations]) -> list[ObjectEstimate]:
        """See `slam.interfaces.ObjectBackend.update_objects`."""
        self._require_started("update_objects")
        T, columns = self._poses[-1], self._covariance.columns(np.zeros(0, np.intp))
        camera = CameraBelief(T, pose_jacobian(T[:3, :3], self._camera[3:6]), columns)
        return self._objects.update(observations, self._stamps[-1], camera)

    @all_or_nothing
    def remove_objects(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.ObjectBackend.remove_objects`."""
        self._objects.remove(ids)

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
        if self._attitude_deviation(dt) > _ANY_ATTITUDE:
            self._forget_motion(dt)
            return
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
        before = self._camera
        self._camera = before.copy()
        self._camera[:POSE] += dt * before[POSE:]
        if self._consistent and np.abs(self._camera[3:6] - before[3:6]).max() < _SMALL_TURN:
            self._turn_with(before)
        self._covariance.move_camera(dt, self._motion_noise(dt))
        self._objects.camera_moved(dt)

    def _attitude_deviation(self, dt: float) -> float:
        """Largest standard deviation [rad] of the angles after a step."""
        phi, omega = np.arange(3, 6), np.arange(9, 12)
        P = self._covariance.camera
        variance = P[phi, phi] + 2 * dt * P[phi, omega] + dt * dt * P[omega, omega]
        return math.sqrt(max(variance.max() + dt * dt * self.models.motion.velocity_variance(dt)[1], 0.0))

    def _forget_motion(self, dt: float) -> None:
        """A step after which the camera may be turned anyhow: it stays where it was, and starts anew.

        As uncertain as its speed at the start would make it meanwhile, and independent of the map. Larger numbers mean
        nothing, and next to what is known of the map they would not leave a double enough digits for that.
        """
        P, E = self._initial_covariance(), np.linalg.inv(body_rate_matrix(self._camera[3:6]))
        P[:3, :3] = self._covariance.pose[:3, :3] + (self.models.initial_velocity_sigma * dt) ** 2 * np.eye(3)
        P[:3, :3] *= min(1.0, _ANYWHERE**2 / P[:3, :3].diagonal().max())
        P[3:6, 3:6] = np.pi**2 / 3 * E @ E.T
        self._camera = np.concatenate([self._camera[:POSE], np.zeros(POSE)])
        self._covariance.transform_camera(np.zeros((CAMERA, CAMERA)))
        self._covariance.move_camera(0.0, P)
        self._objects.camera_transformed(np.zeros((CAMERA, CAMERA)))

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
        P = J @ self._covariance.pose @ J.T
        return np.asarray(0.5 * (P + P.T))

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
        if not (np.abs(z) < _PIXELS).all():
            z = np.clip(np.where(np.isfinite(z), z, np.nan), -_PIXELS, _PIXELS)
        if self.config.measurement == "left":
            z[:, 2] = np.nan
        marks = self._landmarks
        prior = np.concatenate([self._camera[:POSE], marks.state[slots].reshape(-1)])
        model = StereoMeasurement(self.rig, self._R_world_angles, marks.coordinates, marks.anchors[slots])
        return Problem(
            prior, self._covariance.marginal(slots), z, self.models.pixel_sigma, model,
            self.config.iterations, self.models.gate_probability,
            None if guess is None else self._change_to(guess), self._by_world(slots) if self._consistent else None,
        )  # fmt: skip

    def _by_world(self, slots: SlotArray) -> Array:
        """Derivatives (6 + 3M, 6) of [r, φ, landmarks] by a displacement of the world."""
        own = np.eye(6)
        own[:3, 3:] = -se3.hat(self._camera[:3])
        own[3:, 3:] = np.linalg.inv(self._turning(self._camera))
        return np.concatenate([own, self._landmarks.gauge_jacobian[slots].reshape(-1, 6)])

    def _change_to(self, T_world_left: Array) -> Array:
        """The change of [r, φ] (6,) that moves the pose to `T_world_left`."""
        phi, before = angles(self._R_world_angles.T @ T_world_left[:3, :3]), self._camera[3:6]
        rectified_rig = np.array([phi[0] + np.pi, np.pi - phi[1], phi[2] + np.pi])  # the same rotation
        changes = np.stack([phi, rectified_rig]) - before
        changes -= 2 * np.pi * np.round(changes / (2 * np.pi))
        nearest = changes[np.argmin(np.linalg.norm(changes, axis=1))]
        return np.concatenate([T_world_left[:3, 3] - self._camera[:3], nearest])

    def _surprises(self) -> list[Array]:
        """Motion noises (12, 12) beyond what the model expects of the last step."""
        if len(self._stamps) < 2:
            return []
        noise = self._motion_noise(self._stamps[-1] - self._stamps[-2])
        return [factor**2 * noise for factor in _SURPRISES]

    def _landmarks_pose(self, problem: Problem, slots: SlotArray) -> Array | None:
        """The change of [r, φ] (6,) to the pose on which most of the landmarks agree, if there is one."""
        T = self._pose() if problem.guess is None else self._changed(problem.guess)
        T_world_left = landmarks_pose(self.rig, self._landmarks.points[slots], problem, T, len(self._stamps))
        return None if T_world_left is None else self._change_to(T_world_left)

    def _changed(self, change: Array) -> Array:
        """The pose (4, 4) after a change of [r, φ] (6,)."""
        return se3.pose(attitude(self._R_world_angles, self._camera[3:6] + change[3:]), self._camera[:3] + change[:3])

    def _make_all_local(self) -> None:
        """Before an update that ends a great uncertainty: only the dense part keeps enough digits in it.

        What the rest becomes is a difference of numbers larger than itself by the condition of S.
        """
        joined = self._covariance.make_local(np.arange(len(self._landmarks)))
        if self._consistent:
            self._refer_landmarks(joined)

    def _correct(self, slots: SlotArray, found: Agreement) -> None:
        """Change the whole state and covariance, or nothing.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        covariance, solution = self._covariance, found.solution
        change = covariance.times(slots, solution.s)
        if found.noise is not None:
            change[:CAMERA] += found.noise[:, :POSE] @ solution.s[:POSE]
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if found.noise is not None:
            covariance.move_camera(0.0, found.noise)
        if self._objects.count:
            self._correct_objects(slots, solution)
        covariance.subtract(slots, solution.whitened)
        before = self._camera
        self._camera = self._camera + change[:CAMERA]
        self._landmarks.move(change[CAMERA:].reshape(-1, 3))
        if self._consistent:
            self._transport(before)
        self._reanchor_if_needed()
        self._poses[-1] = self._pose()

    def _correct_objects(self, slots: SlotArray, solution: Solution) -> None:
        """The bodies' part of a correction, before that of the filter's own state."""
        columns = self._covariance.columns(slots)
        W = solution.whitened(columns.T).T
        T = self._poses[-1]
        by_state = pose_jacobian(T[:3, :3], self._camera[3:6])
        camera = CameraBelief(T, by_state, columns[:, :POSE] - W @ W[:POSE].T)
        self._objects.camera_corrected(slots, solution, W, camera)

    # --- what nothing measures ---

    @property
    def _consistent(self) -> bool:
        """Whether the covariance is referred to the corrected state."""
        return self.config.consistent and self.config.measurement == "stereo"

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
            self._objects.landmarks_transformed(slots, K)

    def _turning(self, camera: Array) -> Array:
        """Derivative (3, 3) of the attitude, turned about the world's axes, by the angles φ."""
        return self._R_world_angles @ rotation(camera[3:6]) @ body_rate_matrix(camera[3:6])

    def _require_started(self, what: str) -> None:
        if not self._stamps:
            raise MeasurementError(f"ekf: {what} before the first predict")
