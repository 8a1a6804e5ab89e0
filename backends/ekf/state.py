"""The filter's state, and what changes it: each step makes a new one of the old."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from backends.ekf.angles import anchor, attitude, pose_jacobian
from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import Coordinates, Landmarks, gauge_jacobian
from backends.ekf.motion import Motion, initial_covariance, reanchored_if_needed, transport
from backends.ekf.recovery import Agreement
from backends.ekf.solve import UnsolvableError
from slam.data import IdArray, IndexArray, RecentPoses
from slam.geometry import se3
from slam.geometry.euler import angles, body_rate_matrix
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

RECENT = 4  #: cost: poses before the present one that are kept
_MOST, _LEAST = 300, 250  # cost: landmarks of the state above which some leave it, and that are left in it then


@dataclass(frozen=True, eq=False)
class State:
    """``[r, φ, v, ω]`` and three coordinates per landmark, with their joint covariance.

    The landmarks in it are those measured of late. Where there are too many, those not measured for longest leave it;
    they stay where they are, and come back with their covariances when they are measured (`backends.ekf.covariance`).

    Attributes:
        stamp: time [s]; NaN before the first prediction.
        frame: number of the prediction, −1 before the first.
        dt: time since the last one [s], 0 for the first.
        measured: whether the pose may not be updated any more.
        camera: mean of [r, φ, v, ω] (12,): position [m], angles [rad] and their rates.
        R_world_angles: the angles' world (3, 3), see `backends.ekf.angles`.
        landmarks: all of them.
        covariance: of everything.
        recent: stamps [s] and poses (4, 4) of the last frames before this one, the newest first.
    """

    stamp: float
    frame: int
    dt: float
    measured: bool
    camera: Array
    R_world_angles: Array
    landmarks: Landmarks
    covariance: Covariance
    recent: tuple[tuple[float, Array], ...] = ()

    @classmethod
    def first(cls, models: EstimatorModels) -> State:
        """Before the first prediction."""
        R_world_angles, phi = anchor(models.initial_pose[:3, :3])
        camera = np.concatenate([models.initial_pose[:3, 3], phi, np.zeros(6)])
        covariance = Covariance.of_camera(initial_covariance(models, phi))
        return cls(float("nan"), -1, 0.0, True, camera, R_world_angles, Landmarks.none(), covariance)

    # --- the camera ---

    @cached_property
    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""
        return se3.pose(attitude(self.R_world_angles, self.camera[3:6]), self.camera[:3])

    def pose_jacobian(self) -> Array:
        """Derivative (6, 6) of the pose's right perturbation by [r, φ]."""
        return pose_jacobian(self.pose[:3, :3], self.camera[3:6])

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

    def advanced(self, stamp: float, motion: Motion) -> State:
        """At a later time, after a motion of the camera."""
        covariance = self.covariance.with_pose(self.pose_jacobian(), RECENT).camera_moved(motion.J, motion.noise)
        return replace(
            self, stamp=stamp, frame=self.frame + 1, dt=stamp - self.stamp, measured=False, camera=motion.camera,
            R_world_angles=motion.R_world_angles, covariance=covariance,
            recent=((self.stamp, self.pose), *self.recent)[:RECENT],
        )  # fmt: skip

    def recent_poses(self, n: int) -> RecentPoses:
        """The last poses, as they were believed in their time, with their joint covariance; at most n."""
        covariance = self.covariance.with_pose(self.pose_jacobian(), RECENT + 1)
        path = [(self.stamp, self.pose), *self.recent][:n][::-1]
        P = covariance.left[: POSE * len(path), : POSE * len(path)].reshape(len(path), POSE, len(path), POSE)
        joint = P[::-1, :, ::-1].reshape(POSE * len(path), POSE * len(path))
        stamps, poses = np.array([stamp for stamp, _ in path]), np.array([T for _, T in path])
        return RecentPoses(stamps, poses, 0.5 * (joint + joint.T))

    # --- landmarks join and leave ---

    def placed(self, coordinates: Coordinates, ids: IdArray, h: Array, covariances: Array) -> State:
        """With landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10)."""
        if not len(ids):
            return self
        T, E = self.pose, body_rate_matrix(self.camera[3:6])
        R, J = T[:3, :3], np.repeat(np.eye(3, POSE)[None], len(h), axis=0)
        J[:, :, 3:] = -R @ se3.hat(h) @ E  # turning by δθ = E δφ about the camera's axes moves h by δθ × h
        anchors = np.repeat(T[None, :3], len(h), axis=0)
        new = Landmarks.at(coordinates, ids, anchors, self.camera[:3] + h @ R.T, self.frame)
        D = coordinates.inverse_jacobian(anchors, new.c)
        covariance = self.covariance.appended(D @ J, D @ (R @ covariances @ R.T) @ D.transpose(0, 2, 1))
        landmarks = self.landmarks.with_rows(self.covariance.count, new)
        placed = replace(self, measured=True, landmarks=landmarks, covariance=covariance)
        return placed._relieved(np.zeros(0, np.intp), np.flatnonzero(landmarks.seen == self.frame))

    def inserted(self, new: Landmarks, covariances: Array) -> State:
        """With landmarks known from elsewhere, by covariances (M, 3, 3) of their coordinates."""
        known = np.concatenate([self.covariance.known, covariances])
        landmarks = self.landmarks.with_rows(len(self.landmarks), new)
        return replace(self, landmarks=landmarks, covariance=replace(self.covariance, known=known))

    def removed(self, ids: IdArray) -> State:
        """Without some landmarks (M,)."""
        gone = self.landmarks.rows_of(ids)
        if not len(gone):
            return self
        stay = np.ones(len(self.landmarks), bool)
        stay[gone] = False
        rows, a, b = np.arange(len(stay)), self.covariance.count, self.covariance.correlated
        parts = [part[stay[part]] for part in (rows[:a], rows[a:b], rows[b:])]
        return self._rearranged(*parts)

    def with_all_of(self, ids: IdArray) -> State:
        """With some landmarks (M,), which may have left it or be known from elsewhere, in the dense part."""
        rows = self.landmarks.rows_of(ids)
        back = np.sort(rows[rows >= self.covariance.count])
        return self._relieved(back, rows) if len(back) else self

    def _relieved(self, back: IndexArray, kept: IndexArray) -> State:
        """With rows `back` in the dense part; where it is too large, those not measured for longest leave it.

        Those of the rows `kept` stay in any case.
        """
        a, b, n = self.covariance.count, self.covariance.correlated, len(self.landmarks)
        others = np.setdiff1d(np.arange(a), kept)
        too_many = max(a + len(back) - _LEAST, 0) if a + len(back) > _MOST else 0
        leave = np.sort(others[np.argsort(self.landmarks.seen[others], kind="stable")][:too_many])
        if not len(back) and not len(leave):
            return self
        left = np.concatenate([np.setdiff1d(np.arange(a, b), back), leave])
        dense = np.concatenate([np.setdiff1d(np.arange(a), leave), back])
        return self._rearranged(dense, left, np.setdiff1d(np.arange(b, n), back))

    def _rearranged(self, dense: IndexArray, left: IndexArray, known: IndexArray) -> State:
        """With the landmarks of these rows of the table in each part."""
        landmarks = self.landmarks.take(np.concatenate([dense, left, known]))
        return replace(self, landmarks=landmarks, covariance=self.covariance.rearranged(dense, left, known))

    # --- updates ---

    def corrected(self, coordinates: Coordinates, found: Agreement, rows: IndexArray, consistent: bool) -> State:
        """After an update by the landmarks of some rows (M,) of the table.

        A displacement of camera and landmarks together is unobservable. What it changes in each coordinate depends on
        the state, though (how far the world's origin is, which way is depth), and an update moves the state. A filter
        that goes on with the same covariance believes to have measured such displacements, in time very well (Huang,
        Mourikis and Roumeliotis, 2010). If it is `consistent`, the covariance is therefore transported to the corrected
        state: the error is taken to be the displacement that the camera's [r, φ] has, by its Jacobian in old
        coordinates and in new, and what it leaves, which stays as it is: the error of an invariant filter (Barrau and
        Bonnabel, 2015). Landmarks that have left do not move, so that their coordinates need none.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        solution, P = found.solution, self.covariance
        if found.noise is not None:
            P = P.camera_moved(np.eye(CAMERA), found.noise)
        dense, camera = np.arange(P.count), self.camera + solution.change[:CAMERA]
        marks = self.landmarks.moved(coordinates, dense, solution.change[CAMERA:].reshape(-1, 3))
        if not (np.isfinite(camera).all() and np.isfinite(marks.points).all()):
            raise UnsolvableError("the corrected state is not finite")
        J: Array = np.eye(CAMERA)
        K: Array = np.zeros((P.count, 3, POSE))
        if consistent:
            J, world = transport(self.R_world_angles, self.camera, camera)
            gauge = gauge_jacobian(coordinates, marks.anchors[dense], marks.c[dense], marks.points[dense])
            K = (gauge - marks.gauge[dense]) @ world
            marks = replace(marks, gauge=np.concatenate([gauge, marks.gauge[P.count :]]))
        system = solution.system
        V_left = system.whitened(system.H.times(P.cross)) if P.cross.size else np.zeros((0, len(system.HP)))
        P = P.corrected(system.whitened(system.HP), V_left, J, K)
        motion = reanchored_if_needed(Motion(camera, self.R_world_angles))
        if motion.R_world_angles is not self.R_world_angles:
            P = P.camera_moved(motion.J, motion.noise)
        seen = marks.seen.copy()
        seen[rows[solution.used]] = self.frame
        return replace(
            self, camera=motion.camera, R_world_angles=motion.R_world_angles, landmarks=replace(marks, seen=seen),
            covariance=P,
        )  # fmt: skip
