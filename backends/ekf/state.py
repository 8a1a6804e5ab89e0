"""The filter's state, and what changes it: each step makes a new one of the old."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError

from backends.ekf.camera import Camera, Motion, displacement, pose_by_error, transport
from backends.ekf.covariance import HEAD, LEAVING, POSE, Covariance
from backends.ekf.innovation import Correction
from backends.ekf.landmarks import Coordinates, FilterLandmarks, Slide
from slam.data import IdArray, IndexArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array

#: Landmarks leave the last such pose again as long as they are, in variance, not more uncertain by this as seen from it
#: than from the camera. With 2 or 4 a hovering camera claims 1.1 to 1.5 times the deviation that it would if all had
#: stayed, with 0, which is a new pose at each leaving, 2.4 to 3.6 times.
_AS_WELL = 2.0
_AT_ONCE = 8  # cost: one of so many landmarks leaves at once, so that the matrix is not copied in every frame


@dataclass(frozen=True, eq=False)
class FilterState:
    """A camera and three coordinates per landmark, with the joint covariance of their errors.

    Landmarks that were measured long ago leave the matrix. They stay in the map, where they were, with their covariance
    in the world. As seen from the camera, they are as uncertain as seen from a pose that they left, plus what the way
    from there adds, as a displacement of the world. That pose stays in the state, so the covariance of the way is
    known; landmarks leave the same one as long as they are known nearly as well from there. The ways from one
    such pose to the next are added as if they were independent. So are they predicted, and so do those that are
    measured again join, as new ones would: independent of the pose as seen from the camera. They tell it nothing of
    the past, and nothing is counted twice.
    """

    stamp: float  # time [s]; NaN before the first prediction
    frame: int  # number of the prediction, −1 before the first
    measured: bool  # whether the pose may not be updated any more
    camera: Camera
    landmarks: FilterLandmarks  # all of them
    covariance: Covariance  # of the camera and those in the state

    @classmethod
    def first(cls, camera: Camera, P: Array, by_rig: Array | None = None) -> FilterState:
        """Before the first prediction, with what `Covariance.of_camera` says of the camera's error."""
        covariance = Covariance.of_camera(P, by_rig)
        return cls(float("nan"), -1, True, camera, FilterLandmarks.none(covariance.by_rig.shape[1]), covariance)

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
        covariance = self.covariance.advanced(J, noise, pose_by_error(self.camera))
        return FilterState(stamp, self.frame + 1, False, camera, self.landmarks, covariance)

    def marginals(self, rows: IndexArray) -> tuple[Array, Array, Array]:
        """Covariances (M, 3, 3) of landmarks, by rows of the table, and (M, 3, 6) with the camera's [r, φ].

        The last are derivatives (M, 3, m) of their coordinates by errors of the rig.
        """
        marks, covariance, active = self.landmarks, self.covariance, rows < self.covariance.active
        own, cross, by_rig = marks.covariance[rows], np.zeros((len(rows), 3, POSE)), marks.by_rig[rows]
        at = covariance.indices(rows[active])
        own[active], by_rig[active] = covariance.P[at[:, :, None], at[:, None, :]], covariance.by_rig[at]
        cross[active] = covariance.P[at, :POSE]
        return own, cross, by_rig

    def from_camera(self, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmarks' errors, in their coordinates, as seen from the camera."""
        (own, cross, _), G, marks = self.marginals(rows), self.landmarks.gauge[rows], self.landmarks
        seen = _as_seen(own, cross, self.covariance.pose, G @ displacement(self.camera))
        left = (rows >= self.covariance.active) & ~marks.known[rows]
        if left.any():
            gone, G = rows[left], G[left]
            seen[left] = marks.relative[gone] + G @ (marks.drift[gone] + self._drift()) @ G.transpose(0, 2, 1)
        return seen

    def slid(self, slide: Slide, rows: IndexArray, r: Array) -> FilterState:
        """With landmarks of some rows (M,) of the state seen from r (3,), and their features slid there."""
        landmarks, walk = slide.walked(self.landmarks, rows, r)
        covariance = self.covariance.walked(rows, walk) if walk.any() else self.covariance
        return changed(self, landmarks=landmarks, covariance=covariance)

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
        points, m = self.pose[:3, 3] + h @ R.T, self.covariance.by_rig.shape[1]
        new = FilterLandmarks.at(coordinates, ids, anchors, points, self.frame, m)
        D, J = new.gauge[:, :, :3] @ R, new.gauge @ displacement(self.camera)
        moved = J @ self.covariance.by_rig[:POSE] + (0.0 if by_rig is None else D @ by_rig)
        covariance = self.covariance.appended(J, D @ covariances @ D.transpose(0, 2, 1), moved)
        return changed(self, measured=True)._with(new, covariance)

    def removed(self, ids: IdArray) -> FilterState:
        """Without some landmarks (M,)."""
        return self._without(self.landmarks.rows_of(ids)) if len(ids) else self

    def with_all_of(self, ids: IdArray) -> FilterState:
        """With some landmarks (M,), which may be inactive, in the state.

        Those that have left share the uncertainty of the camera's way since the later of two left. Those of a prior map
        are independent of the pose in the world.
        """
        rows = self.landmarks.rows_of(ids)
        rows = np.sort(rows[rows >= self.covariance.active])  # in the order in which they left
        if not len(rows):
            return self
        new = self.landmarks.select(rows)
        G = np.where(new.known[:, None, None], 0.0, new.gauge)
        shared = (G @ (new.drift + self._drift())).reshape(-1, POSE) @ G.reshape(-1, POSE).T
        shared, J = np.tril(shared) + np.tril(shared, -1).T, G @ displacement(self.camera)
        s = self._without(rows)
        return s._with(new, s.covariance.appended(J, new.relative, new.by_rig, shared))

    def with_most(self, most: int) -> FilterState:
        """With so many landmarks in the state, at most, besides those of a prior map and those that are measured now.

        Those that were measured longest ago leave it.
        """
        may = np.flatnonzero(~self.landmarks.known[: self.covariance.active])
        if len(may) <= most:
            return self
        last = self.landmarks.last[may]
        oldest = np.argsort(last, kind="stable")[: len(may) - most + most // _AT_ONCE]
        rows = np.sort(may[oldest[last[oldest] < self.frame]])
        return self._left_by(rows) if len(rows) else self

    def _left_by(self, rows: IndexArray) -> FilterState:
        """After landmarks of some rows of the state leave the pose that others left last, or the present one."""
        s, P, G, seen = self, self.covariance.P, self.landmarks.gauge[rows], self.from_camera(rows)
        (own, _, by_rig), cross = self.marginals(rows), P[self.covariance.indices(rows), LEAVING]
        relative = _as_seen(own, cross, P[LEAVING, LEAVING], G)
        first = len(self.landmarks) == self.covariance.active
        if first or np.trace(np.linalg.solve(seen, relative), axis1=1, axis2=2).mean() > 3 * _AS_WELL:
            marks = changed(self.landmarks, drift=self.landmarks.drift + self._drift())
            covariance, relative = self.covariance.leaving_here(displacement(self.camera)), seen
            s = changed(self, landmarks=marks, covariance=covariance)
        left, none = self.landmarks.select(rows), np.zeros((len(rows), POSE, POSE))
        left, s = changed(left, covariance=own, relative=relative, drift=none, by_rig=by_rig), s._without(rows)
        return changed(s, landmarks=s.landmarks.joined(left))

    def _drift(self) -> Array:
        """Covariance (6, 6) of the way from the reference pose to the camera."""
        return self.covariance.way(displacement(self.camera))

    def _without(self, gone: IndexArray) -> FilterState:
        """Without the landmarks of some rows of the table."""
        stays = np.delete(np.arange(len(self.landmarks)), gone)
        covariance = self.covariance.only(stays[stays < self.covariance.active])
        return changed(self, landmarks=self.landmarks.select(stays), covariance=covariance)

    def _with(self, new: FilterLandmarks, covariance: Covariance) -> FilterState:
        """With new landmarks, the last ones of the state."""
        end, marks = self.covariance.active, self.landmarks
        landmarks = marks.select(slice(end)).joined(new).joined(marks.select(slice(end, None)))
        return changed(self, landmarks=landmarks, covariance=covariance)

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
        change = found.change[HEAD:].reshape(-1, 3)
        marks = self.landmarks.moved(update.coordinates, slice(len(change)), change)
        marks.last[update.rows[found.used]] = self.frame
        if not (np.isfinite(camera.pose).all() and np.isfinite(marks.points).all()):
            raise LinAlgError("the corrected state is not finite")
        J, shift = transport(update.camera, camera), self._shift(marks, camera)
        covariance = update.covariance.corrected(*found.gain(), J, shift)
        if not (covariance.P.diagonal()[HEAD:] > 0).all():
            raise LinAlgError("a landmark's variance would not stay positive")
        return changed(self, camera=camera, landmarks=marks, covariance=covariance)

    def displaced(self, coordinates: Coordinates, ids: IdArray, points: Array) -> FilterState:
        """With some landmarks at points (M, 3) [m]: their error stays, and the covariance is transported as above.

        What moves them is an error of the rig, the last that is considered, and none of the state's. Of those that have
        left, it is kept as seen from a camera, and so transported already.
        """
        rows, before = self.landmarks.rows_of(ids), self.landmarks
        marks = before.moved(coordinates, rows, coordinates.of(before.anchors[rows], points) - before.c[rows])
        if not np.isfinite(marks.points).all():
            return self
        change, active, by_rig = (marks.c - before.c)[rows], rows < self.covariance.active, marks.by_rig.copy()
        by_rig[rows, :, -1:] -= change[:, :, None]
        covariance = self.covariance.displaced(rows[active], change[active], self._shift(marks, self.camera))
        return changed(self, landmarks=changed(marks, by_rig=by_rig), covariance=covariance)

    def _shift(self, marks: FilterLandmarks, camera: Camera) -> Array:
        """What is added to the errors (N, 3, 6) of landmarks that have moved, by the error of the pose."""
        change = (marks.gauge - self.landmarks.gauge)[: self.covariance.active]
        return np.asarray(change @ displacement(camera) if camera.transports else np.zeros_like(change))


def _as_seen(own: Array, cross: Array, P: Array, B: Array) -> Array:
    """Covariances (M, 3, 3) of landmarks' errors as seen from a pose.

    Its error (6,) has the covariance P, and with theirs `cross` (M, 3, 6). It takes landmarks along by B (M, 3, 6).
    """
    seen = own + (B @ P - 2 * cross) @ B.transpose(0, 2, 1)
    return np.asarray(0.5 * (seen + seen.transpose(0, 2, 1)))
