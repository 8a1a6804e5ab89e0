"""The Jacobian of an update's measurements by ``g = [r, φ, landmarks]``: of each landmark only a few columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backends.ekf.measurement import Linearisation
from slam.data import BoolArray
from slam.geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class Displacement:
    """What an update does not measure: a displacement ξ (6,) of camera and landmarks together.

    Attributes:
        change: U (6 + 3M, 6); ξ changes g by ``U ξ``.
        share: L (6, 6 + 3M); a change c of g displaces the world by ``ξ = L c``.
    """

    change: Array
    share: Array


@dataclass(frozen=True, eq=False)
class Jacobian:
    """H (3M, 6 + 3M), as products with it; ``H − H U L`` where it is taken without a displacement of the world.

    Attributes:
        by_pose: derivatives (M, 3, 6) by [r, φ].
        own: derivatives (M, 3, 3) of each landmark's measurement by the landmark.
        displacement: U and L, or None.
        by_displacement: ``H U`` (3M, 6) with the plain H, or None.
    """

    by_pose: Array
    own: Array
    displacement: Displacement | None = None
    by_displacement: Array | None = None

    @classmethod
    def of(cls, line: Linearisation, rows: BoolArray, displacement: Displacement | None = None) -> Jacobian:
        """From derivatives; zero where a row is not measured (mask (M, 3))."""
        by_pose, own = line.by_pose, np.ascontiguousarray(line.own)
        if not rows.all():
            by_pose, own = np.where(rows[:, :, None], by_pose, 0.0), np.where(rows[:, :, None], own, 0.0)
        plain = cls(by_pose, own)
        if displacement is None:
            return plain
        return cls(by_pose, own, displacement, plain.times(displacement.change))

    def only(self, rows: BoolArray) -> Jacobian:
        """With zero where a row is not measured (mask (M, 3))."""
        each = rows[:, :, None]
        reduced = None if self.by_displacement is None else np.where(rows.reshape(-1, 1), self.by_displacement, 0.0)
        return Jacobian(np.where(each, self.by_pose, 0.0), np.where(each, self.own, 0.0), self.displacement, reduced)

    def times(self, X: Array) -> Array:
        """``H X`` (3M, N) for X (6 + 3M, N)."""
        from backends.ekf.jacobian_kernels import times

        out = np.empty((3 * len(self.own), X.shape[1]))
        times(self.by_pose, self.own, np.ascontiguousarray(X), out)
        if self.displacement is not None and self.by_displacement is not None:
            out -= self.by_displacement @ (self.displacement.share @ X)
        return np.asarray(out)

    def transposed_times(self, Y: Array) -> Array:
        """``Hᵀ Y`` (6 + 3M, N) for Y (3M, N)."""
        m, n = len(self.own), Y.shape[1]
        out = np.empty((6 + 3 * m, n))
        out[:6] = self.by_pose.reshape(3 * m, 6).T @ Y
        np.matmul(np.swapaxes(self.own, 1, 2), Y.reshape(m, 3, n), out=out[6:].reshape(m, 3, n))
        if self.displacement is not None and self.by_displacement is not None:
            out -= self.displacement.share.T @ (self.by_displacement.T @ Y)
        return out
