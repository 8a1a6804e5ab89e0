"""The rig's uncertainty in poses and landmarks: how the estimate depends on the rig's parameters (Schmidt, 1966).

A back end takes the rig for exact. What is left of the rig's error acts on all frames alike, so it does not average out
as pixel noise does. With δ the error of the applied correction and ``Σ`` its covariance, poses and landmarks are

    T_true = T exp(J δ),    y_true = y + L δ,

and their covariances grow by ``J Σ Jᵀ`` and ``L Σ Lᵀ``: δ is considered, but not estimated by the back end. J follows
in every frame from the landmarks that measured the pose: pixels that an ideal rig would have measured, ``z + F δ``, see
landmarks that are displaced by L δ,

    H (Rᵀ L + [h]ₓ J_ω − J_ρ) = F,

which is solved for J by weighted least squares. A new landmark has ``L = R (H⁻¹ F − [h]ₓ J_ω + J_ρ)``. Where old
landmarks are measured again, J goes back to what it was when they were first seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slam.calibration.model import RigModel
from slam.data import Estimate
from slam.geometry.arrays import Array, IdArray
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.se3 import adjoint, inverse, points_by_pose, transform

#: Standard deviation of the baseline's length, as a share of it. It scales the whole world, so images never show it:
#: the squares of a calibration board are known to some tenths of a percent.
BASELINE = 0.002


@dataclass(frozen=True)
class _Landmarks:
    """Sensitivities of landmarks, a row each, ids ascending.

    Attributes:
        ids: (N,).
        by_rig: ∂y/∂δ (N, 3, m).
        covariance: of the position by pixel noise at first sight (N, 3, 3) [m²], relative to the camera.
        seen: number of frames that measured it (N,).
    """

    ids: IdArray
    by_rig: Array
    covariance: Array
    seen: IdArray

    @classmethod
    def none(cls, columns: int) -> _Landmarks:
        return cls(np.zeros(0, np.int64), np.zeros((0, 3, columns)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))

    def select(self, rows: np.ndarray) -> _Landmarks:
        return _Landmarks(self.ids[rows], self.by_rig[rows], self.covariance[rows], self.seen[rows])


class RigUncertainty:
    """What the rig's uncertainty adds to the covariances of poses and landmarks.

    Columns of all sensitivities are the parameters of `RigModel`, the baseline's length (a share), and one column of
    unit variance: what earlier corrections, that are known by now, have left in a back end that cannot revise.

    Args:
        model: the rig's parameters.
        pixel_sigma: noise of uL, vL, uR [px].
        applied: the correction (n,) that the path begins with.

    Attributes:
        kept: the correction (n,) that the path was made with, as far as changes of it are in the covariance.
    """

    def __init__(self, model: RigModel, pixel_sigma: float, applied: Array) -> None:
        self._model = model
        self.kept, self._applied = applied, applied
        self._noise = pixel_sigma**2 * np.array([[1.0, 0, 1], [0, 1, 0], [1, 0, 2]])  # of (x, y, d)
        self._columns = len(model.names) + 2
        self._T_world: Array | None = None
        self._pose: Array = np.zeros((6, self._columns))
        self._landmarks = _Landmarks.none(self._columns)

    def observe(self, T_world_left: Array, ids: IdArray, positions: Array) -> None:
        """Take in a frame.

        Args:
            T_world_left: the estimated pose (4, 4).
            ids: landmarks that measured it (M,).
            positions: their estimated positions (M, 3) [m] in world coordinates.
        """
        T = T_world_left @ self._model.rig.rectified.T_left_rectified
        if self._T_world is not None:
            self._pose = adjoint(inverse(T) @ self._T_world) @ self._pose
        self._T_world = T
        known = self._landmarks
        rows = np.searchsorted(known.ids, ids).clip(0, max(len(known.ids) - 1, 0))
        old = known.ids[rows] == ids if len(known.ids) else np.zeros(len(ids), bool)
        local = transform(inverse(T), positions[old])
        good = local[:, 2] > 0
        if good.sum() >= MINIMAL_POINTS:
            self._solve(T[:3, :3], local[good], known.select(rows[old][good]))
        seen = known.seen.copy()
        seen[rows[old]] += 1
        self._landmarks = replace(known, seen=seen)

    def change(self, ids: IdArray, positions: Array, erased: IdArray) -> None:
        """Take in new landmarks (M,) at `positions` (M, 3) [m], seen from the present pose, and drop erased ones."""
        assert self._T_world is not None
        if not len(ids) and not len(erased):
            return
        kept = self._landmarks.select(~np.isin(self._landmarks.ids, erased))
        new = ~np.isin(ids, np.concatenate([kept.ids, erased]))
        local = transform(inverse(self._T_world), positions[new])
        R = self._T_world[:3, :3]
        back = np.linalg.inv(self._by_point(local))
        by_rig = R @ (back @ self._field(local) - points_by_pose(local) @ self._pose)
        covariance = R @ back @ self._noise @ np.swapaxes(back, 1, 2) @ R.T
        both = _Landmarks(
            np.concatenate([kept.ids, ids[new]]),
            np.concatenate([kept.by_rig, by_rig]),
            np.concatenate([kept.covariance, covariance]),
            np.concatenate([kept.seen, np.ones(int(new.sum()), np.int64)]),
        )
        self._landmarks = both.select(np.argsort(both.ids, kind="stable"))

    def see_anew(self, ids: IdArray, positions: Array) -> None:
        """Take in landmarks (M,) at `positions` (M, 3) [m] as new ones: what they were before counts no more."""
        self.change(ids[:0], positions[:0], ids)
        self.change(ids, positions, ids[:0])

    def keep(self, ids: IdArray) -> None:
        """Forget all landmarks but these (M,)."""
        self._landmarks = self._landmarks.select(np.isin(self._landmarks.ids, ids))

    def path_follows(self, applied: Array) -> None:
        """The correction becomes `applied` (n,), and so does that of the path."""
        self._applied = applied

    def path_keeps(self, applied: Array, positions: Callable[[IdArray], Array], landmarks_follow: bool) -> None:
        """The correction becomes `applied` (n,), but the path stays as it is.

        Args:
            applied: the parameters.
            positions: gives the positions (M, 3) [m] of landmarks by their ids (M,).
            landmarks_follow: the landmarks move to where the new correction sees them from the present pose.
        """
        step, pose, marks = applied - self._applied, self._pose.copy(), self._landmarks
        if self._T_world is not None and step.any():
            by_rig = marks.by_rig.copy()
            pose[:, -1] += pose[:, :-2] @ step
            if not landmarks_follow:
                by_rig[:, :, -1] += by_rig[:, :, :-2] @ step
            elif len(marks.ids):
                local = transform(inverse(self._T_world), positions(marks.ids))
                by_rig[:, :, -1] = (-self._T_world[:3, :3] @ points_by_pose(local) @ pose[:, -1:])[:, :, 0]
            marks = replace(marks, by_rig=by_rig)
        # In one statement, so that an interrupt finds all of it done or nothing.
        self._pose, self._landmarks, self.kept, self._applied = pose, marks, self.kept + step, applied

    def added_to(self, estimate: Estimate, covariance: Array) -> Estimate:
        """An estimate with the rig's uncertainty in its covariances; `covariance` (n, n) is that of the parameters."""
        factor = self._factor(covariance)
        J = self._by_left_camera() @ factor
        positions = estimate.covariances
        if len(estimate.ids) and len(self._landmarks.ids):
            rows = np.searchsorted(self._landmarks.ids, estimate.ids).clip(0, len(self._landmarks.ids) - 1)
            known = self._landmarks.ids[rows] == estimate.ids
            L = self._landmarks.by_rig[rows[known]] @ factor
            positions = positions.copy()
            positions[known] += L @ np.swapaxes(L, 1, 2)
        return replace(estimate, covariance=estimate.covariance + J @ J.T, covariances=positions)

    def shared(self, covariance: Array, kept: Array) -> tuple[Array, Array, Array]:
        """What the errors of this pose and of those of other frames have in common, as factors.

        The covariance that `added_to` adds to the pose is ``J (S Sᵀ + k kᵀ) Jᵀ``. Poses of several frames have the
        common errors ``J₁ (S c + k)``, ``J₂ (S c + k)``, …, with the same c of unit variance, where S and k are of
        the last frame.

        Args:
            covariance: of the parameters (n, n).
            kept: the correction (n,) that the path was made with, after all changes told to `path_keeps`.

        Returns:
            J (6, n + 2), in the axes of the left camera, S (n + 2, n + 1) and k (n + 2,).
        """
        J = self._by_left_camera()
        J[:, -1] -= J[:, :-2] @ kept
        return J, self._factor(covariance)[:, :-1], np.concatenate([kept, [0.0, 1.0]])

    def _by_left_camera(self) -> Array:
        """Derivative of the pose (6, n + 2) in the axes of the left camera."""
        return adjoint(self._model.rig.rectified.T_left_rectified) @ self._pose

    def _factor(self, covariance: Array) -> Array:
        """A root (n + 2, n + 2) of the covariance of the parameters (n, n), of the baseline and of what was kept.

        It is the symmetric one: so its columns mean the same in all frames.
        """
        n = self._columns
        factor = np.zeros((n, n))
        values, vectors = np.linalg.eigh(covariance)
        factor[:-2, :-2] = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
        factor[-2, -2], factor[-1, -1] = BASELINE, 1.0
        return factor

    def _solve(self, R: Array, local: Array, landmarks: _Landmarks) -> None:
        """Sensitivity of the pose from landmarks at `local` (M, 3) [m] in the rectified left camera's coordinates."""
        H = self._by_point(local)
        A = H @ points_by_pose(local)
        b = self._field(local) - H @ (R.T @ landmarks.by_rig)
        P = R.T @ landmarks.covariance @ R / landmarks.seen[:, None, None]
        W = np.linalg.inv(self._noise + H @ P @ np.swapaxes(H, 1, 2))
        WA = W @ A
        normal = np.tensordot(A, WA, axes=((0, 1), (0, 1)))
        right = np.tensordot(WA, b, axes=((0, 1), (0, 1)))
        normal += 1e-9 * np.trace(normal) * np.eye(6)
        self._pose = np.asarray(np.linalg.solve(normal, right))

    def _field(self, local: Array) -> Array:
        """∂(x, y, d)/∂δ (M, 3, m) [px] at points (M, 3) [m]; the corrected pixels are those of an ideal rig."""
        points = self._pixels(local)
        out = np.zeros((len(local), 3, self._columns))
        out[:, :, :-2] = self._model.field(points)
        out[:, 2, -2] = -points[:, 2]  # a longer baseline makes the nominal one's disparity smaller
        return out

    def _pixels(self, local: Array) -> Array:
        scale = self._model.focal / local[:, 2:]
        return np.column_stack([local[:, :2] * scale, self._model.rig.baseline * scale])

    def _by_point(self, local: Array) -> Array:
        """∂(x, y, d)/∂h (M, 3, 3) [px/m] at points (M, 3) [m]."""
        x, y, d = self._pixels(local).T
        f, z, none = self._model.focal, local[:, 2], np.zeros(len(local))
        rows = [[f + none, none, -x], [none, f + none, -y], [none, none, -d]]
        return np.asarray(np.stack([np.stack(row, axis=1) for row in rows], axis=1) / z[:, None, None])
