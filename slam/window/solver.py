"""Gauss-Newton over a window with its points eliminated, and the covariances of what it finds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrs, dtrtri

from slam.geometry.arrays import Array, IndexArray
from slam.window import covariance_kernels, kernels
from slam.window.problem import ELIMINATED, Window

#: numerics: Decrease of the cost by a step with the last factor below which that step is the last; it leaves far less.
CLOSE = 1e-2
STEPS = 12  #: numerics: of Gauss-Newton at most; it converges quadratically
_WHOLE = 128  # cost: rows of a triangular matrix that is inverted as a whole


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A window linearised at its present values: ``H x = b``, points eliminated."""

    window: Window  # what was linearised
    H: Array  # information of the unknowns (n, n), lower triangle
    E: Array  # derivatives of points by their charts' coordinates (N, 3, 3)
    inverse: Array  # inverse information of each eliminated point (N, 3, 3)
    gradient: Array  # of each point by its own rows (N, 3)
    cross: Array  # information that each row, then each place, shares between pose and point (M + Q, 6, 3)
    b: Array  # (n,)
    cost: float  # sum of squares of everything, with the prior's ``δᵀ Λ δ − 2 ηᵀ δ``
    by_first: Array  # derivatives of the prior's numbers by the first pose (m, 6)

    def by_rig(self, field: Array) -> tuple[Array, Array]:
        """Derivatives by m errors of the rig: of b (n, m), and of ``inverse gradient`` of each point (N, 3, m).

        `field` (M, 3, m) are those of the rows' true measurements.
        """
        w = self.window
        B, to, at = np.zeros((len(self.b), field.shape[2])), w.layout.prior, slice(w.layout.poses, w.layout.poses + 6)
        if len(to):
            B[to] = w.prior.by_rig
            B[at] = self.by_first.T @ w.prior.by_rig
        own = covariance_kernels.rig_columns(
            w.stereo.intrinsics, w.poses, w.points, w.layout[:7], self.E, w.rows.arrays, field, self.cross,
            self.inverse, B,
        )  # fmt: skip
        return B, own


def linearised(w: Window, centre: int = 0) -> NormalEquations:
    """The normal equations of a window at its present values; points outside the prior are in charts about `centre`."""
    *_, H, at = _gauss_newton(w, centre, np.inf, 0.0, 0, False)
    return NormalEquations(w, H, *at[2:])


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved window."""

    window: Window  # poses and points as found
    equations: NormalEquations  # linearised next to the solution
    factor: Array  # Cholesky's L of the unknowns' information (n, n), in Fortran's order
    cost: float  # at the solution
    converged: bool = True  # False where the steps ran out, or none of them lessened the cost

    @cached_property
    def inverse_factor(self) -> Array:
        """``L⁻¹`` of the points that are asked for and of the poses, lower triangular: the last part of the whole."""
        at = self.window.layout.asked
        return np.asarray(upper_inverse(self.factor[at:, at:].T).T)

    @cached_property
    def pose_covariance(self) -> Array:
        """Joint covariance (6 F, 6 F) of the free poses, perturbed on the right."""
        first = len(self.inverse_factor) - 6 * self.window.layout.free
        X = self.inverse_factor[first:, first:]
        return np.asarray(X.T @ X)

    def by_rig(self, field: Array) -> tuple[Array, Array]:
        """Derivatives by m errors of the rig of the free poses (6 F, m), perturbed on the right, and points (N, 3, m).

        The errors are considered, not estimated (Schmidt, 1966): they add ``J Σ Jᵀ`` to a covariance, with their own Σ.

        Args:
            field: derivatives (M, 3, m) of the rows' true measurements.
        """
        e, layout = self.equations, self.window.layout
        B, own = e.by_rig(field)
        X = dpotrs(self.factor, B, lower=1)[0] if B.size else B
        return X[layout.poses :], covariance_kernels.rig_points(layout[:7], e.E, e.cross, e.inverse, own, X)

    def point_covariances(self, pose: int) -> tuple[Array, Array]:
        """Covariances (N, 3, 3) of the points in the coordinates of a pose, and in the world.

        They are zero for points that are known, that nothing measures, or that are not asked for.
        """
        e, w = self.equations, self.equations.window
        asked = np.ones(len(w.points), bool) if w.asked is None else w.asked
        return covariance_kernels.point_relations(
            w.poses[pose], w.points, asked, w.layout[:7], e.E, e.cross, e.inverse, self.inverse_factor,
            self.pose_covariance, int(w.layout.column[pose]), w.layout.asked // 3,
        )  # fmt: skip

    def left_out_distances(
        self, pose: int, points: IndexArray, z: Array, local: Array, sigma: float, least: float = 0.0
    ) -> Array:
        """Squared distance (M,) of rows of one pose from what all others predict for them, χ² of 3 numbers or of 2.

        It is zero for the only row of a point of which nothing else is known.

        Args:
            pose: which.
            points: which the rows are of (M,).
            z: the rows' measurements (M, 3), uR NaN where missing.
            local: covariances of these points in the pose's coordinates (M, 3, 3), see `point_covariances`.
            sigma: noise of the rows [px].
            least: share of its noise that a row's residual must have to be tested; the distance is 0 where it has less.
        """
        w, then, first = self.window, self.equations.window, self.window.layout.first
        distances = kernels.left_out_distances(
            w.stereo.intrinsics, w.poses[pose], w.points[points], z, local, sigma, least, then.poses[pose],
            then.points[points],
        )  # fmt: skip
        alone = (first[points + 1] - first[points] == 1) & (w.layout.place[points] == ELIMINATED)
        if w.information is not None:
            alone &= w.information[points, 0, 0] == 0
        return np.where(alone, 0.0, distances)


def solve(
    window: Window, close: float = CLOSE, huber: float = np.inf, steps: int = STEPS, fresh: bool = False
) -> Solution:
    """The most probable poses and points, by Gauss-Newton with halved steps.

    Args:
        window: where to begin.
        close: see `CLOSE`.
        huber: whitened residual from which on a row's pull no longer grows.
        steps: at most.
        fresh: whether each step has a factor of its own. Where next to nothing is known of the place in the world, a
            step with an earlier factor moves all together by any amount: what is left of the gradient pulls along
            directions that were those of such a motion before.

    Raises:
        numpy.linalg.LinAlgError: something is not determined, or a value is not finite.
    """
    poses, points, cost, minimum, L, H, at = _gauss_newton(window, 0, huber, close, steps, fresh)
    if np.isnan(cost):
        raise np.linalg.LinAlgError("a window does not determine its unknowns, or holds a value that is not finite")
    return Solution(window.at(poses, points), NormalEquations(window.at(*at[:2]), H, *at[2:]), L, cost, minimum)


def _gauss_newton(w: Window, centre: int, huber: float, close: float, steps: int, fresh: bool) -> tuple[Any, ...]:
    found: tuple[Any, ...] = kernels.gauss_newton(
        w.stereo.intrinsics, w.poses, w.points, w.layout[:7], w.knowledge, centre, w.layout.unknowns, huber, close,
        steps, fresh,
    )  # fmt: skip
    return found


def row_distances(w: Window) -> Array:
    """Squared distance of each row (M,) from its prediction by poses and points as they are.

    It is ∞ for a row that does not count or has no left pixel, and behind the camera.
    """
    return np.asarray(kernels.row_distances(w.stereo.intrinsics, w.poses, w.points, w.rows.arrays))


def upper_inverse(U: Array) -> Array:
    """Inverse of an upper triangular matrix (n, n), by halves: products take a fraction of the time of LAPACK's own."""
    n = len(U)
    if n <= _WHOLE:
        return np.asarray(dtrtri(U, lower=0)[0] if n else U)
    half = n // 2
    out = np.zeros((n, n), order="F")
    first, last = upper_inverse(U[:half, :half]), upper_inverse(U[half:, half:])
    out[:half, :half], out[half:, half:] = first, last
    out[:half, half:] = dtrmm(-1.0, first, dtrmm(1.0, last, U[:half, half:], side=1))
    return out
