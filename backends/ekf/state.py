"""The filter's state, and what changes it: each step makes a new one of the old."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError

from backends.ekf.camera import Camera, Motion, displacement, pose_by_error, transport
from backends.ekf.covariance import HEAD, Covariance
from backends.ekf.innovation import Correction
from backends.ekf.landmarks import Coordinates, FilterLandmarks, Slide
from slam.data import IdArray, IndexArray
from slam.geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class FilterState:
    """A camera and three coordinates per landmark, with the joint covariance of their errors."""

    stamp: float  # time [s]; NaN before the first prediction
    frame: int  # number of the prediction, −1 before the first
    measured: bool  # whether the pose may not be updated any more
    camera: Camera
    landmarks: FilterLandmarks  # all of them
    covariance: Covariance  # of everything

    @classmethod
    def first(cls, camera: Camera, P: Array) -> FilterState:
        """Before the first prediction, with the covariance (12, 12) of the camera's error."""
        return cls(float("nan"), -1, True, camera, FilterLandmarks.none(), Covariance.of_camera(P))

    # --- the camera ---

    @property
    def pose(self) -> Array:
        """``T_world_left`` (4, 4)."""
        return self.camera.pose

    def pose_covariance(self) -> Array:
        """Covariance (6, 6) of the pose's right perturbation."""
        J = pose_by_error(self.camera)
        P = J @ self.covariance.pose @ J.T
        return np.asarray(0.5 * (P + P.T))

    def advanced(self, stamp: float, motion: Motion) -> FilterState:
        """At a later time, after a motion of the camera."""
        camera, J, noise = motion
        covariance = self.covariance.camera_moved(J, noise, pose_by_error(self.camera))
        return FilterState(stamp, self.frame + 1, False, camera, self.landmarks, covariance)

    def slid(self, slide: Slide, rows: IndexArray, r: Array) -> FilterState:
        """With landmarks of some rows (M,) of the state seen from r (3,), and their features slid there."""
        landmarks, walk = slide.walked(self.landmarks, rows, r)
        covariance = self.covariance.walked(rows, walk) if walk.any() else self.covariance
        return replace(self, landmarks=landmarks, covariance=covariance)

    # --- landmarks join and leave ---

    def placed(
        self, coordinates: Coordinates, ids: IdArray, h: Array, covariances: Array, by_rig: Array | None = None
    ) -> FilterState:
        """With landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10).

        An error of the pose takes them along: they stay where they are as seen from the camera, but for what errors of
        the rig do to that, by derivatives (M, 3, m).
        """
        if not len(ids):
            return self
        R, anchors = self.pose[:3, :3], np.repeat(self.pose[None, :3], len(h), axis=0)
        new = FilterLandmarks.at(coordinates, ids, anchors, self.pose[:3, 3] + h @ R.T)
        D = new.gauge[:, :, :3] @ R
        noise = D @ covariances @ D.transpose(0, 2, 1)
        by_rig = np.zeros((len(h), 3, self.covariance.by_rig.shape[1])) if by_rig is None else D @ by_rig
        covariance = self.covariance.appended(new.gauge @ displacement(self.camera), noise, by_rig)
        end = self.covariance.correlated
        landmarks = self.landmarks.select(slice(end)).joined(new).joined(self.landmarks.select(slice(end, None)))
        return replace(self, measured=True, landmarks=landmarks, covariance=covariance)

    def inserted(self, new: FilterLandmarks, covariances: Array) -> FilterState:
        """With landmarks known from elsewhere, by covariances (M, 3, 3) of their coordinates."""
        known = np.concatenate([self.covariance.known, covariances])
        covariance = replace(self.covariance, known=known)
        return replace(self, landmarks=self.landmarks.joined(new), covariance=covariance)

    def removed(self, ids: IdArray) -> FilterState:
        """Without some landmarks (M,)."""
        gone = self.landmarks.rows_of(ids)
        return self._rearranged(*(np.setdiff1d(part, gone) for part in self._parts())) if len(ids) else self

    def with_all_of(self, ids: IdArray) -> FilterState:
        """With some landmarks (M,), which may be known from elsewhere, in the state."""
        rows, (state, known) = self.landmarks.rows_of(ids), self._parts()
        joining = np.sort(rows[rows >= len(state)])
        if not len(joining):
            return self
        return self._rearranged(np.concatenate([state, joining]), np.setdiff1d(known, joining))

    def _parts(self) -> tuple[IndexArray, IndexArray]:
        """Rows of the landmarks that are in the state, and of those that are known from elsewhere."""
        rows, count = np.arange(len(self.landmarks)), self.covariance.correlated
        return rows[:count], rows[count:]

    def _rearranged(self, state: IndexArray, known: IndexArray) -> FilterState:
        """With the landmarks of these rows of the table in each part."""
        landmarks = self.landmarks.select(np.concatenate([state, known]))
        return replace(self, landmarks=landmarks, covariance=self.covariance.rearranged(state, known))

    # --- updates ---

    def corrected(self, found: Correction) -> FilterState:
        """After an update.

        A displacement of camera and landmarks together is unobservable. What it changes in each coordinate depends on
        the state, though, and an update moves the state: a filter that goes on with the same covariance believes to
        have measured such displacements, in time very well (Huang, Mourikis and Roumeliotis, 2010). So the error is
        taken apart: into the displacement of the world that the camera's pose is off by, written in the corrected
        state's coordinates, and what it leaves, which stays as it is. That is the error of an invariant filter (Barrau
        and Bonnabel, 2015). Raises LinAlgError where the new state is not finite, or a variance is lost in rounding.
        """
        update, camera = found.at.update, found.camera
        marks = self.landmarks.moved(update.coordinates, self._parts()[0], found.change[HEAD:].reshape(-1, 3))
        if not (np.isfinite(camera.pose).all() and np.isfinite(marks.points).all()):
            raise LinAlgError("the corrected state is not finite")
        J, shift = transport(update.camera, camera), self._shift(marks, camera)
        covariance = update.covariance.corrected(*found.gain(), J, shift)
        if not (covariance.P.diagonal()[HEAD:] > 0).all():
            raise LinAlgError("a landmark's variance would not stay positive")
        return replace(self, camera=camera, landmarks=marks, covariance=covariance)

    def displaced(self, coordinates: Coordinates, ids: IdArray, points: Array) -> FilterState:
        """With some landmarks at points (M, 3) [m]: their error stays, and the covariance is transported as above.

        What moves them is an error of the rig, the last that is considered, and none of the state's.
        """
        rows, before = self.landmarks.rows_of(ids), self.landmarks
        marks = before.moved(coordinates, rows, coordinates.of(before.anchors[rows], points) - before.c[rows])
        if not np.isfinite(marks.points).all():
            return self
        covariance = self.covariance.displaced(rows, (marks.c - before.c)[rows], self._shift(marks, self.camera))
        return replace(self, landmarks=marks, covariance=covariance)

    def _shift(self, marks: FilterLandmarks, camera: Camera) -> Array:
        """What is added to the errors (N, 3, 6) of landmarks that have moved, by the error of the pose."""
        change = (marks.gauge - self.landmarks.gauge)[self._parts()[0]]
        return np.asarray(change @ displacement(camera) if camera.transports else np.zeros_like(change))
