"""The EKF back end (paper A, Eq. 11; paper B, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from backends.ekf.atomic import all_or_nothing
from backends.ekf.config import EkfConfig
from backends.ekf.covariance import POSE
from backends.ekf.landmarks import distant_anchors
from backends.ekf.measurement import StereoMeasurement, chained, innovation_covariances
from backends.ekf.motion import motion_noise
from backends.ekf.recovery import agreement
from backends.ekf.solve import Problem, UnsolvableError
from backends.ekf.state import FilterState
from slam.checks import require_guess, require_not_measured, require_stamp
from slam.data import Estimate, IdArray, IndexArray, Observations, Prediction, UpdateReport, UpdateStatus
from slam.errors import MeasurementError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.mapping.known_landmarks import require_in_front, require_known
from slam.models import EstimatorModels
from slam.options import from_options
from slam.runtime.blas import one_blas_thread
from slam.window.agreement import INFLATION, landmarks_pose
from slam.window.gating import with_noise

_DISPARITY = 0.01  # numerics: below this [px] a disparity is none: the landmark is put where it would be so large
_VAGUE = 1e3  # cost: deviation of an innovation, in those of a pixel, above which all of P is brought up to date


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

    #: Of a prior map: with more, the joint covariance (72 N² bytes, and copies of it while it grows) is too large.
    most_landmarks = 2000

    def __init__(self, rig: StereoRig, models: EstimatorModels = EstimatorModels(), **options: Any) -> None:  # noqa: B008
        self.rig = rig
        self.models = models
        self.config = from_options(EkfConfig, "ekf", options)
        self._stamps: list[float] = []
        self._poses: list[Array] = []
        self._measured = True  # whether the newest pose may not be updated any more
        self._state = FilterState(models, self.config)
        self._farthest = rig.left.fu * float(np.linalg.norm(rig.b)) / _DISPARITY  # depth of a new landmark [m]

    def saved(self) -> Callable[[], None]:
        """A function that puts everything back as it is now."""
        state, count, last = self._state.saved(), len(self._stamps), self._poses[-1:]
        measured = self._measured

        def restore() -> None:
            state()
            del self._stamps[count:], self._poses[count:]
            self._poses[count - len(last) :] = last
            self._measured = measured

        return restore

    # --- the protocol (documented in slam.interfaces.Backend) ---

    @one_blas_thread
    @all_or_nothing
    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend.predict`."""
        require_stamp("ekf", stamp, self._stamps[-1] if self._stamps else None)
        if self._stamps:
            self._state.advance(stamp - self._stamps[-1])
        self._stamps.append(float(stamp))
        self._poses.append(self._state.pose())
        self._measured = False
        return self._prediction()

    @one_blas_thread
    @all_or_nothing
    def predict_at_rest(self, stamp: float) -> Prediction:
        """See `slam.interfaces.RestingBackend.predict_at_rest`."""
        if not self._stamps:
            return self.predict(stamp)
        require_stamp("ekf", stamp, self._stamps[-1])
        self._state.rest()
        self._stamps.append(float(stamp))
        self._poses.append(self._state.pose())
        self._measured = False
        return self._prediction()

    @one_blas_thread
    @all_or_nothing
    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend.update`."""
        self._require_started("update")
        require_not_measured("ekf", self._measured)
        require_guess("ekf", guess)
        slots = self._state.landmarks.slots(observations.ids)
        self._measured = True
        if not len(slots):
            return UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        self._state.make_local(slots)
        problem = self._problem(observations, slots, guess)
        try:
            found = agreement(
                problem, self._inflated_noises(), lambda: self._landmarks_pose(problem, slots), self.models
            )
            if found is None:
                reason = "no observation, or only a minority, agrees with the prediction"
                return UpdateReport.nothing(UpdateStatus.EMPTY, reason, observations.ids)
            if found.solution.uncertainty(problem.sigma) > _VAGUE:
                # What the rest becomes is a difference of numbers larger than itself by the condition of S: only the
                # dense part keeps enough digits.
                self._state.make_local(np.arange(len(self._state.landmarks)))
            self._state.correct(slots, found)
        except UnsolvableError as error:
            return UpdateReport.nothing(UpdateStatus.FAILED, f"ekf: {error}")
        self._poses[-1] = self._state.pose()
        solution = found.solution
        used = solution.used
        dof = int(np.isfinite(problem.z[used]).sum())
        return UpdateReport(UpdateStatus.OK, "", observations.ids[used], observations.ids[~used], solution.nis, dof)

    @one_blas_thread
    @all_or_nothing
    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend.add`."""
        self._require_started("add")
        self._state.landmarks.require_new(observations.ids)
        if not len(observations):
            return
        h = self.rig.triangulate(observations.uv_left, observations.uv_right)  # paper A, Eq. (8)
        bad = ~np.isfinite(h).all(axis=1)
        if bad.any():
            raise MeasurementError(f"ekf: landmark {observations.ids[bad][0]} has no right pixel or no positive depth")
        self._measured = True
        h = h * np.minimum(1.0, self._farthest / h[:, 2:])
        self._state.place(observations.ids, h, self.rig.triangulation_covariance(h, self.models.pixel_sigma))

    @all_or_nothing
    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend.remove`."""
        ids = np.unique(np.asarray(ids, np.int64))
        self._state.remove(ids)

    @one_blas_thread
    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend.estimate`."""
        self._require_started("estimate")
        marks = self._state.landmarks
        slots = np.argsort(marks.ids) if landmarks else np.zeros(0, np.intp)
        D = marks.jacobian(slots)
        blocks = D @ self._state.covariance.of_landmarks(slots)[0] @ D.transpose(0, 2, 1)
        return Estimate(
            self._stamps[-1], self._poses[-1].copy(), self._state.pose_covariance(),
            marks.ids[slots], marks.points[slots], 0.5 * (blocks + blocks.transpose(0, 2, 1)),
        )  # fmt: skip

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend.positions`."""
        return self._state.landmarks.points[self._state.landmarks.slots(ids)]

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend.trajectory`: what was believed at each stamp, never revised."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))

    # --- a map that is known (documented in slam.interfaces.MapBackend) ---

    @one_blas_thread
    @all_or_nothing
    def insert(self, ids: IdArray, positions: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.insert`."""
        require_known("ekf", ids, positions, covariances)
        self._state.landmarks.require_new(ids)
        if len(ids):
            none = np.zeros((len(ids), 3, POSE))
            self._state.append(ids, distant_anchors(positions, covariances), positions, none, covariances)

    @one_blas_thread
    @all_or_nothing
    def place(self, ids: IdArray, local: Array, covariances: Array) -> None:
        """See `slam.interfaces.MapBackend.place`."""
        self._require_started("place")
        require_known("ekf", ids, local, covariances)
        require_in_front("ekf", ids, local)
        self._state.landmarks.require_new(ids)
        if len(ids):
            self._measured = True
            self._state.place(ids, local, covariances)

    # --- measurements that are mended (documented in slam.interfaces.RevisingBackend) ---

    revises_path = False

    def revise(self, correct: Callable[[Array], Array]) -> None:
        """See `slam.interfaces.RevisingBackend.revise`: landmarks in view move to where they are seen at from now on.

        The measurements are gone; what they made of the path stays. But landmarks that were placed by pixels as they
        were corrected before, and seen at pixels as they are now, would look as if the camera had moved.
        """
        self._measured = True
        marks, rectified_rig = self._state.landmarks, self.rig.rectified
        if not len(marks) or not self._poses:
            return
        T = self._poses[-1] @ rectified_rig.T_left_rectified
        z, _ = rectified_rig.rig.project_stereo(se3.transform(se3.inverse(T), marks.points), jacobian=False)
        rows = np.flatnonzero(rectified_rig.rig.left.in_image(z[:, :2]))
        z = correct(z[rows])
        if not np.isfinite(z).all():
            raise MeasurementError("ekf: a mended measurement is not finite")
        points = se3.transform(T, rectified_rig.rig.triangulate(z[:, :2], z[:, [2, 1]]))
        good = np.isfinite(points).all(axis=1)
        change = np.zeros_like(marks.state)
        rows, points = rows[good], points[good]
        change[rows] = marks.coordinates.of(marks.anchors[rows], points) - marks.state[rows]
        if np.isfinite(change).all():
            marks.move(change)

    # --- the filter's parts ---

    def _prediction(self) -> Prediction:
        """Pose, and what is in the angle of view (paper A, Fig. 3) with its innovation covariance."""
        T, covariance, marks = self._poses[-1].copy(), self._state.covariance, self._state.landmarks
        R = T[:3, :3]
        h = (marks.points - T[:3, 3]) @ R
        slots = np.flatnonzero(self.rig.left.in_view(h))
        h = h[slots]
        z, J = self.rig.project_stereo(h)
        right = z[:, [2, 1]] if self.rig.is_rectified else self.rig.project(h)[1]
        line = chained(z[:, :2], J[:, :2], h, R, self._state.camera[3:6], marks.jacobian(slots))
        blocks, cross = covariance.of_landmarks(slots)
        S = with_noise(innovation_covariances(line, covariance.pose, cross, blocks), self.models.pixel_sigma)
        return Prediction(self._stamps[-1], T, self._state.pose_covariance(), marks.ids[slots], line.z, right, S)

    def _problem(self, observations: Observations, slots: IndexArray, guess: Array | None) -> Problem:
        """The update in the coordinates [r, φ, measured landmarks]."""
        z = np.concatenate([observations.uv_left, observations.uv_right[:, :1]], axis=1)
        if self.config.measurement == "left":
            z[:, 2] = np.nan
        state, marks = self._state, self._state.landmarks
        prior = np.concatenate([state.camera[:POSE], marks.state[slots].reshape(-1)])
        model = StereoMeasurement(self.rig, state.R_world_angles, marks.coordinates, marks.anchors[slots])
        return Problem(
            prior, state.covariance.marginal(slots), z, self.models.pixel_sigma, model,
            self.config.iterations, self.models.gate_probability,
            None if guess is None else state.change_to(guess),
            partial(state.gauge_jacobian, slots) if state.consistent else None,
        )  # fmt: skip

    def _inflated_noises(self) -> list[Array]:
        """Motion noises (12, 12) of the last step, inflated."""
        if len(self._stamps) < 2:
            return []
        noise = motion_noise(self.models, self._stamps[-1] - self._stamps[-2])
        return [factor**2 * noise for factor in INFLATION]

    def _landmarks_pose(self, problem: Problem, slots: IndexArray) -> Array | None:
        """The change of [r, φ] (6,) to the pose on which most of the landmarks agree, if there is one."""
        T = self._state.pose() if problem.guess is None else self._state.pose_after(problem.guess)
        points = self._state.landmarks.points[slots]
        T_world_left = landmarks_pose(self.rig, points, problem.z, self.models, T, len(self._stamps))
        return None if T_world_left is None else self._state.change_to(T_world_left)

    def _require_started(self, what: str) -> None:
        if not self._stamps:
            raise MeasurementError(f"ekf: {what} before the first predict")
