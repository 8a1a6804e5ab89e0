"""An extended Kalman filter over a camera and landmarks, as a back end: `backends.ekf.backend`, `backends.iekf`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.linalg import LinAlgError

from backends.ekf.camera import Camera, from_body_axes, pose_by_error, prior
from backends.ekf.covariance import CAMERA, CLONES, POSE, positive
from backends.ekf.innovation import Update
from backends.ekf.landmarks import Coordinates, FilterLandmarks, Slide
from backends.ekf.solve import correction
from backends.ekf.state import FilterState
from slam.checks import known_landmarks, require_guess, require_not_measured, require_recent, require_stamp
from slam.data import Estimate, IdArray, Observations, Prediction, RecentPoses, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.geometry.arrays import changed
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.consensus import landmarks_pose
from slam.window.stereo import TOO_LATE, Field, RectifiedMeasurement

#: Standard deviations of a known point between it and its anchor: its coordinates are linear there, it stays Gaussian.
_STAND_OFF = 100.0
_FARTHEST_ANCHOR = 1e5  # numerics: from a known point [m]; a landmark's inverse depth keeps clear of its least
_DISPARITY = 0.01  # numerics: below this [px] a disparity is none: the landmark is put where it would be so large


class LandmarkFilter:
    """The filter for any camera and coordinates of landmarks. A back end gives it these, and a `name` for messages.

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        camera: the first one, in its prior.
        coordinates: of the landmarks.
        iterations: most linearisations of an update.
        kept: most landmarks that keep their covariance with the camera; see `FilterState`. None: all.
        stereo: whether the right pixel is measured.

    Attributes:
        state: the estimate. Each call makes a new one beside it, which takes its place at the end of the call.
    """

    name: str

    #: Of a prior map: those that were measured keep their joint covariance (72 N² bytes).
    most_landmarks = 2000

    def __init__(
        self, rig: StereoRig, models: EstimatorModels, camera: Camera, coordinates: Coordinates, iterations: int,
        kept: int | None, stereo: bool = True, /,
    ) -> None:  # fmt: skip
        # by position alone: they are no options of a back end
        self.rig, self.models = rig, models
        self._coordinates, self._iterations, self._kept, self._stereo = coordinates, iterations, kept, stereo
        self._measure = RectifiedMeasurement(rig, models.with_slide())
        self._slide = Slide.of(models, self._measure.stereo.f)
        self.state = FilterState.first(camera, from_body_axes(camera, prior(models)))
        # stamps and poses before the state's, by the number of the frame; behind those are some of steps not taken
        self._past: list[tuple[float, Array]] = []

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predict(stamp, rests=False)

    @one_blas_thread
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        return self._predict(stamp, rests=True)

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        s = self._started("update")
        require_not_measured(self.name, s.measured)
        require_guess(self.name, guess)
        s = changed(s.with_active(observations.ids), measured=True)
        s, report = self._updated(s, observations, guess)
        self.state = s
        return report

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        s = self._started("add")
        s.landmarks.require_new(observations.ids)
        stereo = self._measure.stereo
        farthest = stereo.f * stereo.baseline / _DISPARITY
        new = self._measure.first_sight(observations.ids, stereo.measure(observations), farthest)
        self.state = s.augmented(self._coordinates, observations.ids, *new)

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`."""
        self.state = self.state.removed(np.unique(np.asarray(ids, np.int64)))

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        s = self._started("estimate")
        T, P, rows = s.pose.copy(), s.pose_covariance(), s.landmarks.order
        if not landmarks:
            return Estimate(s.stamp, T, P, rows[:0], np.zeros((0, 3)), np.zeros((0, 3, 3)))
        marks, own = s.landmarks.select(rows), s.marginals(rows)[0]
        D = self._coordinates.jacobian(marks.anchors, marks.c)
        C, summands = D @ own @ D.transpose(0, 2, 1), (D * D @ np.einsum("nii->ni", own)[:, :, None])[:, :, 0]
        blocks = positive(0.5 * (C + C.transpose(0, 2, 1)), summands, 9)
        return Estimate(s.stamp, T, P, marks.ids, marks.points, blocks)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self.state.landmarks.points[self.state.landmarks.rows_of(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was estimated at each stamp, never revised."""
        return Trajectory(*self._path())

    def recent(self, n: int) -> RecentPoses:
        """The last n poses, at most five, as estimated in their time; see `slam.data.RecentPoses`.

        Raises MeasurementError before the first `predict`, or where n is less than one.
        """
        s = self._started("recent")
        n = min(require_recent(self.name, n), s.frame + 1, CLONES + 1)
        return RecentPoses(*self._path(n), s.covariance.joint_poses(pose_by_error(s.camera), n))

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        s = self.state
        known = known_landmarks(self.name, s.landmarks, ids, positions, covariances, False)
        ids, positions, covariances = known
        anchors = np.tile(np.eye(3, 4), (len(ids), 1, 1))
        anchors[:, :, 3] = positions
        deviations = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        anchors[:, 2, 3] -= np.clip(_STAND_OFF * deviations, 1.0, _FARTHEST_ANCHOR)
        new = FilterLandmarks.at(self._coordinates, ids, anchors, positions, -1, s.covariance.by_rig.shape[1])
        D = new.gauge[:, :, :3]
        C = D @ covariances @ D.transpose(0, 2, 1)
        unseen, yes = np.full((len(ids), 3), np.nan), np.ones(len(ids), bool)
        new = changed(new, sights=unseen, known=yes, covariance=C, relative=C)
        self.state = changed(s, landmarks=s.landmarks.joined(new))

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        known = known_landmarks(self.name, s.landmarks, ids, local, covariances, True)
        self.state = s.augmented(self._coordinates, *known)

    # --- errors of the rig (documented in slam.interfaces.ConsideringBackend) ---

    def consider(self, field: Field, pose: Array | None = None) -> None:
        """See `slam.interfaces.ConsideringBackend.consider`."""
        s, m = self.state, field(np.zeros((0, 3))).shape[2]
        if s.frame >= 0 or len(s.landmarks):
            raise MeasurementError(f"{self.name}: {TOO_LATE}")
        by_rig = np.zeros((CAMERA, m))
        if pose is not None:
            by_rig[:POSE] = np.linalg.solve(pose_by_error(s.camera), pose)
        self._measure = changed(self._measure, field=field)
        self.state = FilterState.first(s.camera, s.covariance.camera, by_rig)

    def sensitivities(self, ids: IdArray) -> tuple[Array, Array]:
        """See `slam.interfaces.ConsideringBackend.sensitivities`."""
        s = self._started("sensitivities")
        rows = s.landmarks.rows_of(ids)
        D = self._coordinates.jacobian(s.landmarks.anchors[rows], s.landmarks.c[rows])
        return pose_by_error(s.camera) @ s.covariance.by_rig[:POSE], D @ s.marginals(rows)[2]

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    revises_path = False

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: landmarks move to where they are seen at from now on.

        By the camera of their first sight, if not by the present one. The measurements are gone; what they made of the
        path stays. But landmarks that were placed by pixels as they were corrected before, and seen at pixels as they
        are now, would look as if the camera had moved. Those of a prior map that were not measured yet were placed by
        no pixels: they stay.
        """
        s, stereo = changed(self.state, measured=True), self._measure.stereo
        if s.frame >= 0 and len(s.landmarks):
            rows = np.arange(len(s.landmarks))
            marks = s.landmarks.select(~s.landmarks.known | (rows < s.covariance.active))
            z, _ = stereo.project(se3.transform(se3.inverse(s.pose), marks.points))
            T = np.where(self.rig.left.in_image(z[:, :2])[:, None, None], s.pose[:3], marks.anchors)
            z, _ = stereo.project(((marks.points - T[:, :, 3])[:, None] @ T[:, :, :3])[:, 0])
            rows = np.flatnonzero(np.isfinite(z[:, 0]))
            local = stereo.triangulate(stereo.corrected(self.name, z[rows], correct))
            points = (T[rows, :, :3] @ local[:, :, None])[:, :, 0] + T[rows, :, 3]
            good = np.isfinite(points).all(axis=1)
            s = s.revised(self._coordinates, marks.ids[rows[good]], points[good])
        self.state = s

    # --- the filter's parts ---

    def _path(self, last: int = 0) -> tuple[Array, Array]:
        """Stamps (F,) [s] and poses (F, 4, 4) so far, or the last ones."""
        s = self.state
        before = self._past[max(s.frame + 1 - last, 0) if last else 0 : s.frame]
        path = [*before, (s.stamp, s.pose)] if s.frame >= 0 else []
        return np.array([stamp for stamp, _ in path]), np.array([T for _, T in path]).reshape(-1, 4, 4)

    def _predict(self, stamp: float, rests: bool) -> Prediction:
        """Predict the state and what is in the angle of view; whether the camera rests meanwhile."""
        s = self.state if self._kept is None else self.state.with_most_active(self._kept)
        require_stamp(self.name, stamp, s.stamp if s.frame >= 0 else None)
        after = s.advanced(float(stamp), self.models, rests)
        T = after.pose
        rows = self._measure.visible(T, s.landmarks.points)
        marks, walk = after.landmarks.select(rows), self._slide.walked(after.landmarks, rows, T[:3, 3])[1]
        toward = T[:3, :3].T @ self._coordinates.jacobian(marks.anchors, marks.c)
        local = toward @ (after.relative_covariances(rows) + walk) @ toward.transpose(0, 2, 1)
        left, right, S = self._measure.pixels((marks.points - T[:3, 3]) @ T[:3, :3], local)
        prediction = Prediction(after.stamp, T.copy(), after.pose_covariance(), marks.ids, left, right, S)
        self._past[after.frame - 1 :] = [(s.stamp, s.pose)] if after.frame else []
        self.state = after
        return prediction

    def _updated(
        self, s: FilterState, observations: Observations, guess: Array | None
    ) -> tuple[FilterState, UpdateReport]:
        """The state after an update, and its report; all that was observed is in the state."""
        if not len(observations):
            return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        rows, z = s.landmarks.rows_of(observations.ids), self._measure.stereo.measure(observations)
        if not self._stereo:
            z[:, 2] = np.nan
        slid = s.slid(self._slide, rows, (s.pose if guess is None else guess)[:3, 3])
        update = Update(
            s.camera, slid.covariance, slid.landmarks.select(rows), rows, z, self._measure, self._coordinates,
            self._iterations, self._measure.limits(z),
        )  # fmt: skip
        update = update if guess is None else update.regular_towards(guess)

        def search() -> Array | None:  # by the whole noise: features may have slid by any way since
            T, measure = s.pose if guess is None else guess, RectifiedMeasurement(self.rig, self.models)
            return landmarks_pose(measure, update.landmarks.points, z, T, s.frame + 1)

        try:
            found = correction(update, guess, search)
            if found is None:
                reason = "no observation, or only a minority, agrees with the prediction"
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, reason, observations.ids.copy())
            after = slid.corrected(found)
        except LinAlgError as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"{self.name}: {error}")
        used = found.used
        dof, ids = int(np.isfinite(z[used]).sum()), observations.ids
        reason = "" if found.linear else f"{self.name}: not linear after {self._iterations} iterations"
        return after, UpdateReport(UpdateStatus.OK, reason, ids[used], ids[~used], found.nis, dof)

    def _started(self, what: str) -> FilterState:
        if self.state.frame < 0:
            raise MeasurementError(f"{self.name}: {what} before the first predict")
        return self.state
