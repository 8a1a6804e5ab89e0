"""The filter's state, and what changes it: each step makes a new one of the old."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backends.ekf.covariance import CAMERA, POSE, Covariance
from backends.ekf.landmarks import Coordinates, Landmarks
from backends.ekf.motion import Camera, Motion
from backends.ekf.solve import Solution, UnsolvableError, View
from slam.data import IdArray, IndexArray, RecentPoses
from slam.geometry import se3
from slam.geometry.se3 import Array

RECENT = 4  #: cost: poses before the present one that are kept
_MOST, _LEAST = 300, 250  # cost: landmarks of the state above which some leave it, and that are left in it then


@dataclass(frozen=True, eq=False)
class State:
    """A camera and three coordinates per landmark, with the joint covariance of their errors.

    The landmarks in it are those measured of late. Where there are too many, those not measured for longest leave it;
    they stay where they are, and come back with their covariances when they are measured (`backends.ekf.covariance`).

    Attributes:
        stamp: time [s]; NaN before the first prediction.
        frame: number of the prediction, −1 before the first.
        dt: time since the last one [s], 0 for the first.
        measured: whether the pose may not be updated any more.
        camera: pose and velocities; it says what its error means.
        landmarks: all of them.
        covariance: of everything.
        recent: stamps [s] and poses (4, 4) of the last frames before this one, the newest first.
    """

    stamp: float
    frame: int
    dt: float
    measured: bool
    camera: Camera
    landmarks: Landmarks
    covariance: Covariance
    recent: tuple[tuple[float, Array], ...] = ()

    @classmethod
    def first(cls, camera: Camera, P: Array) -> State:
        """Before the first prediction, with the covariance (12, 12) of the camera's error."""
        return cls(float("nan"), -1, 0.0, True, camera, Landmarks.none(), Covariance.of_camera(P))

    # --- the camera ---

    @property
    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""
        return self.camera.pose

    def pose_covariance(self) -> Array:
        """Covariance (6, 6) of the pose's right perturbation."""
        J = self.camera.by_error()
        P = J @ self.covariance.pose @ J.T
        return np.asarray(0.5 * (P + P.T))

    def advanced(self, stamp: float, motion: Motion) -> State:
        """At a later time, after a motion of the camera."""
        kept = replace(self, covariance=self.covariance.with_pose(self.camera.by_error(), RECENT))
        return replace(
            kept._carried(motion), stamp=stamp, frame=self.frame + 1, dt=stamp - self.stamp, measured=False,
            recent=((self.stamp, self.pose), *self.recent)[:RECENT],
        )  # fmt: skip

    def _carried(self, motion: Motion) -> State:
        """With another camera, whose error is that of this one and noise; the landmarks stay where they are."""
        K = self.levers(np.arange(self.covariance.count)) if self.camera.invariant else None
        return replace(self, camera=motion.camera, covariance=self.covariance.camera_moved(motion.J, motion.noise, K))

    def recent_poses(self, n: int) -> RecentPoses:
        """The last poses, as they were believed in their time, with their joint covariance; at most n."""
        covariance = self.covariance.with_pose(self.camera.by_error(), RECENT + 1)
        path = [(self.stamp, self.pose), *self.recent][:n][::-1]
        P = covariance.left[: POSE * len(path), : POSE * len(path)].reshape(len(path), POSE, len(path), POSE)
        joint = P[::-1, :, ::-1].reshape(POSE * len(path), POSE * len(path))
        stamps, poses = np.array([stamp for stamp, _ in path]), np.array([T for _, T in path])
        return RecentPoses(stamps, poses, 0.5 * (joint + joint.T))

    # --- landmarks join and leave ---

    def levers(self, rows: IndexArray) -> Array:
        """What the pose's error adds to landmarks (M, 3, 6) beside their own errors, by rows of the table.

        Nothing where errors are not invariant, nor outside of the dense part, where they are in the world as it is.
        """
        K: Array = self.landmarks.gauge[rows] @ self.camera.world()
        K[np.full(len(rows), not self.camera.invariant) | (rows >= self.covariance.count)] = 0.0
        return K

    def relative(self, rows: IndexArray) -> Array:
        """An error x of the pose moves landmarks (M, 3, 6), as seen from the camera, by minus this times x."""
        return np.asarray(self.landmarks.gauge[rows] @ self.camera.world() - self.levers(rows))

    def landmark_covariances(self, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmarks' coordinates."""
        blocks, cross = (part[rows] for part in self.covariance.marginals())
        if self.camera.invariant:
            K = self.levers(rows)
            shared = (cross + 0.5 * K @ self.covariance.pose) @ K.transpose(0, 2, 1)
            blocks = blocks + shared + shared.transpose(0, 2, 1)
        return np.asarray(blocks)

    def placed(self, coordinates: Coordinates, ids: IdArray, h: Array, covariances: Array) -> State:
        """With landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10).

        An error of the pose takes them along: they stay where they are as seen from the camera.
        """
        if not len(ids):
            return self
        R, count = self.pose[:3, :3], self.covariance.count
        anchors = np.repeat(self.pose[None, :3], len(h), axis=0)
        new = Landmarks.at(coordinates, ids, anchors, self.pose[:3, 3] + h @ R.T, self.frame)
        D = coordinates.inverse_jacobian(anchors, new.c)
        J = np.zeros_like(new.gauge) if self.camera.invariant else new.gauge @ self.camera.world()
        covariance = self.covariance.appended(J, D @ (R @ covariances @ R.T) @ D.transpose(0, 2, 1))
        landmarks = self.landmarks.with_rows(count, new)
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
        P, a, turns = self.covariance, self.covariance.count, self.camera.invariant
        leave = left[left < a]
        if turns and len(leave):  # their errors are in the world from now on
            K = np.zeros((a, 3, POSE))
            K[leave] = self.levers(leave)
            P = P.sheared(K)
        landmarks = self.landmarks.take(np.concatenate([dense, left, known]))
        after = replace(self, landmarks=landmarks, covariance=P.rearranged(dense, left, known))
        if turns and (dense >= a).any():  # and of those that come back no longer
            K = np.where((dense >= a)[:, None, None], -after.levers(np.arange(len(dense))), 0.0)
            after = replace(after, covariance=after.covariance.sheared(K))
        return after

    # --- updates ---

    def view(self, rows: IndexArray, T: Array | None, noise: Array | None) -> View:
        """The state as seen from a pose (4, 4), for an update by landmarks of some rows (M,); see `Problem.view`."""
        s, camera, S, mean = self, self.camera, self.camera.plain(), np.zeros(len(self.covariance.dense))
        if noise is not None:
            s = s._carried(Motion(camera, noise=S @ noise @ S.T))
        if T is not None:
            camera = camera.at(T)
            s = s._carried(Motion(camera, self.camera.transport(camera)))
            mean[:CAMERA] = self.camera.seen_from(camera)
            mean[CAMERA:] = -(s.levers(np.arange(s.covariance.count)) @ mean[:POSE]).reshape(-1)
        numbers, K = CAMERA + 3 * rows[:, None] + np.arange(3), s.levers(rows)

        def go(error: Array) -> tuple[Array, Array]:
            return camera.moved(error[:CAMERA]).pose, error[numbers] + K @ error[:POSE]

        return View(s, camera.pose, s.covariance.dense, mean, s.relative(rows), go)

    @staticmethod
    def corrected(coordinates: Coordinates, solution: Solution, rows: IndexArray) -> State:
        """After an update by the landmarks of some rows (M,) of the table, of the state as the solution sees it.

        A displacement of camera and landmarks together is unobservable. What it changes in each coordinate depends on
        the state, though (how far the world's origin is, which way is depth), and an update moves the state. A filter
        that goes on with the same covariance believes to have measured such displacements, in time very well (Huang,
        Mourikis and Roumeliotis, 2010). If the camera `transports` it, the covariance is therefore transported to the
        corrected state: the error is taken to be the displacement that the camera's pose has, by its Jacobian in old
        coordinates and in new, and what it leaves, which stays as it is: the error of an invariant filter (Barrau and
        Bonnabel, 2015). Landmarks that have left do not move, so that their coordinates need none.

        An invariant error is corrected as a displacement of the world, exact however large it is, and what is left of
        the landmarks' changes in the world: to first order that is the correction, and of second order there is nothing
        where the camera moves among landmarks that stay.

        Raises:
            UnsolvableError: the new state is not finite.
        """
        s: State = solution.view.state
        P, before, dense = s.covariance, s.camera, np.arange(s.covariance.count)
        error, J, K = solution.change, None, None
        camera = before.moved(error[:CAMERA])
        change, displacement = error[CAMERA:].reshape(-1, 3), np.zeros(CAMERA)
        if camera.invariant and len(dense):
            levers = s.levers(dense)
            change = change + levers @ error[:POSE]  # in the world as it was
            displacement[:POSE] = np.linalg.lstsq(levers.reshape(-1, POSE), change.reshape(-1), rcond=None)[0]
            change = change - levers @ displacement[:POSE]
        marks = s.landmarks.moved(coordinates, dense, change)
        if displacement.any():
            marks = marks.displaced(coordinates, dense, before.moved(displacement).pose @ se3.inverse(before.pose))
        if not (np.isfinite(camera.pose).all() and np.isfinite(marks.points).all()):
            raise UnsolvableError("the corrected state is not finite")
        if camera.transports:
            J, K = before.transport(camera), (marks.gauge - s.landmarks.gauge)[dense] @ camera.world()
        system = solution.system
        V_left = system.whitened(system.H.times(P.cross)) if P.cross.size else np.zeros((0, len(system.HP)))
        P = P.corrected(system.whitened(system.HP), V_left, J, K)
        seen = marks.seen.copy()
        seen[rows[solution.used]] = s.frame
        after = replace(s, camera=camera, landmarks=replace(marks, seen=seen), covariance=P)
        settled = camera.settled()
        return after if settled.camera is camera else after._carried(settled)
