"""The filter's state, and what changes it: each step makes a new one of the old."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError

from backends.ekf.camera import Camera, gauge_by_error, pose_by_error, predicted, transport
from backends.ekf.covariance import CAMERA, HEAD, POSE, REFERENCE, Covariance
from backends.ekf.innovation import Correction
from backends.ekf.landmarks import Coordinates, FilterLandmarks, Slide
from slam.data import IdArray, IndexArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

#: The reference pose stays as long as landmarks that leave are not more uncertain relative to it than relative to the
#: camera by this factor of the variance. With 2 or 4 a hovering camera claims 1.1 to 1.5 times the deviation that it
#: would if all had stayed, with 0, which is a new reference pose at each leaving, 2.4 to 3.6 times.
_AS_WELL = 2.0
_AT_ONCE = 8  # cost: one of so many landmarks leaves at once, so that the matrix is not copied in every frame


@dataclass(frozen=True, eq=False)
class FilterState:
    """A camera and three coordinates per landmark, with the joint covariance of their errors.

    Landmarks that were measured longest ago become inactive: they leave the matrix and stay in the map, where they
    were, with their covariance in the world. Relative to the camera, they are as uncertain as relative to the reference
    pose, a clone of the camera's when they left, plus the drift since, whose covariance is known as the clone stays in
    the state. Where a new clone becomes the reference pose, the drift from the old one to it is added to theirs as if
    it were independent. So are inactive landmarks predicted, and so do those that are measured again join, as new ones
    would: independent of the pose, relative to the camera. They tell it nothing of the past, and nothing is counted
    twice.
    """

    stamp: float  # time [s]; NaN before the first prediction
    frame: int  # number of the prediction, −1 before the first
    measured: bool  # whether this frame has had its update, or landmarks added
    camera: Camera
    landmarks: FilterLandmarks  # all of them
    covariance: Covariance  # of the camera and those in the state
    drifts: Array  # covariances (K, 6, 6) of the drift from each reference pose to the present one, the last of them

    @classmethod
    def first(cls, camera: Camera, P: Array, by_rig: Array | None = None) -> FilterState:
        """Before the first prediction, with what `Covariance.of_camera` says of the camera's error."""
        covariance, drifts = Covariance.of_camera(P, by_rig), np.zeros((1, POSE, POSE))
        marks = FilterLandmarks.none(covariance.by_rig.shape[1])
        return cls(float("nan"), -1, True, camera, marks, covariance, drifts)

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

    def advanced(self, stamp: float, models: EstimatorModels, rests: bool) -> FilterState:
        """The prediction for a later time; the first one is the prior. Whether the camera rests meanwhile."""
        motion: tuple[Camera, Array, Array] = self.camera, np.eye(CAMERA), np.zeros((CAMERA, CAMERA))
        if self.frame >= 0:
            motion = predicted(self.camera, models, self.covariance.camera, stamp - self.stamp, rests)
        camera, A, noise = motion
        covariance = self.covariance.advanced(A, noise, pose_by_error(self.camera))
        return FilterState(stamp, self.frame + 1, False, camera, self.landmarks, covariance, self.drifts)

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

    def relative_covariances(self, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmarks' errors, in their coordinates, relative to the camera."""
        (own, cross, _), gauge, marks = self.marginals(rows), self.landmarks.gauge[rows], self.landmarks
        relative = _relative(own, cross, self.covariance.pose, gauge @ gauge_by_error(self.camera))
        inactive = (rows >= self.covariance.active) & ~marks.known[rows]
        if inactive.any():
            left, gauge = rows[inactive], gauge[inactive]
            drifts = self._drifts(marks.reference[left])
            relative[inactive] = marks.relative[left] + gauge @ drifts @ gauge.transpose(0, 2, 1)
        return relative

    def slid(self, slide: Slide, rows: IndexArray, r: Array) -> FilterState:
        """With landmarks of some rows (M,) of the state seen from r (3,), and their features slid there."""
        landmarks, walk = slide.walked(self.landmarks, rows, r)
        covariance = self.covariance.walked(rows, walk) if walk.any() else self.covariance
        return changed(self, landmarks=landmarks, covariance=covariance)

    # --- landmarks join and leave ---

    def augmented(
        self, coordinates: Coordinates, ids: IdArray, h: Array, covariances: Array, by_rig: Array | None = None
    ) -> FilterState:
        """With new landmarks at h (M, 3) in the camera's coordinates with covariances (M, 3, 3) (paper A, Eq. 10).

        Errors of the rig displace them there by derivatives (M, 3, m).
        """
        if not len(ids):
            return self
        R, anchors = self.pose[:3, :3], np.repeat(self.pose[None, :3], len(h), axis=0)
        points, m = self.pose[:3, 3] + h @ R.T, self.covariance.by_rig.shape[1]
        new = FilterLandmarks.at(coordinates, ids, anchors, points, self.frame, m)
        D, N = new.gauge[:, :, :3] @ R, new.gauge @ gauge_by_error(self.camera)
        moved = N @ self.covariance.by_rig[:POSE] + (0.0 if by_rig is None else D @ by_rig)
        covariance = self.covariance.appended(N, D @ covariances @ D.transpose(0, 2, 1), moved)
        return changed(self, measured=True)._with(new, covariance)

    def removed(self, ids: IdArray) -> FilterState:
        """Without some landmarks (M,)."""
        return self._without(self.landmarks.rows_of(ids)) if len(ids) else self

    def with_active(self, ids: IdArray) -> FilterState:
        """With some landmarks (M,), which may be inactive, in the state.

        Two that have left share the drift since the later of them left. Those of a prior map are independent of the
        pose in the world.
        """
        rows = self.landmarks.rows_of(ids)
        rows = np.sort(rows[rows >= self.covariance.active])  # in the order in which they left
        if not len(rows):
            return self
        new = self.landmarks.select(rows)
        gauge = np.where(new.known[:, None, None], 0.0, new.gauge)
        shared = (gauge @ self._drifts(new.reference)).reshape(-1, POSE) @ gauge.reshape(-1, POSE).T
        shared, s = np.tril(shared) + np.tril(shared, -1).T, self._without(rows)
        N = gauge @ gauge_by_error(self.camera)
        return s._with(new, s.covariance.appended(N, new.relative, new.by_rig, shared))

    def with_most_active(self, most: int) -> FilterState:
        """With so many landmarks in the state, at most, besides those of a prior map and those that are measured now.

        Those that were measured longest ago become inactive.
        """
        may = np.flatnonzero(~self.landmarks.known[: self.covariance.active])
        if len(may) <= most:
            return self
        last = self.landmarks.last[may]
        oldest = np.argsort(last, kind="stable")[: len(may) - most + most // _AT_ONCE]
        rows = np.sort(may[oldest[last[oldest] < self.frame]])
        return self._deactivated(rows) if len(rows) else self

    def _deactivated(self, rows: IndexArray) -> FilterState:
        """With landmarks of some rows of the state inactive, by the reference pose, or the present one as a new one."""
        s, P, gauge, here = self, self.covariance.P, self.landmarks.gauge[rows], self.relative_covariances(rows)
        (own, _, by_rig), cross = self.marginals(rows), P[self.covariance.indices(rows), REFERENCE]
        first = len(self.landmarks) == self.covariance.active
        relative = _relative(own, cross, P[REFERENCE, REFERENCE], gauge)
        if first or np.trace(np.linalg.solve(here, relative), axis1=1, axis2=2).mean() > 3 * _AS_WELL:
            used, reference = np.unique(self.landmarks.reference, return_inverse=True)
            marks = changed(self.landmarks, reference=reference)
            drifts = np.concatenate([self._drifts(used), np.zeros((1, POSE, POSE))])
            covariance, relative = self.covariance.with_reference(gauge_by_error(self.camera)), here
            s = changed(self, landmarks=marks, covariance=covariance, drifts=drifts)
        left, reference = self.landmarks.select(rows), np.full(len(rows), len(s.drifts) - 1)
        left, s = changed(left, covariance=own, relative=relative, reference=reference, by_rig=by_rig), s._without(rows)
        return changed(s, landmarks=s.landmarks.joined(left))

    def _drifts(self, references: IndexArray) -> Array:
        """Covariances (M, 6, 6) of the drift from some reference poses (M,) to the camera."""
        return self.drifts[references] + self.covariance.drift(gauge_by_error(self.camera))

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
        the state, though, and an update moves the state: a filter that goes on with the same covariance seems to have
        measured such displacements, in time very well (Huang, Mourikis and Roumeliotis, 2010). So the error is split
        into the displacement of the world that is the error of the camera's pose, which is written in the corrected
        state's coordinates, and the rest, which stays as it is. That is the error of an invariant filter (Barrau and
        Bonnabel, 2015). Raises LinAlgError where the new state is not finite, or a variance is lost in rounding.
        """
        update, camera = found.at.update, found.camera
        change, last = found.change[HEAD:].reshape(-1, 3), self.landmarks.last.copy()
        last[update.rows[found.used]] = self.frame
        marks = changed(self.landmarks, last=last).moved(update.coordinates, slice(len(change)), change)
        if not (np.isfinite(camera.pose).all() and np.isfinite(marks.points).all()):
            raise LinAlgError("the corrected state is not finite")
        J, shift = transport(update.camera, camera), self._shift(marks, camera)
        covariance = update.covariance.corrected(*found.reduction(), J, shift)
        if not (covariance.P.diagonal()[HEAD:] > 0).all():
            raise LinAlgError("a landmark's variance would not stay positive")
        return changed(self, camera=camera, landmarks=marks, covariance=covariance)

    def revised(self, coordinates: Coordinates, ids: IdArray, points: Array) -> FilterState:
        """With some landmarks at points (M, 3) [m]: their error stays, and the covariance is transported as above.

        What moves them is an error of the rig, the last one, which is known to be 1, and none of the state's. Of
        inactive ones the covariance is kept relative to a camera, and so transported already.
        """
        rows, before, P = self.landmarks.rows_of(ids), self.landmarks, self.covariance
        marks = before.moved(coordinates, rows, coordinates.of(before.anchors[rows], points) - before.c[rows])
        if not np.isfinite(marks.points).all():
            return self
        change, active = (marks.c - before.c)[rows, :, None], rows < P.active
        inactive, by_rig = marks.by_rig.copy(), P.by_rig.copy()
        inactive[rows, :, -1:] -= change
        by_rig[P.indices(rows[active]), -1:] -= change[active]
        nothing, J = np.zeros((len(by_rig), 0)), np.eye(CAMERA)
        P = changed(P, by_rig=by_rig).corrected(nothing, 0 * by_rig, J, self._shift(marks, self.camera))
        return changed(self, landmarks=changed(marks, by_rig=inactive), covariance=P)

    def _shift(self, marks: FilterLandmarks, camera: Camera) -> Array:
        """What is added to the errors (N, 3, 6) of landmarks that have moved, by the error of the pose."""
        change = (marks.gauge - self.landmarks.gauge)[: self.covariance.active]
        return np.asarray(change @ gauge_by_error(camera) if camera.transports else np.zeros_like(change))


def _relative(own: Array, cross: Array, P: Array, N: Array) -> Array:
    """Covariances (M, 3, 3) of landmarks' errors relative to a pose, ``[−N, 1]`` times those of both.

    The pose's error (6,) has the covariance P, and with theirs `cross` (M, 3, 6).
    """
    relative = own + (N @ P - 2 * cross) @ N.transpose(0, 2, 1)
    return np.asarray(0.5 * (relative + relative.transpose(0, 2, 1)))
