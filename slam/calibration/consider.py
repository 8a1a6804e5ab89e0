"""The rig's uncertainty in poses and landmarks: how the estimate depends on the rig's parameters (Schmidt, 1966).

A back end takes the rig for exact. The rig's remaining error acts on all frames alike, so it does not average out as
pixel noise does. With δ the error of the applied correction and ``Σ`` its covariance, poses and landmarks are

    T_true = T exp(J δ),    y_true = y + L δ,

and their covariances grow by ``J Σ Jᵀ`` and ``L Σ Lᵀ``: δ is considered, but not estimated by the back end. J and L
follow from what was measured, whichever back end estimates. A landmark's h = Rᵀ (y − t) changes by ``B J δ + Rᵀ L δ``
with ``B = [[h]ₓ, −1]``, and its pixels are displaced by ``F δ``; so each frame is one least-squares problem for J,

    F ≈ H B J + H Rᵀ L,    weighted by (N + H Rᵀ P R Hᵀ)⁻¹,

with N the pixel noise and P a landmark's covariance where all poses are known. Then each L and P is updated by its own
measurement, J given: the gain of least squares over all poses and landmarks, but for what the landmarks have in common.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slam.calibration.correction import Revision
from slam.calibration.estimator import SelfCalibration
from slam.calibration.model import RigModel
from slam.data import Estimate
from slam.geometry.arrays import Array, IdArray, IndexArray, isin
from slam.geometry.se3 import adjoint, inverse, points_by_pose, transform
from slam.interfaces import Backend, RevisingBackend
from slam.models import EstimatorModels
from slam.rig_error import CommonError
from slam.table import LandmarkRows

#: Standard deviation of the baseline's length, as a share of it: the squares of a calibration board are known to some
#: tenths of a percent. It scales the whole world, so images never show it.
BASELINE = 0.002
#: Change of the correction, in standard deviations of the disparities' error, for a back end to revise its past.
_SIGNIFICANT = 0.5


@dataclass(frozen=True, eq=False)
class LandmarkSensitivities(LandmarkRows):
    """How landmarks depend on m errors of the rig, and what is known of them beside these."""

    by_rig: Array  # L (N, 3, m), in world coordinates
    own: Array  # P (N, 3, 3), in world axes [m²]


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """How the pose and the landmarks depend on m errors of the rig, and what is known of them beside these."""

    T_world: Array  # the estimated pose of the rectified left camera (4, 4)
    pose: Array  # J (6, m)
    covariance: Array  # of the pose where the landmarks are known (6, 6)
    landmarks: LandmarkSensitivities

    @classmethod
    def start(cls, T_world: Array, m: int) -> Sensitivities:
        """The first pose defines the world; no landmark is known."""
        none = LandmarkSensitivities(np.zeros(0, np.int64), np.zeros((0, 3, m)), np.zeros((0, 3, 3)))
        return cls(T_world, np.zeros((6, m)), np.zeros((6, 6)), none)

    def moved(self, T_world: Array, rotation: float, translation: float) -> Sensitivities:
        """At the next pose (4, 4), with the prior standard deviations of the motion [rad], [m]."""
        A = adjoint(inverse(T_world) @ self.T_world)
        C = A @ self.covariance @ A.T + np.diag(np.repeat(np.square([rotation, translation]), 3))
        return replace(self, T_world=T_world, pose=A @ self.pose, covariance=C)

    def measured(self, rows: IndexArray, local: Array, H: Array, field: Array, noise: Array) -> Sensitivities:
        """After measurements of landmarks.

        Args:
            rows: of the landmarks (M,).
            local: their estimated positions (M, 3) [m] in the camera's coordinates.
            H: ∂z/∂h of the measurements z (M, 3, 3).
            field: F = ∂z/∂δ (M, 3, m).
            noise: covariance of a measurement (3, 3).
        """
        by_pose, by_point, P = H @ points_by_pose(local), H @ self.T_world[:3, :3].T, self.landmarks.own[rows]
        PG = P @ np.swapaxes(by_point, 1, 2)
        W = np.linalg.inv(by_point @ PG + noise)
        rest = field - by_point @ self.landmarks.by_rig[rows]
        AW = (np.swapaxes(by_pose, 1, 2) @ W).transpose(1, 0, 2).reshape(6, -1)
        before = np.linalg.inv(self.covariance)
        C = np.linalg.inv(before + AW @ by_pose.reshape(-1, 6))
        C = 0.5 * (C + C.T)
        J = C @ (before @ self.pose + AW @ rest.reshape(AW.shape[1], -1))
        gain = PG @ W
        by_rig, own = self.landmarks.by_rig.copy(), self.landmarks.own.copy()
        by_rig[rows] += gain @ (rest - by_pose @ J)
        own[rows] -= gain @ np.swapaxes(PG, 1, 2)
        return replace(self, pose=J, covariance=C, landmarks=replace(self.landmarks, by_rig=by_rig, own=own))

    def with_new(self, ids: IdArray, local: Array, H: Array, field: Array, noise: Array) -> Sensitivities:
        """With landmarks (K,) at `local` (K, 3) [m] first seen from this pose; other arguments as in `measured`."""
        back = self.T_world[:3, :3] @ np.linalg.inv(H)
        L = back @ field - self.T_world[:3, :3] @ points_by_pose(local) @ self.pose
        new = LandmarkSensitivities(ids, L, back @ noise @ np.swapaxes(back, 1, 2))
        return replace(self, landmarks=self.landmarks.joined(new))

    def without(self, gone: np.ndarray) -> Sensitivities:
        """Without some landmarks (N,)."""
        return replace(self, landmarks=self.landmarks.select(~gone))


class SchmidtFilter:
    """What the rig's uncertainty adds to the covariances of poses and landmarks.

    Columns of all sensitivities are the parameters of `RigModel`, the baseline's length (a share), and one column of
    unit variance: the error that changes of the correction have left in a back end that cannot revise its past.

    Args:
        model: the rig's parameters.
        models: noise of the pixels, and of the motion.
        applied: the correction (n,) that the path begins with.

    Attributes:
        kept: the correction (n,) with which the path was made, after all changes told to `path_keeps`.
        applied: the correction (n,) of the measurements.
    """

    def __init__(self, model: RigModel, models: EstimatorModels, applied: Array) -> None:
        self._model, self._motion = model, models.motion
        self.kept = self.applied = applied
        self._noise = models.pixel_sigma**2 * np.array([[1.0, 0, 1], [0, 1, 0], [1, 0, 2]])  # of (x, y, d)
        self._columns = len(model.names) + 2
        self._stamp: float | None = None
        self._now = Sensitivities.start(np.eye(4), self._columns)
        self._root: tuple[Array, Array] | None = None  # of the last covariance, which is asked for thrice in a frame

    def observe(self, T_world_left: Array, stamp: float, ids: IdArray, positions: Array) -> None:
        """Take in a frame.

        Args:
            T_world_left: the estimated pose (4, 4).
            stamp: its time [s].
            ids: landmarks that measured it (M,).
            positions: their estimated positions (M, 3) [m] in world coordinates.
        """
        T, now = T_world_left, self._now
        if self._stamp is None:
            now = Sensitivities.start(T, self._columns)
        else:
            now = now.moved(T, *self._motion_sigmas(stamp - self._stamp))
            local = transform(inverse(T), positions)
            good = (local[:, 2] > 0) & isin(ids, now.landmarks.ids)
            if good.any():
                now = now.measured(now.landmarks.rows_of(ids[good]), local[good], *self._sight(local[good]))
        self._now, self._stamp = now, stamp  # one statement, so that an interrupt finds all of it done or nothing

    def change(self, ids: IdArray, positions: Array, erased: IdArray) -> None:
        """Take in new landmarks (M,) at `positions` (M, 3) [m], seen from the present pose, and drop erased ones.

        Those that are there already stay as they are.
        """
        now = self._now.without(isin(self._now.landmarks.ids, erased))
        new = ~isin(ids, np.concatenate([now.landmarks.ids, erased]))
        if new.any():
            local = transform(inverse(now.T_world), positions[new])
            now = now.with_new(ids[new], local, *self._sight(local))
        self._now = now

    def keep(self, ids: IdArray) -> None:
        """Forget all landmarks but these (M,)."""
        self._now = self._now.without(~isin(self._now.landmarks.ids, ids))

    def path_keeps(self, applied: Array, positions: Callable[[IdArray], Array], landmarks_follow: bool) -> None:
        """The correction becomes `applied` (n,), but the path was not revised.

        Args:
            applied: the parameters.
            positions: returns the positions (M, 3) [m] of landmarks by their ids (M,).
            landmarks_follow: the landmarks move to where the new correction places them from the present pose.
        """
        step, now = applied - self.applied, self._now
        if step.any():
            pose, marks, by_rig = now.pose.copy(), now.landmarks, now.landmarks.by_rig.copy()
            pose[:, -1] += pose[:, :-2] @ step
            if not landmarks_follow:
                by_rig[:, :, -1] += by_rig[:, :, :-2] @ step
            elif len(marks):
                local = transform(inverse(now.T_world), positions(marks.ids))
                by_rig[:, :, -1] = -(points_by_pose(local) @ pose[:, -1]) @ now.T_world[:3, :3].T
            now = replace(now, pose=pose, landmarks=replace(marks, by_rig=by_rig))
        # In one statement, so that an interrupt finds all of it done or nothing.
        self._now, self.kept, self.applied = now, self.kept + step, applied

    def added_to(self, estimate: Estimate, covariance: Array) -> Estimate:
        """An estimate with the rig's uncertainty in its covariances; `covariance` (n, n) is that of the parameters."""
        factor, marks, positions = self._factor(covariance), self._now.landmarks, estimate.covariances
        J, known = self.pose @ factor, isin(estimate.ids, marks.ids)
        if known.any():
            L = marks.by_rig[marks.rows_of(estimate.ids[known])] @ factor
            positions = positions.copy()
            positions[known] += L @ np.swapaxes(L, 1, 2)
        return replace(estimate, covariance=estimate.covariance + J @ J.T, covariances=positions)

    def shared(self, covariance: Array, kept: Array) -> CommonError:
        """The error that this pose shares with those of other frames.

        The covariance that `added_to` adds to the pose is ``J S Sᵀ Jᵀ``. Poses of several frames have the common errors
        ``J₁ S c``, ``J₂ S c``, …, with the same c of unit variance, where S is of the last frame.

        Args:
            covariance: of the parameters (n, n).
            kept: the correction (n,) that the path was made with, after all changes told to `path_keeps`.
        """
        J = self.pose.copy()
        J[:, -1] -= J[:, :-2] @ kept
        known = np.concatenate([kept, [0.0, 1.0]])
        return CommonError(J, np.column_stack([self._factor(covariance)[:, :-1], known]))

    @property
    def pose(self) -> Array:
        """Derivative of the pose (6, n + 2) in the axes of the rectified left camera."""
        return self._now.pose

    @property
    def landmarks(self) -> LandmarkSensitivities:
        """Those of landmarks."""
        return self._now.landmarks

    def _factor(self, covariance: Array) -> Array:
        """Square root (n + 2, n + 2) of the covariance of parameters (n, n), baseline and unit column.

        It is the symmetric root, so that its columns mean the same in all frames.
        """
        if self._root is None or not np.array_equal(self._root[0], covariance):
            values, vectors = np.linalg.eigh(covariance)
            factor = np.diag([*np.zeros(len(values)), BASELINE, 1.0])
            factor[:-2, :-2] = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
            self._root = covariance, factor
        return self._root[1]

    def _motion_sigmas(self, dt: float) -> tuple[float, float]:
        """Prior standard deviations of a motion [rad], [m]: twice the velocity's change."""
        dt = min(abs(dt), 1.0)  # 1.0: time [s] after which a motion counts as unknown
        v, w = 2 * dt * np.sqrt(self._motion.velocity_variance(dt))
        # 1e-9: of a motion's standard deviations [rad], [m]; with none there is no information matrix
        return max(float(w), 1e-9), max(float(v), 1e-9)

    def _sight(self, local: Array) -> tuple[Array, Array, Array]:
        """Of z = (x, y, d) [px] of points (M, 3) [m]: ∂z/∂h (M, 3, 3), ∂z/∂δ (M, 3, m), and the noise (3, 3).

        The corrected pixels are those of an ideal rig.
        """
        f, depth = self._model.focal, local[:, 2:]
        points = np.column_stack([local[:, :2], np.full(len(local), self._model.rig.baseline)]) * (f / depth)
        H = np.zeros((len(local), 3, 3))
        H[:, 0, 0] = H[:, 1, 1] = f / depth[:, 0]
        H[:, :, 2] = -points / depth
        field = np.zeros((len(local), 3, self._columns))
        field[:, :, :-2] = self._model.field(points)
        field[:, 2, -2] = -points[:, 2]  # with a longer baseline, the nominal one's disparity is smaller
        return H, field, self._noise


class RemainingRigError:
    """The rig's error that is left in a back end's estimate while self-calibration continues.

    Args:
        calibration: the self-calibration.
        models: noise of the pixels, and of the motion.

    Attributes:
        uncertainty: what the rig's uncertainty adds to the covariances of poses and landmarks.
        measured_with: the correction of all measurements given to the back end.
    """

    def __init__(self, calibration: SelfCalibration, models: EstimatorModels) -> None:
        self._calibration, self.measured_with = calibration, calibration.applied
        self.uncertainty = SchmidtFilter(calibration.model, models, self.measured_with.parameters)

    def apply(self, backend: Backend) -> Revision | None:
        """Correct features by the present posterior from now on; returns the change, or None.

        For a back end that can revise, a change means processing all its measurements again, so it waits until the
        change is significant.
        """
        return self._calibration.apply(_SIGNIFICANT if isinstance(backend, RevisingBackend) else 0.0)

    def revise(self, backend: Backend, restarted: bool) -> Revision | None:
        """Correct a back end's earlier measurements, if it can revise them; returns the change, or None.

        Args:
            backend: the present one.
            restarted: part of the path is an earlier back end's and cannot be revised.
        """
        applied, reviser = self._calibration.applied, backend if isinstance(backend, RevisingBackend) else None
        if not restarted and reviser is not None and reviser.revises_path:
            self.uncertainty.applied = applied.parameters
        else:
            self.uncertainty.path_keeps(applied.parameters, backend.positions, landmarks_follow=reviser is not None)
        if reviser is None or applied is self.measured_with:
            return None
        revision = Revision(self.measured_with, applied)
        reviser.revise(revision.rows)
        self.measured_with = revision.after
        return revision

    def added_to(self, estimate: Estimate) -> Estimate:
        """The back end's estimate with the rig's uncertainty added."""
        if not self._calibration.config.enabled:
            return estimate
        return self.uncertainty.added_to(estimate, self._calibration.covariance)

    def common(self, as_reported: bool) -> CommonError:
        """The part of the pose's error that it shares with those of other frames.

        Args:
            as_reported: for poses as reported in each frame, with the correction of that time; else for the present
                path, in which a back end may have revised earlier poses.
        """
        if not self._calibration.config.enabled:
            return CommonError()
        made_with = self._calibration.applied.parameters if as_reported else self.uncertainty.kept
        return self.uncertainty.shared(self._calibration.covariance, made_with)
