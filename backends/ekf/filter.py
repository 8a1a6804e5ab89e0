"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from backends.ekf.covariance import CAMERA, POSE, Covariance, positive
from backends.ekf.landmarks import COORDINATES, Coordinates, FilterLandmarks, distant_anchors
from backends.ekf.motion import EulerCamera, Motion, motion_noise
from backends.ekf.recovery import agreement
from backends.ekf.solve import UnsolvableError, Update
from backends.ekf.state import FilterState
from slam.bounds import from_options, require_positive
from slam.checks import known_landmarks, require_guess, require_not_measured, require_recent, require_stamp
from slam.data import Estimate, IdArray, Observations, Prediction, RecentPoses, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.runtime.threads import one_blas_thread
from slam.window.consensus import landmarks_pose
from slam.window.gating import INFLATION
from slam.window.stereo import TOO_LATE, Field, RectifiedMeasurement

MEASUREMENTS = ("stereo", "left")
LANDMARKS = ("inverse_depth", "euclidean")


@dataclass(frozen=True)
class EkfConfig:
    """Options of `EkfBackend`.

    Attributes:
        papers: closest to the papers' filter: the left pixel alone, one linearisation, landmarks in the world, a
            covariance that is not transported. The other options do not count then. What stays is the gate by what all
            others predict, the outlier test, the recovery, and the limit of 300 landmarks in the state.
        measurement: ``"stereo"`` measures (uL, vL, uR), ``"left"`` the left pixel alone, as the papers do (paper A, V).
        iterations: most linearisations in an update; 1 is the papers' filter (paper A, Eq. 11). More are made only in
            updates where the first is not linear to within the noise.
        landmarks: coordinates of a landmark in the state: ``"inverse_depth"`` by the camera that saw it first, or
            ``"euclidean"`` in the world, as the papers do. See `backends.ekf.landmarks`.
        consistent: keep the unobservable pose of the whole map (where the world's origin is and which way it faces)
            from seeming to be measured: the covariance is transported to the corrected state after each update.

    Raises:
        ConfigurationError: a value is out of its range.
    """

    papers: bool = False
    measurement: str = "stereo"
    iterations: int = 5
    landmarks: str = "inverse_depth"
    consistent: bool = True

    def __post_init__(self) -> None:
        require_positive(self, {"iterations": (1, 1000)}, "ekf")
        for name, known in (("measurement", MEASUREMENTS), ("landmarks", LANDMARKS)):
            if getattr(self, name) not in known:
                raise ConfigurationError(f"ekf: {name} must be one of {known}, got {getattr(self, name)!r}")

    def resolved(self) -> EkfConfig:
        """The options that count: those of the papers' filter where it is asked for."""
        if self.papers:
            return EkfConfig(True, "left", 1, "euclidean", False)
        return self


_DISPARITY = 0.01  # numerics: below this [px] a disparity is none: the landmark is put where it would be so large


@dataclass(frozen=True, eq=False)
class Form:
    """What a filter is of: the camera and its error, and the landmarks' coordinates."""

    name: str  # of the back end, for messages
    config: Any  # its options
    camera: Any  # the first one: `backends.ekf.motion.EulerCamera`, or another
    covariance: Array  # of its error (12, 12)
    coordinates: Coordinates  # of the landmarks
    iterations: int  # most linearisations of an update
    stereo: bool = True  # whether the right pixel is measured


def papers_form(models: EstimatorModels, options: dict[str, Any]) -> Form:
    """The papers' Euler angles, by the options of `EkfConfig`."""
    config = from_options(EkfConfig, "ekf", options)
    use = config.resolved()
    stereo = use.measurement == "stereo"
    camera, P = EulerCamera.first(models, use.consistent)
    return Form("ekf", config, camera, P, COORDINATES[use.landmarks], use.iterations, stereo)


class EkfBackend:
    """Extended Kalman filter over the camera's motion and the landmarks: the papers' state estimator, made consistent.

    The state is ``[r, φ, v, ω]`` (12), world position, Euler angles, world velocity and angle rates (paper B, section
    2), then three coordinates per landmark. The camera moves at constant velocity disturbed by impulses, with
    the printed A and W. A landmark enters with its full cross-covariance (paper A, Eqs. 8 and 10).

    By default this is not the papers' plain filter. It differs in what it measures (the right pixel as well as the
    left), in the landmarks' coordinates (inverse depth, `backends.ekf.landmarks`), in updates that are linearised again
    where the first time is not enough, in landmarks tested against all others and in recovery (`backends.ekf.solve`,
    `backends.ekf.recovery`), and in a covariance that is transported to each corrected state, so that nothing seems to
    be learnt of where the world is (`backends.ekf.state`). The option ``papers=True`` undoes four of these: the left
    pixel alone, one linearisation, landmarks in the world, no transport; tests and recovery stay. The angles refer to a
    world of their own in both (`backends.ekf.angles`).

    Args:
        rig: the cameras, rectified.
        models: noise, priors, motion and gate.
        form: makes what the filter is of, by models and options: the papers' Euler angles, or another camera.
        options: of the form; see `EkfConfig`.

    Attributes:
        state: what is believed now. Each call makes a new one beside it, which takes its place at the end of the call.

    Raises:
        ConfigurationError: an option is unknown or out of range.
    """

    #: Of a prior map: those that were measured keep their joint covariance (72 N² bytes).
    most_landmarks = 2000

    def __init__(
        self,
        rig: StereoRig,
        models: EstimatorModels = EstimatorModels(),  # noqa: B008
        form: Callable[[EstimatorModels, dict[str, Any]], Form] = papers_form,
        **options: Any,
    ) -> None:
        self.rig, self.models = rig, models
        if not callable(form):
            raise ConfigurationError(
                "form: a function of models and options makes the form of a filter; it is no option"
            )
        self._form = form(models, options)
        self.config, self._coordinates = self._form.config, self._form.coordinates
        self._measure = RectifiedMeasurement(rig, models)
        stereo = self._measure.stereo
        self._farthest = stereo.f * stereo.baseline / _DISPARITY  # depth of a new landmark [m]
        self.state = FilterState.first(self._form.camera, self._form.covariance)
        self._past: list[tuple[float, Array]] = []  # stamps and poses before the state's

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predicted(stamp, lambda camera, dt: camera.advanced(self.models, self.state.covariance.camera, dt))

    @one_blas_thread
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        return self._predicted(stamp, lambda camera, dt: camera.at_rest())

    @one_blas_thread
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        s = self._started("update")
        require_not_measured(self._form.name, s.measured)
        require_guess(self._form.name, guess)
        s = replace(s.with_all_of(observations.ids), measured=True)
        s, report = self._updated(s, observations, guess)
        self.state = s
        return report

    @one_blas_thread
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        s = self._started("add")
        s.landmarks.require_new(observations.ids)
        z = self._measure.stereo.measure(observations)
        new = self._measure.first_sight(observations.ids, z, self._farthest)
        self.state = s.placed(self._coordinates, observations.ids, *new)

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
        marks, own = s.landmarks.select(rows), s.covariance.marginals(rows)[0]
        D = self._coordinates.jacobian(marks.anchors, marks.c)
        C, summands = D @ own @ D.transpose(0, 2, 1), (D * D @ np.einsum("nii->ni", own)[:, :, None])[:, :, 0]
        blocks = positive(0.5 * (C + C.transpose(0, 2, 1)), summands, 9)
        return Estimate(s.stamp, T, P, marks.ids, marks.points, blocks)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self.state.landmarks.points[self.state.landmarks.rows_of(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was believed at each stamp, never revised."""
        s = self.state
        path = [*self._past[: s.frame], (s.stamp, s.pose)] if s.frame >= 0 else []
        return Trajectory(np.array([stamp for stamp, _ in path]), np.array([T for _, T in path]).reshape(-1, 4, 4))

    def recent(self, n: int) -> RecentPoses:
        """The camera's last n poses, at most five, as they were believed in their time; see `slam.data.RecentPoses`.

        Raises:
            MeasurementError: before the first `predict`, or n is less than one.
        """
        return self._started("recent").recent_poses(require_recent(self._form.name, n))

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        s = self.state
        known = known_landmarks(self._form.name, s.landmarks, ids, positions, covariances, False)
        ids, positions, covariances = known
        anchors = distant_anchors(positions, covariances)
        new = FilterLandmarks.at(self._coordinates, ids, anchors, positions, s.frame)
        D = self._coordinates.inverse_jacobian(anchors, new.c)
        self.state = s.inserted(new, D @ covariances @ D.transpose(0, 2, 1))

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        known = known_landmarks(self._form.name, s.landmarks, ids, local, covariances, True)
        self.state = s.placed(self._coordinates, *known)

    # --- errors of the rig (documented in slam.interfaces.ConsideringBackend) ---

    def consider(self, field: Field, pose: Array | None = None) -> None:
        """See `slam.interfaces.ConsideringBackend.consider`."""
        s, m = self.state, field(np.zeros((0, 3))).shape[2]
        if s.frame >= 0 or len(s.landmarks):
            raise MeasurementError(f"{self._form.name}: {TOO_LATE}")
        by_rig = np.zeros((CAMERA, m))
        if pose is not None:
            by_rig[:POSE] = np.linalg.solve(s.camera.by_error(), pose)
        self._measure = replace(self._measure, field=field)
        self.state = replace(s, covariance=Covariance.of_camera(s.covariance.camera, by_rig))

    def sensitivities(self, ids: IdArray) -> tuple[Array, Array]:
        """See `slam.interfaces.ConsideringBackend.sensitivities`."""
        s = self._started("sensitivities")
        rows = s.landmarks.rows_of(ids)
        D = self._coordinates.jacobian(s.landmarks.anchors[rows], s.landmarks.c[rows])
        return s.camera.by_error() @ s.covariance.by_rig[:POSE], D @ s.covariance.landmarks_by_rig(rows)

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    revises_path = False

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: landmarks in view move to where they are seen at from now on.

        The measurements are gone; what they made of the path stays. But landmarks that were placed by pixels as they
        were corrected before, and seen at pixels as they are now, would look as if the camera had moved.
        """
        s, stereo = replace(self.state, measured=True), self._measure.stereo
        if s.frame >= 0 and len(s.landmarks):
            z, _ = stereo.project(se3.transform(se3.inverse(s.pose), s.landmarks.points))
            rows = np.flatnonzero(self.rig.left.in_image(z[:, :2]))
            z = stereo.corrected(self._form.name, z[rows], correct)
            points = se3.transform(s.pose, stereo.triangulate(z))
            good = np.isfinite(points).all(axis=1)
            rows, points = rows[good], points[good]
            change = self._coordinates.of(s.landmarks.anchors[rows], points) - s.landmarks.c[rows]
            if np.isfinite(change).all():
                marks = s.landmarks.moved(self._coordinates, rows, change)
                s = replace(s, landmarks=marks, covariance=s.covariance.displaced(rows, change))
        self.state = s

    # --- the filter's parts ---

    def _predicted(self, stamp: float, moved: Callable[[Any, float], Motion]) -> Prediction:
        """Go to a time; `moved` says what the camera does meanwhile."""
        s = self.state
        require_stamp(self._form.name, stamp, s.stamp if s.frame >= 0 else None)
        if s.frame < 0:
            after = replace(s, stamp=float(stamp), frame=0, measured=False)
        else:
            after = s.advanced(float(stamp), moved(s.camera, stamp - s.stamp))
        prediction = self._prediction(after)
        self._past[after.frame - 1 :] = [(s.stamp, s.pose)] if after.frame else []
        self.state = after
        return prediction

    def _prediction(self, s: FilterState) -> Prediction:
        """Pose, and what is in the angle of view with its innovation covariance."""
        T, rows = s.pose, self._measure.visible(s.pose, s.landmarks.points)
        marks, (blocks, cross) = s.landmarks.select(rows), s.covariance.marginals(rows)
        toward = T[:3, :3].T @ self._coordinates.jacobian(marks.anchors, marks.c)
        A = -toward @ (marks.gauge @ s.camera.world())  # derivatives (M, 3, 6) of where they are, seen from the camera
        seen = (A @ s.covariance.pose + 2 * toward @ cross) @ A.transpose(0, 2, 1)
        seen = 0.5 * (seen + seen.transpose(0, 2, 1)) + toward @ blocks @ toward.transpose(0, 2, 1)
        left, right, S = self._measure.pixels((marks.points - T[:3, 3]) @ T[:3, :3], seen)
        return Prediction(s.stamp, T.copy(), s.pose_covariance(), marks.ids, left, right, S)

    def _updated(
        self, s: FilterState, observations: Observations, guess: Array | None
    ) -> tuple[FilterState, UpdateReport]:
        """The state after an update, and its report; all that was observed is in the state."""
        if not len(observations):
            return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        rows, z = s.landmarks.rows_of(observations.ids), self._measure.stereo.measure(observations)
        if not self._form.stereo:
            z[:, 2] = np.nan
        update = Update(
            s.camera, s.covariance, s.landmarks.select(rows), rows, z, self.models.pixel_sigma, self._measure.stereo,
            self._coordinates, self._form.iterations, self.models.gate_probability, guess,
            self._measure.field,
        )  # fmt: skip
        noises = (factor**2 * motion_noise(self.models, s.dt) for factor in INFLATION if s.frame > 0)

        def search() -> Array | None:
            T = s.pose if guess is None else guess
            return landmarks_pose(self._measure, update.landmarks.points, z, T, s.frame + 1)

        try:
            found = agreement(update, noises, search, self.models)
            if found is None:
                reason = "no observation, or only a minority, agrees with the prediction"
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, reason, observations.ids.copy())
            after = s.corrected(found)
        except UnsolvableError as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"{self._form.name}: {error}")
        used, w = found.used, found.whitened.w
        dof, ids = int(np.isfinite(z[used]).sum()), observations.ids
        return after, UpdateReport(UpdateStatus.OK, "", ids[used], ids[~used], float(w @ w), dof)

    def _started(self, what: str) -> FilterState:
        if self.state.frame < 0:
            raise MeasurementError(f"{self._form.name}: {what} before the first predict")
        return self.state
