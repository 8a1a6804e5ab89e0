"""Sensitivities of a pose and landmarks to parameters of the measurement, by a Kalman filter with a column for each.

Its state is the error of the pose and, in world axes, the errors of some landmarks relative to the camera:

    T_true = T exp(ξ),    h_true = h + Rᵀ l,    ξ = J δ,    l = S δ.

From frame to frame ``ξ ← Ad(M) ξ + ν`` and ``l ← l + R [[h]ₓ, −1] ν``, with M the estimated motion and ν its error
before anything is measured. The errors themselves are unknown; the filter computes J and S. Pixels displaced by ``F δ``
update them to ``J + K (F − H S)`` and ``S + K (F − H S)``. The gain K is that of the least-squares estimate of all
poses and landmarks from the same measurements, to which every good back end is close.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from slam.geometry.arrays import Array, IdArray, isin
from slam.geometry.se3 import adjoint, inverse, points_by_pose, transform

_ROUNDING = 1e-12  # numerics: of the trace of a covariance


@dataclass(frozen=True, eq=False)
class InactiveLandmarks:
    """Landmarks outside the filter's state, as they were when they left it; one row each, ids ascending.

    Attributes:
        ids: (N,).
        by_rig: ∂y/∂δ (N, 3, m), y in world coordinates.
        relative: covariance of the position relative to the camera (N, 3, 3) [m²], in world axes.
        drift: covariance of the pose's error at that time (N, 6, 6), as a motion of the world.
    """

    ids: IdArray
    by_rig: Array
    relative: Array
    drift: Array

    @classmethod
    def none(cls, columns: int) -> InactiveLandmarks:
        """No landmark, with so many parameters."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3, columns)), np.zeros((0, 3, 3)), np.zeros((0, 6, 6)))

    def select(self, rows: np.ndarray) -> InactiveLandmarks:
        """These rows."""
        return InactiveLandmarks(self.ids[rows], self.by_rig[rows], self.relative[rows], self.drift[rows])

    def joined(self, other: InactiveLandmarks) -> InactiveLandmarks:
        """Both together; landmarks in `other` replace those with the same id."""
        mine = self.select(~isin(self.ids, other.ids))
        pairs = [(getattr(mine, name), getattr(other, name)) for name in ("ids", "by_rig", "relative", "drift")]
        both = InactiveLandmarks(*(np.concatenate(pair) for pair in pairs))
        return both.select(np.argsort(both.ids, kind="stable"))


@dataclass(frozen=True, eq=False)
class SensitivityState:
    """The filter's state: the pose (six rows) and F recently measured landmarks (three rows each).

    Attributes:
        T_world: the estimated pose (4, 4).
        ids: of the landmarks (F,).
        local: their estimated positions (F, 3) [m] in the camera's coordinates.
        unseen: frames since each was measured (F,).
        by_rig: J and S (6 + 3 F, m), those of landmarks in world axes.
        covariance: of the errors by pixel noise (6 + 3 F, 6 + 3 F).
    """

    T_world: Array
    ids: IdArray
    local: Array
    unseen: IdArray
    by_rig: Array
    covariance: Array

    @classmethod
    def start(cls, T_world: Array, columns: int) -> SensitivityState:
        """The state at an exactly known pose, without landmarks."""
        none = np.zeros(0, np.int64)
        return cls(T_world, none, np.zeros((0, 3)), none, np.zeros((6, columns)), np.zeros((6, 6)))

    def moved(self, T_world: Array, rotation: float, translation: float) -> SensitivityState:
        """The state predicted at the next pose.

        Args:
            T_world: the next pose as estimated (4, 4).
            rotation: prior standard deviation of the motion's rotation [rad].
            translation: the same of its translation [m].
        """
        M = inverse(T_world) @ self.T_world
        local = transform(M, self.local)
        turned, by_rig, covariance = adjoint(M), self.by_rig.copy(), self.covariance.copy()
        by_rig[:6] = turned @ by_rig[:6]
        covariance[:6] = turned @ covariance[:6]
        covariance[:, :6] = covariance[:, :6] @ turned.T
        B = np.concatenate([np.eye(6), (T_world[:3, :3] @ points_by_pose(local)).reshape(-1, 6)])
        covariance += (B * np.repeat(np.square([rotation, translation]), 3)) @ B.T
        return SensitivityState(T_world, self.ids, local, self.unseen + 1, by_rig, covariance)

    def measured(self, rows: IdArray, local: Array, H: Array, field: Array, noise: Array) -> SensitivityState:
        """The state updated by measurements of landmarks.

        Args:
            rows: of the landmarks (M,).
            local: their present estimated positions (M, 3) [m] in the camera's coordinates.
            H: ∂z/∂h of the measurements z (M, 3, 3).
            field: F = ∂z/∂δ (M, 3, m).
            noise: covariance of a measurement (3, 3).
        """
        seen = self.met(rows, local)
        columns = 6 + 3 * rows[:, None] + np.arange(3)
        size, count, H = len(self.by_rig), 3 * len(rows), H @ self.T_world[:3, :3].T
        HC = (H @ self.covariance[columns]).reshape(count, size)
        innovation = (HC[:, columns][:, :, None] @ np.swapaxes(H, 1, 2)).reshape(count, count)
        _add_blocks(innovation, noise)
        innovation.reshape(-1)[:: count + 1] += _ROUNDING * innovation.trace()
        residual = (field - H @ self.by_rig[columns]).reshape(count, -1)
        root, info = dpotrf(innovation, lower=1)
        if info != 0:
            raise np.linalg.LinAlgError("the innovation covariance is not positive definite")
        whitened = dtrtrs(root, np.hstack([HC, residual]), lower=1)[0]
        gain, residual = whitened[:, :size], whitened[:, size:]
        by_rig, covariance = self.by_rig + gain.T @ residual, self.covariance - gain.T @ gain
        return replace(seen, by_rig=by_rig, covariance=covariance)

    def met(self, rows: IdArray, local: Array) -> SensitivityState:
        """The state after landmarks `rows` were seen but not used as measurements; `local` are their positions [m]."""
        everywhere, unseen = self.local.copy(), self.unseen.copy()
        everywhere[rows], unseen[rows] = local, 0
        return replace(self, local=everywhere, unseen=unseen)

    def select(self, rows: IdArray) -> SensitivityState:
        """The state with these landmarks only."""
        kept = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
        covariance = self.covariance.take(kept, axis=0).take(kept, axis=1)  # cost: a fifth of the time of np.ix_
        return SensitivityState(
            self.T_world, self.ids[rows], self.local[rows], self.unseen[rows], self.by_rig[kept], covariance
        )

    def first_seen(self, ids: IdArray, local: Array, H: Array, field: Array, noise: Array) -> SensitivityState:
        """The state with landmarks (K,) at `local` (K, 3) [m] first seen in this frame; other arguments: `measured`."""
        by_rig, own = self._by_sight(H, field, noise)
        size, places = 3 * len(ids), np.arange(len(ids))
        blocks = np.zeros((len(ids), 3, len(ids), 3))
        blocks[places, :, places] = own
        across = np.zeros((size, len(self.covariance)))
        return self._with(ids, local, by_rig.reshape(size, self.by_rig.shape[1]), across, blocks.reshape(size, size))

    def seen_once(self, ids: IdArray, local: Array, H: Array, field: Array, noise: Array) -> InactiveLandmarks:
        """Landmarks first seen in this frame, ids ascending, that do not enter the state."""
        by_rig, own = self._by_sight(H, field, noise)
        by_world = by_rig - self._by_pose(local) @ self.by_rig[:6]
        return InactiveLandmarks(ids, by_world, own, np.broadcast_to(self.drift(), (len(ids), 6, 6)))

    def seen_again(self, frozen: InactiveLandmarks, local: Array) -> SensitivityState:
        """The state with landmarks (K,) at `local` (K, 3) [m] that were in it before.

        Relative to the camera, each one's error is its former one plus the pose's drift since. The drift's covariance
        is D = C − C_then; given the present error ξ, the drift is ``D C⁻¹ ξ + ε``, with the same ε for all.
        """
        to_local = adjoint(inverse(self.T_world))
        now = self.covariance[:6, :6]
        inverse_now = np.linalg.pinv(now, rcond=_ROUNDING, hermitian=True)
        D = _positive(to_local @ (self.drift() - frozen.drift) @ to_local.T)
        part, left = D @ inverse_now, _root(D - D @ inverse_now @ D)
        by_pose = self._by_pose(local)
        by_rig = frozen.by_rig + by_pose @ self.by_rig[:6]
        size = 3 * len(local)
        across = (by_pose @ part @ self.covariance[:6]).reshape(size, -1)
        lever = (by_pose @ part).reshape(size, 6)
        chance = (by_pose @ left).reshape(size, 6)
        own = lever @ now @ lever.T + chance @ chance.T
        _add_blocks(own, frozen.relative)
        return self._with(frozen.ids, local, by_rig.reshape(size, -1), across, own)

    def frozen(self) -> InactiveLandmarks:
        """All landmarks in the form they have outside the state; ids ascending."""
        order = np.argsort(self.ids, kind="stable")
        count = len(self.ids)
        blocks = self.covariance[6:, 6:].reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
        drift = np.broadcast_to(self.drift(), (count, 6, 6))
        return InactiveLandmarks(self.ids, self.in_world(), blocks, drift).select(order)

    def in_world(self) -> Array:
        """∂y/∂δ (F, 3, m) of the landmarks' positions in world coordinates."""
        relative = self.by_rig[6:].reshape(len(self.ids), 3, self.by_rig.shape[1])
        return np.asarray(relative - self._by_pose(self.local) @ self.by_rig[:6])

    def drift(self) -> Array:
        """Covariance of the pose's error (6, 6), as a motion of the world."""
        by_world = adjoint(self.T_world)
        return np.asarray(by_world @ self.covariance[:6, :6] @ by_world.T)

    def _by_sight(self, H: Array, field: Array, noise: Array) -> tuple[Array, Array]:
        """Sensitivities (K, 3, m) and covariances (K, 3, 3) of landmarks by this frame alone."""
        back = self.T_world[:3, :3] @ np.linalg.inv(H)
        return back @ field, back @ noise @ np.swapaxes(back, 1, 2)

    def _by_pose(self, local: Array) -> Array:
        """Derivatives (K, 3, 6) of fixed points by the pose, relative to the camera and in world axes."""
        return np.asarray(self.T_world[:3, :3] @ points_by_pose(local))

    def _with(self, ids: IdArray, local: Array, by_rig: Array, across: Array, own: Array) -> SensitivityState:
        """The state with more landmarks, given their covariances with the state and with each other."""
        n = len(self.covariance)
        covariance = np.empty((n + len(own), n + len(own)))
        covariance[:n, :n], covariance[:n, n:] = self.covariance, across.T
        covariance[n:, :n], covariance[n:, n:] = across, own
        return replace(
            self,
            ids=np.concatenate([self.ids, ids]),
            local=np.concatenate([self.local, local]),
            unseen=np.concatenate([self.unseen, np.zeros(len(ids), np.int64)]),
            by_rig=np.concatenate([self.by_rig, by_rig]),
            covariance=covariance,
        )


def _add_blocks(M: Array, blocks: Array) -> None:
    """Add one or K blocks (3, 3) to those on the diagonal of M (3K, 3K), which is contiguous."""
    each = np.arange(len(M) // 3)
    M.reshape(len(each), 3, len(each), 3)[each, :, each] += blocks


def _positive(D: Array) -> Array:
    """Covariances (K, 6, 6) with eigenvalues that rounding made negative removed."""
    values, vectors = np.linalg.eigh(0.5 * (D + np.swapaxes(D, 1, 2)))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2))


def _root(D: Array) -> Array:
    """Symmetric roots (K, 6, 6) of covariances."""
    values, vectors = np.linalg.eigh(0.5 * (D + np.swapaxes(D, 1, 2)))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2))
