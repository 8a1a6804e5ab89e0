"""The filter's state: mean and covariance of camera and landmarks, how time moves it and how an update changes it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from backends.ekf.angles import LIMIT, anchor, attitude, pose_jacobian, reanchor
from backends.ekf.config import EkfConfig
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import COORDINATES, Landmarks
from backends.ekf.motion import attitude_deviation, covariance_after_gap, initial_covariance, motion_noise
from backends.ekf.recovery import Agreement
from backends.ekf.solve import UnsolvableError
from slam.data import IdArray, IndexArray
from slam.geometry import se3
from slam.geometry.euler import angles, body_rate_matrix, rotation
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

_ANY_ATTITUDE = 2 * np.pi  # standard deviation of angles that say nothing of an attitude [rad]
_PIECES = 64  # numerics: at most, of one step through the angles' singularity
_SMALL_TURN = 0.2  # numerics: of a step whose error may be carried as a turn about the world's axes [rad]


class FilterState:
    """``[r, φ, v, ω]`` and three coordinates per landmark, with their joint covariance.

    The covariance refers to a state that an update moves: see `_transport` for what that takes.

    Args:
        models: priors and motion.
        config: options of the filter.

    Attributes:
        camera: mean of [r, φ, v, ω] (12,): position [m], angles [rad] and their rates.
        R_world_angles: the angles' world (3, 3), see `backends.ekf.angles`.
        landmarks: their coordinates and names.
        covariance: of everything.
        consistent: whether the covariance is transported to the corrected state.
    """

    def __init__(self, models: EstimatorModels, config: EkfConfig) -> None:
        self.models = models
        self.landmarks = Landmarks(COORDINATES[config.landmarks])
        self.R_world_angles, phi = anchor(models.initial_pose[:3, :3])
        self.camera = np.concatenate([models.initial_pose[:3, 3], phi, np.zeros(6)])
        self.covariance = Covariance(initial_covariance(models, phi))
        self.consistent = config.consistent and config.measurement == "stereo"

    def saved(self) -> Callable[[], None]:
        """A function that puts everything back as it is now."""
        parts = (self.covariance.saved(), self.landmarks.saved())
        before = (self.camera, self.R_world_angles)

        def restore() -> None:
            for part in parts:
                part()
            self.camera, self.R_world_angles = before

        return restore

    # --- the camera ---

    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""
        return se3.pose(attitude(self.R_world_angles, self.camera[3:6]), self.camera[:3])

    def pose_jacobian(self) -> Array:
        """Derivative (6, 6) of the pose's right perturbation by [r, φ]."""
        return pose_jacobian(self.pose()[:3, :3], self.camera[3:6])

    def pose_covariance(self) -> Array:
        """Covariance (6, 6) of the pose's right perturbation."""
        J = self.pose_jacobian()
        P = J @ self.covariance.pose @ J.T
        return np.asarray(0.5 * (P + P.T))

    def change_to(self, T_world_left: Array) -> Array:
        """The change of [r, φ] (6,) that moves the pose to `T_world_left`."""
        phi, before = angles(self.R_world_angles.T @ T_world_left[:3, :3]), self.camera[3:6]
        other = np.array([phi[0] + np.pi, np.pi - phi[1], phi[2] + np.pi])  # the same rotation
        changes = np.stack([phi, other]) - before
        changes -= 2 * np.pi * np.round(changes / (2 * np.pi))
        nearest = changes[np.argmin(np.linalg.norm(changes, axis=1))]
        return np.concatenate([T_world_left[:3, 3] - self.camera[:3], nearest])

    def pose_after(self, change: Array) -> Array:
        """The pose (4, 4) after a change of [r, φ] (6,)."""
        return se3.pose(attitude(self.R_world_angles, self.camera[3:6] + change[3:]), self.camera[:3] + change[:3])

    # --- time ---

    def advance(self, dt: float) -> None:
        """The printed transition (paper B, section 2), in pieces where it would run into the angles' singularity."""
        if attitude_deviation(self.models, self.covariance.camera, dt) > _ANY_ATTITUDE:
            self._forget_motion(dt)
            return
        turn = float(self.camera[10]) * dt
        if abs(float(self.camera[4]) + turn) > LIMIT:
            self._reanchor()
            turn = float(self.camera[10]) * dt
        pieces = max(1, math.ceil(min(abs(turn) / LIMIT, _PIECES)))
        for _ in range(pieces):
            self._transition(dt / pieces)
            self._reanchor_if_needed()

    def rest(self) -> None:
        """A step of a camera that stands: the pose stays, and the velocity is zero for certain."""
        self.camera = np.concatenate([self.camera[:POSE], np.zeros(POSE)])
        self._transform_camera(np.diag(np.repeat([1.0, 0.0], POSE)))

    def _transition(self, dt: float) -> None:
        """``x ← f(x)`` and ``P ← A P Aᵀ + W Q Wᵀ`` with the printed A and W."""
        before = self.camera
        self.camera = before.copy()
        self.camera[:POSE] += dt * before[POSE:]
        if self.consistent and np.abs(self.camera[3:6] - before[3:6]).max() < _SMALL_TURN:
            self._turn_with(before)
        self.covariance.move_camera(dt, motion_noise(self.models, dt))

    def _forget_motion(self, dt: float) -> None:
        """A step after which the camera may be turned anyhow: it stays where it was, independent of the map."""
        P = covariance_after_gap(self.models, self.camera[3:6], self.covariance.pose[:3, :3], dt)
        self.camera = np.concatenate([self.camera[:POSE], np.zeros(POSE)])
        self._transform_camera(np.zeros((CAMERA, CAMERA)))
        self.covariance.move_camera(0.0, P)

    def _reanchor_if_needed(self) -> None:
        """Choose a new angles' world where φy comes near its singularity."""
        if abs(math.sin(self.camera[4])) > math.sin(LIMIT) or math.cos(self.camera[4]) < 0:
            self._reanchor()

    def _reanchor(self) -> None:
        self.R_world_angles, self.camera, J = reanchor(self.R_world_angles, self.camera)
        self._transform_camera(J)

    def _transform_camera(self, J: Array) -> None:
        """The camera's error (12,) becomes J times what it was."""
        self.covariance.transform_camera(J)

    # --- landmarks join and leave ---

    def place(self, ids: IdArray, h: Array, covariances: Array) -> None:
        """Add landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10)."""
        R, E = attitude(self.R_world_angles, self.camera[3:6]), body_rate_matrix(self.camera[3:6])
        J = np.repeat(np.eye(3, POSE)[None], len(h), axis=0)
        J[:, :, 3:] = -R @ se3.hat(h) @ E  # turning by δθ = E δφ about the camera's axes moves h by δθ × h
        anchors = np.repeat(self.pose()[None, :3], len(h), axis=0)
        self.append(ids, anchors, self.camera[:3] + h @ R.T, J, R @ covariances @ R.T)

    def append(self, ids: IdArray, anchors: Array, points: Array, J: Array, covariances: Array) -> None:
        """Add landmarks at points (M, 3) in the world.

        Args:
            ids: the landmarks (M,).
            anchors: theirs (M, 3, 4), see `backends.ekf.landmarks`.
            points: positions (M, 3) [m].
            J: derivatives (M, 3, 6) of the positions by [r, φ].
            covariances: (M, 3, 3) of what is independent of the camera.
        """
        D = self.landmarks.append(ids, anchors, points)
        self.covariance.append(D @ J, D @ covariances @ D.transpose(0, 2, 1))

    def remove(self, ids: IdArray) -> None:
        """Remove landmarks (M,), which are all in the state."""
        holes, movers = self.covariance.drop(self.landmarks.slots(ids))
        self.landmarks.remove(ids, holes, movers)

    # --- updates ---

    def make_local(self, slots: IndexArray) -> None:
        """Prepare an update by some landmarks: see `Covariance.make_local`."""
        joined = self.covariance.make_local(slots)
        if self.consistent:
            self._transport_landmarks(joined)

    def correct(self, slots: IndexArray, found: Agreement) -> None:
        """Change the whole state and covariance by an update with landmarks `slots`, or nothing.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        covariance, solution = self.covariance, found.solution
        change = covariance.times(slots, solution.s)
        if found.noise is not None:
            change[:CAMERA] += found.noise[:, :POSE] @ solution.s[:POSE]
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if found.noise is not None:
            covariance.move_camera(0.0, found.noise)
        covariance.subtract(slots, solution.whitened)
        before = self.camera
        self.camera = self.camera + change[:CAMERA]
        self.landmarks.move(change[CAMERA:].reshape(-1, 3))
        if self.consistent:
            self._transport(before)
        self._reanchor_if_needed()

    # --- displacements of the whole world, which are unobservable ---

    def gauge_jacobian(self, slots: IndexArray) -> Array:
        """Jacobian (6 + 3M, 6) of [r, φ, landmarks] by a displacement of the world, which is unobservable."""
        own = np.eye(6)
        own[:3, 3:] = -se3.hat(self.camera[:3])
        own[3:, 3:] = np.linalg.inv(self.turning(self.camera))
        return np.concatenate([own, self.landmarks.gauge_jacobian[slots].reshape(-1, 6)])

    def turning(self, camera: Array) -> Array:
        """Derivative (3, 3) of the attitude, turned about the world's axes, by the angles φ of a camera (12,)."""
        return self.R_world_angles @ rotation(camera[3:6]) @ body_rate_matrix(camera[3:6])

    def _transport(self, before: Array) -> None:
        """Transport the covariance to the corrected state; `before` is the camera's (12,) for which it holds.

        A displacement of camera and landmarks together is unobservable. What it changes in each coordinate depends on
        the state, though (how far the world's origin is, which way is depth), and an update moves the state. A filter
        that goes on with the same covariance believes to have measured such displacements, in time very well (Huang,
        Mourikis and Roumeliotis, 2010). So the error is taken to be the displacement, in old coordinates and in new,
        and what it leaves, which stays as it is: the error of an invariant filter (Barrau and Bonnabel, 2015).
        """
        A, A_before = self.turning(self.camera), self.turning(before)
        change, J = self.camera - before, np.eye(CAMERA)
        J[:3, 3:6] = -se3.hat(change[:3]) @ A_before
        J[3:6, 3:6] = np.linalg.solve(A, A_before)
        J[6:9, 3:6] = -se3.hat(change[6:9]) @ A_before
        self._transform_camera(J)
        self._transport_landmarks(self.covariance.local)

    def _turn_with(self, before: Array) -> None:
        """Carry the attitude's error through a step as a turn about the world's axes, not as one of the angles φ.

        The printed transition has constant rates of the angles, which is not the same in another world. The difference
        is of second order; in long steps, where it would not be, the transition is left as printed.
        """
        J = np.eye(CAMERA)
        J[3:6, 3:6] = np.linalg.solve(self.turning(self.camera), self.turning(before))
        self._transform_camera(J)

    def _transport_landmarks(self, slots: IndexArray) -> None:
        """The same for landmarks, those that became local last, by the displacement that the camera's [r, φ] has."""
        if not len(slots):
            return
        world, A = np.eye(6), self.turning(self.camera)
        world[:3, 3:], world[3:, 3:] = se3.hat(self.camera[:3]) @ A, A
        K = self.landmarks.transport(slots) @ world
        if K.any():
            self.covariance.transform_landmarks(K)
