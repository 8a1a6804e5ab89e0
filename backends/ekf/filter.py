"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from backends.ekf.config import EkfConfig
from backends.ekf.covariance import CAMERA
from backends.ekf.landmarks import COORDINATES, Coordinates, Landmarks, distant_anchors
from backends.ekf.measurement import Jacobian, Measurement
from backends.ekf.motion import Camera, EulerCamera, Motion, motion_noise
from backends.ekf.recovery import agreement
from backends.ekf.solve import Problem, UnsolvableError
from backends.ekf.state import State
from slam.bounds import from_options
from slam.checks import require_guess, require_not_measured, require_recent, require_stamp
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, RecentPoses, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.mapping.known_landmarks import require_in_front, require_known
from slam.models import EstimatorModels
from slam.runtime.blas import one_blas_thread
from slam.window.agreement import INFLATION, landmarks_pose
from slam.window.gating import with_noise

_DISPARITY = 0.01  # numerics: below this [px] a disparity is none: the landmark is put where it would be so large


@dataclass(frozen=True, eq=False)
class Form:
    """What a filter is of: the camera and its error, and the landmarks' coordinates.

    Attributes:
        name: of the back end, for messages.
        config: its options.
        camera: the first one.
        covariance: of its error (12, 12).
        coordinates: of the landmarks.
        iterations: most linearisations of an update.
        stereo: whether the right pixel is measured.
    """

    name: str
    config: Any
    camera: Camera
    covariance: Array
    coordinates: Coordinates
    iterations: int
    stereo: bool = True


def papers_form(models: EstimatorModels, options: dict[str, Any]) -> Form:
    """The papers' Euler angles, by the options of `EkfConfig`."""
    config = from_options(EkfConfig, "ekf", options)
    use = config.resolved()
    stereo = use.measurement == "stereo"
    camera, P = EulerCamera.first(models, use.consistent and stereo)
    return Form("ekf", config, camera, P, COORDINATES[use.landmarks], use.iterations, stereo)


class EkfBackend:
    """Extended Kalman filter over the camera's motion and the landmarks, the papers' state estimator.

    The state is ``[r, φ, v, ω]`` (12), world position, Euler angles, world velocity and angle rates (paper B, section
    2), then three coordinates per landmark. The camera moves at constant velocity disturbed by impulses, with
    the printed A and W. A landmark enters with its full cross-covariance (paper A, Eqs. 8 and 10). See
    `backends.ekf.angles` for the angles' world and for what the Euler model costs, `backends.ekf.landmarks` for the
    landmarks' coordinates, `backends.ekf.solve` for the update and `State.corrected` for what keeps it consistent.

    Args:
        rig: the cameras.
        models: noise, priors, motion and gate.
        form: makes what the filter is of, by models and options: the papers' Euler angles, or another error.
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
        self._farthest = rig.left.fu * float(np.linalg.norm(rig.b)) / _DISPARITY  # depth of a new landmark [m]
        self.state = State.first(self._form.camera, self._form.covariance)
        self._past: list[tuple[float, Array]] = []  # stamps and poses before the state's

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        return self._predicted(stamp, self._advanced)

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
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)  # paper A, Eq. (8)
        bad = ~np.isfinite(h).all(axis=1)
        if bad.any():
            what = f"landmark {observations.ids[bad][0]} has no right pixel or no positive depth"
            raise MeasurementError(f"{self._form.name}: {what}")
        h = h * np.minimum(1.0, self._farthest / h[:, 2:])
        covariances = self.rig.triangulation_covariance(h, self.models.pixel_sigma)
        self.state = s.placed(self._coordinates, observations.ids, h, covariances)

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`."""
        self.state = self.state.removed(np.unique(np.asarray(ids, np.int64)))

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        s = self._started("estimate")
        rows = np.argsort(s.landmarks.ids) if landmarks else np.zeros(0, np.intp)
        marks = s.landmarks.take(rows)
        D = self._coordinates.jacobian(marks.anchors, marks.c)
        blocks = D @ (s.landmark_covariances(rows) if landmarks else np.zeros((0, 3, 3))) @ D.transpose(0, 2, 1)
        covariances = 0.5 * (blocks + blocks.transpose(0, 2, 1))
        return Estimate(s.stamp, s.pose.copy(), s.pose_covariance(), marks.ids, marks.points, covariances)

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
        require_known(self._form.name, ids, positions, covariances)
        s, anchors = self.state, distant_anchors(positions, covariances)
        s.landmarks.require_new(ids)
        new = Landmarks.at(self._coordinates, ids.astype(np.int64), anchors, positions.astype(float), s.frame)
        D = self._coordinates.inverse_jacobian(anchors, new.c)
        self.state = s.inserted(new, D @ covariances @ D.transpose(0, 2, 1))

    @one_blas_thread
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        s = self._started("place")
        require_known(self._form.name, ids, local, covariances)
        require_in_front(self._form.name, ids, local)
        s.landmarks.require_new(ids)
        self.state = s.placed(self._coordinates, ids, local, covariances)

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    revises_path = False

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: landmarks in view move to where they are seen at from now on.

        The measurements are gone; what they made of the path stays. But landmarks that were placed by pixels as they
        were corrected before, and seen at pixels as they are now, would look as if the camera had moved.
        """
        s, rectified_rig = replace(self.state, measured=True), self.rig.rectified
        if s.frame >= 0 and len(s.landmarks):
            T = s.pose @ rectified_rig.T_left_rectified
            local = se3.transform(se3.inverse(T), s.landmarks.points)
            z, _ = rectified_rig.rig.project_stereo(local, jacobian=False)
            rows = np.flatnonzero(rectified_rig.rig.left.in_image(z[:, :2]))
            z = correct(z[rows])
            if not np.isfinite(z).all():
                raise MeasurementError(f"{self._form.name}: a mended measurement is not finite")
            points = se3.transform(T, rectified_rig.rig.triangulate(z[:, :2], z[:, [2, 1]]))
            good = np.isfinite(points).all(axis=1)
            rows, points = rows[good], points[good]
            change = self._coordinates.of(s.landmarks.anchors[rows], points) - s.landmarks.c[rows]
            if np.isfinite(change).all():
                s = replace(s, landmarks=s.landmarks.moved(self._coordinates, rows, change))
        self.state = s

    # --- the filter's parts ---

    def _advanced(self, camera: Camera, dt: float) -> Motion:
        """The camera after a step by the motion model."""
        return camera.advanced(self.models, self.state.covariance.dense[:CAMERA, :CAMERA], dt)

    def _predicted(self, stamp: float, moved: Callable[[Camera, float], Motion]) -> Prediction:
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

    def _prediction(self, s: State) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        marks, T = s.landmarks, s.pose
        rows = np.flatnonzero(self.rig.left.in_view((marks.points - T[:3, 3]) @ T[:3, :3]))
        blocks, cross = (part[rows] for part in s.covariance.marginals())
        z, own = Measurement(self.rig, self._coordinates, marks.anchors[rows]).linearise(T, marks.c[rows])
        H = Jacobian.of(own, s.relative(rows), rows)
        right = z[:, [2, 1]]
        if not self.rig.is_rectified:
            right = self.rig.project((marks.points[rows] - T[:3, 3]) @ T[:3, :3])[1]
        S = with_noise(H.own_covariances(s.covariance.pose, cross, blocks)[:, :2, :2], self.models.pixel_sigma)
        return Prediction(s.stamp, T.copy(), s.pose_covariance(), marks.ids[rows], z[:, :2], right, S)

    def _updated(self, s: State, observations: Observations, guess: Array | None) -> tuple[State, UpdateReport]:
        """The state after an update, and its report; all that was observed is in the state's dense part."""
        if not len(observations):
            return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        rows = s.landmarks.rows_of(observations.ids)
        problem = self._problem(s, observations, rows, guess)
        noises = []
        if s.frame > 0:
            noises = [factor**2 * motion_noise(self.models, s.dt) for factor in INFLATION]
        try:
            found = agreement(problem, noises, lambda: self._landmarks_pose(s, problem, rows), self.models)
            if found is None:
                reason = "no observation, or only a minority, agrees with the prediction"
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, reason, observations.ids.copy())
            after = State.corrected(self._coordinates, found, rows)
        except UnsolvableError as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"{self._form.name}: {error}")
        used, w = found.used, found.system.w
        dof = int(np.isfinite(problem.z[used]).sum())
        return after, UpdateReport(
            UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], float(w @ w), dof
        )

    def _problem(self, s: State, observations: Observations, rows: IndexArray, guess: Array | None) -> Problem:
        """The update by landmarks of some rows (M,) of the table."""
        z = np.concatenate([observations.uv_left, observations.uv_right[:, :1]], axis=1)
        if not self._form.stereo:
            z[:, 2] = np.nan
        view, model = partial(s.view, rows), Measurement(self.rig, self._coordinates, s.landmarks.anchors[rows])
        return Problem(
            view, s.landmarks.c[rows], CAMERA + 3 * rows, z, self.models.pixel_sigma, model, self._form.iterations,
            self.models.gate_probability, guess,
        )  # fmt: skip

    def _landmarks_pose(self, s: State, problem: Problem, rows: IndexArray) -> Array | None:
        """The pose (4, 4) on which most of the landmarks agree, if there is one."""
        T = s.pose if problem.guess is None else problem.guess
        return landmarks_pose(self.rig, s.landmarks.points[rows], problem.z, self.models, T, s.frame + 1)

    def _started(self, what: str) -> State:
        if self.state.frame < 0:
            raise MeasurementError(f"{self._form.name}: {what} before the first predict")
        return self.state
