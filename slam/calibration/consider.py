"""The rig's uncertainty in poses and landmarks: how the estimate depends on the rig's parameters (Schmidt, 1966).

A back end takes the rig for exact. The rig's remaining error acts on all frames alike, so it does not average out as
pixel noise does. With δ the error of the applied correction and ``Σ`` its covariance, poses and landmarks are

    T_true = T exp(J δ),    y_true = y + L δ,

and their covariances grow by ``J Σ Jᵀ`` and ``L Σ Lᵀ``: δ is considered, but not estimated by the back end. A filter of
its own computes J and L from the measurements (`slam.calibration.sensitivity`). To bound its cost, it tracks a random
choice of `_FOLLOWED` recently measured landmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slam.calibration.model import RigModel
from slam.calibration.sensitivity import InactiveLandmarks, SensitivityState
from slam.data import Estimate
from slam.geometry.arrays import Array, IdArray, isin
from slam.geometry.se3 import adjoint, inverse, points_by_pose, transform
from slam.models import EstimatorModels

#: Standard deviation of the baseline's length, as a share of it: the squares of a calibration board are known to some
#: tenths of a percent. It scales the whole world, so images never show it.
BASELINE = 0.002

_FOLLOWED = 60  # cost: most landmarks in the filter
_UNSEEN = 3  # cost: frames without a measurement after which a landmark leaves the filter
_EVERY = 0.08  # cost: least time between the filter's updates [s]; frames in between show nearly the same
_LONGEST = 1.0  # guard: time [s] after which a motion counts as unknown


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
    """

    def __init__(self, model: RigModel, models: EstimatorModels, applied: Array) -> None:
        self._model = model
        self._motion = models.motion
        self.kept, self._applied = applied, applied
        self._noise = models.pixel_sigma**2 * np.array([[1.0, 0, 1], [0, 1, 0], [1, 0, 2]])  # of (x, y, d)
        self._columns = len(model.names) + 2
        self._stamp = self._measured = 0.0
        self._followed: SensitivityState | None = None
        self._others = InactiveLandmarks.none(self._columns)
        self._root: tuple[Array, Array] | None = None  # of the last covariance, which is asked for thrice in a frame

    def observe(self, T_world_left: Array, stamp: float, ids: IdArray, positions: Array) -> None:
        """Take in a frame.

        Args:
            T_world_left: the estimated pose (4, 4).
            stamp: its time [s].
            ids: landmarks that measured it (M,).
            positions: their estimated positions (M, 3) [m] in world coordinates.
        """
        T = T_world_left @ self._model.rig.rectified.T_left_rectified
        before, others = self._followed, self._others
        if before is None:
            self._followed, self._stamp, self._measured = SensitivityState.start(T, self._columns), stamp, stamp
            return
        local = transform(inverse(T), positions)
        front = local[:, 2] > 0
        ids, local, positions = ids[front], local[front], positions[front]
        lately = before.ids[(before.unseen < _UNSEEN) | isin(before.ids, ids)]
        rows = np.flatnonzero(isin(ids, others.ids))
        wanted = _chosen(np.concatenate([lately, ids[rows]]))
        now, others = self._exchanged(before, others, wanted)
        rows = rows[isin(ids[rows], wanted)]
        if len(rows):  # before the motion, whose error they share with the whole state
            again = np.searchsorted(others.ids, ids[rows])
            now = now.seen_again(others.select(again), transform(inverse(now.T_world), positions[rows]))
            others = others.select(np.delete(np.arange(len(others.ids)), again))
        now = now.moved(T, *self._motion_sigmas(stamp - self._stamp))
        place = {i: row for row, i in enumerate(now.ids.tolist())}
        rows = np.array([place.get(i, -1) for i in ids.tolist()], np.intp)
        rows, points = rows[rows >= 0], local[rows >= 0]
        due = abs(stamp - self._measured) >= _EVERY
        if due and len(rows):
            now = now.measured(rows, points, self._by_point(points), self._field(points), self._noise)
        else:
            now = now.met(rows, points)
        # In one statement, so that an interrupt finds all of it done or nothing.
        self._followed, self._others, self._stamp, self._measured = (
            now, others, stamp, stamp if due else self._measured,
        )  # fmt: skip

    def change(self, ids: IdArray, positions: Array, erased: IdArray) -> None:
        """Take in new landmarks (M,) at `positions` (M, 3) [m], seen from the present pose, and drop erased ones."""
        if not len(ids) and not len(erased):
            return
        now, others = self._without(erased)
        new = ~isin(ids, np.concatenate([now.ids, others.ids, erased]))
        if new.any():
            ids, local = ids[new], transform(inverse(now.T_world), positions[new])
            wanted = _chosen(np.concatenate([now.ids, ids]))
            now, others = self._exchanged(now, others, wanted)
            H, field, chosen = self._by_point(local), self._field(local), isin(ids, wanted)
            rest = now.seen_once(ids[~chosen], local[~chosen], H[~chosen], field[~chosen], self._noise)
            now = now.first_seen(ids[chosen], local[chosen], H[chosen], field[chosen], self._noise)
            others = others.joined(rest)
        self._followed, self._others = now, others

    def replace_landmarks(self, ids: IdArray, positions: Array) -> None:
        """Take in landmarks (M,) at `positions` (M, 3) [m] as new ones, replacing their former state."""
        self.change(ids[:0], positions[:0], ids)
        self.change(ids, positions, ids[:0])

    def keep(self, ids: IdArray) -> None:
        """Forget all landmarks but these (M,)."""
        if self._followed is not None:
            known = np.concatenate([self._followed.ids, self._others.ids])
            self._followed, self._others = self._without(np.setdiff1d(known, ids))

    def path_follows(self, applied: Array) -> None:
        """The correction becomes `applied` (n,), and the path was revised accordingly."""
        self._applied = applied

    def path_keeps(self, applied: Array, positions: Callable[[IdArray], Array], landmarks_follow: bool) -> None:
        """The correction becomes `applied` (n,), but the path was not revised.

        Args:
            applied: the parameters.
            positions: returns the positions (M, 3) [m] of landmarks by their ids (M,).
            landmarks_follow: the landmarks move to where the new correction places them from the present pose.
        """
        step, now, others = applied - self._applied, self._followed, self._others
        if now is not None and step.any():
            followed, old = now.by_rig.copy(), others.by_rig.copy()
            followed[:6, -1] += followed[:6, :-2] @ step
            if not landmarks_follow:
                followed[6:, -1] += followed[6:, :-2] @ step
                old[:, :, -1] += old[:, :, :-2] @ step
            else:
                followed[6:, -1] = 0.0
                if len(others.ids):
                    local = transform(inverse(now.T_world), positions(others.ids))
                    old[:, :, -1] = -(points_by_pose(local) @ followed[:6, -1]) @ now.T_world[:3, :3].T
            now, others = replace(now, by_rig=followed), replace(others, by_rig=old)
        # In one statement, so that an interrupt finds all of it done or nothing.
        self._followed, self._others, self.kept, self._applied = now, others, self.kept + step, applied

    def added_to(self, estimate: Estimate, covariance: Array) -> Estimate:
        """An estimate with the rig's uncertainty in its covariances; `covariance` (n, n) is that of the parameters."""
        factor = self._factor(covariance)
        J = self._by_left_camera() @ factor
        positions = estimate.covariances
        ids, by_rig = self.landmarks()
        if len(estimate.ids) and len(ids):
            rows = np.searchsorted(ids, estimate.ids).clip(0, len(ids) - 1)
            known = ids[rows] == estimate.ids
            L = by_rig[rows[known]] @ factor
            positions = positions.copy()
            positions[known] += L @ np.swapaxes(L, 1, 2)
        return replace(estimate, covariance=estimate.covariance + J @ J.T, covariances=positions)

    def shared(self, covariance: Array, kept: Array) -> tuple[Array, Array]:
        """The error that this pose shares with those of other frames, as factors.

        The covariance that `added_to` adds to the pose is ``J S Sᵀ Jᵀ``. Poses of several frames have the common errors
        ``J₁ S c``, ``J₂ S c``, …, with the same c of unit variance, where S is of the last frame.

        Args:
            covariance: of the parameters (n, n).
            kept: the correction (n,) that the path was made with, after all changes told to `path_keeps`.

        Returns:
            J (6, n + 2), in the axes of the left camera, and S (n + 2, n + 2).
        """
        J = self._by_left_camera()
        J[:, -1] -= J[:, :-2] @ kept
        known = np.concatenate([kept, [0.0, 1.0]])
        return J, np.column_stack([self._factor(covariance)[:, :-1], known])

    @property
    def pose(self) -> Array:
        """Derivative of the pose (6, n + 2) in the axes of the rectified left camera."""
        return np.zeros((6, self._columns)) if self._followed is None else self._followed.by_rig[:6]

    def landmarks(self) -> tuple[IdArray, Array]:
        """Ids (N,), ascending, and derivatives (N, 3, n + 2) of their positions in world coordinates."""
        now = self._followed
        if now is None:
            return self._others.ids, self._others.by_rig
        ids = np.concatenate([now.ids, self._others.ids])
        order = np.argsort(ids, kind="stable")
        return ids[order], np.concatenate([now.in_world(), self._others.by_rig])[order]

    def _by_left_camera(self) -> Array:
        """Derivative of the pose (6, n + 2) in the axes of the left camera."""
        return adjoint(self._model.rig.rectified.T_left_rectified) @ self.pose

    def _factor(self, covariance: Array) -> Array:
        """Square root (n + 2, n + 2) of the covariance of parameters (n, n), baseline and unit column.

        It is the symmetric root, so that its columns mean the same in all frames.
        """
        if self._root is not None and np.array_equal(self._root[0], covariance):
            return self._root[1]
        n = self._columns
        factor = np.zeros((n, n))
        values, vectors = np.linalg.eigh(covariance)
        factor[:-2, :-2] = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
        factor[-2, -2], factor[-1, -1] = BASELINE, 1.0
        self._root = covariance, factor
        return factor

    def _motion_sigmas(self, dt: float) -> tuple[float, float]:
        """Prior standard deviations of a motion [rad], [m]: twice the velocity's change."""
        v, w = np.sqrt(self._motion.velocity_variance(min(abs(dt), _LONGEST)))
        return 2 * float(w) * min(abs(dt), _LONGEST), 2 * float(v) * min(abs(dt), _LONGEST)

    def _without(self, erased: IdArray) -> tuple[SensitivityState, InactiveLandmarks]:
        """The filter's state and the frozen landmarks, without the erased ones."""
        assert self._followed is not None
        now, others = self._followed, self._others
        if not len(erased):
            return now, others
        return now.select(np.flatnonzero(~isin(now.ids, erased))), others.select(~isin(others.ids, erased))

    def _exchanged(
        self, now: SensitivityState, others: InactiveLandmarks, wanted: IdArray
    ) -> tuple[SensitivityState, InactiveLandmarks]:
        """Move landmarks that are not `wanted` any more from the filter's state to the frozen ones."""
        stays = isin(now.ids, wanted)
        if stays.all():
            return now, others
        leaving = now.select(np.flatnonzero(~stays)).frozen()
        return now.select(np.flatnonzero(stays)), others.joined(leaving)

    def _field(self, local: Array) -> Array:
        """∂(x, y, d)/∂δ (M, 3, m) [px] at points (M, 3) [m]; the corrected pixels are those of an ideal rig."""
        points = self._pixels(local)
        out = np.zeros((len(local), 3, self._columns))
        out[:, :, :-2] = self._model.field(points)
        out[:, 2, -2] = -points[:, 2]  # with a longer baseline, the nominal one's disparity is smaller
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


def _chosen(ids: IdArray) -> IdArray:
    """At most `_FOLLOWED` of some landmarks (N,): a pseudo-random choice, the same each time."""
    if len(ids) <= _FOLLOWED:
        return ids
    # Knuth's multiplicative hash, which is injective for ids below 2³².
    drawn = (ids.astype(np.uint64) * np.uint64(2654435761)) % np.uint64(2**32)
    return ids[np.lexsort((ids, drawn))[:_FOLLOWED]]
