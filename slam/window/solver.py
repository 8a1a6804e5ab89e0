"""Gauss-Newton over a window with its points eliminated, and the covariances of what it finds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri

from slam.geometry.arrays import Array, IndexArray
from slam.window import covariance_kernels, kernels
from slam.window.problem import Window

_STEPS = 12  # numerics: of Gauss-Newton at most; it converges quadratically
_WHOLE = 128  # cost: rows of a triangular matrix that is inverted as a whole
_HALVINGS = 8  # numerics: of a step that does not lessen the cost
#: numerics: Decrease of the cost by a step with the last factor below which that step is the last; it leaves far less.
CLOSE = 1e-2
#: numerics: The same for a step with a factor of its own, in units of `close`; it leaves the square of that.
_NEAR = 50.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A window linearised at its present values: ``H x = b``, points eliminated."""

    window: Window  # what was linearised
    H: Array  # information of the unknowns (n, n), lower triangle
    b: Array  # (n,)
    cost: float  # sum of squares of everything, with the prior's ``δᵀ Λ δ − 2 ηᵀ δ``
    E: Array  # derivatives of points by their charts' coordinates (N, 3, 3)
    inverse: Array  # inverse information of each eliminated point (N, 3, 3)
    gradient: Array  # of each point by its own rows (N, 3)
    cross: Array  # information that each row, then each place, shares between pose and point (M + Q, 6, 3)
    by_first: Array  # derivatives of the prior's numbers by the first pose (m, 6)

    @cached_property
    def factor(self) -> Array:
        """Upper triangular Lᵀ (n, n) in Fortran's order, with ``L Lᵀ = H``.

        Raises:
            numpy.linalg.LinAlgError: H is not positive definite: something is not determined.
        """
        if not len(self.H):
            return self.H
        U, info = dpotrf(self.H.T, lower=0, clean=1, overwrite_a=0)
        if info or not np.isfinite(U[-1:, -1:]).all():
            raise np.linalg.LinAlgError("the window's information is not positive definite")
        return np.asarray(U)

    def step(self, factor: Array) -> tuple[Array, float]:
        """Step of the unknowns (n,) by a factor of these or nearby equations, and the decrease of cost it expects.

        That is of the points that are eliminated, too, which step with them.
        """
        x = dpotrs(factor, self.b, lower=0)[0] if len(self.b) else self.b
        points = np.einsum("ni,nij,nj->", self.gradient, self.inverse, self.gradient)
        return x, float(x @ self.b + points)

    def by_rig(self, field: Array) -> tuple[Array, Array]:
        """Derivatives by m errors of the rig: of b (n, m), and of ``inverse gradient`` of each point (N, 3, m).

        `field` (M, 3, m) are those of the rows' true measurements.
        """
        w = self.window
        prior = w.prior.by_rig if len(w.prior.vector) else np.zeros((0, field.shape[2]))
        return covariance_kernels.rig_columns(
            w.stereo.intrinsics, w.poses, w.column, w.points, w.place, self.E, w.rows.arrays, field, prior,
            self.by_first, len(w.prior.points), len(w.members), w.pose_of, self.cross, *w.by_point, self.inverse,
            w.unknowns,
        )  # fmt: skip

    def after(self, x: Array) -> Window:
        """The window after a step of the unknowns."""
        w = self.window
        poses, points = kernels.step(
            w.poses, w.column, w.points, w.place, self.E, w.pose_of, self.cross, *w.by_point, self.inverse,
            self.gradient, x,
        )  # fmt: skip
        return w.at(poses, points)


def linearised(w: Window, centre: int = 0, whole: bool = True) -> NormalEquations:
    """The normal equations of a window at its present values.

    Args:
        w: the window.
        centre: the pose from which inverse distances of points outside the prior count.
        whole: with H; without it, H is left undefined, and only a factor of other equations may be used.
    """
    own = (
        (np.zeros((0, 3)), np.zeros((0, 3, 3))) if w.mean is None or w.information is None else (w.mean, w.information)
    )
    return NormalEquations(w, *kernels.normal_equations(
        w.stereo.intrinsics, w.poses, w.column, w.points, w.place, w.basis, centre, w.rows.arrays, w.places.arrays, own,
        w.motion.arrays, w.carried.arrays, w.prior.arrays, w.pose_of, *w.by_point, whole, w.unknowns,
    ))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved window.

    Attributes:
        window: poses and points as found.
        equations: linearised next to the solution.
        cost: at the solution.
        converged: False where the steps ran out, or none of them lessened the cost.
    """

    window: Window
    equations: NormalEquations
    cost: float
    converged: bool = True

    @cached_property
    def inverse_factor(self) -> Array:
        """``L⁻¹`` (n, n), lower triangular."""
        return np.asarray(_upper_inverse(self.equations.factor).T)

    @cached_property
    def pose_covariance(self) -> Array:
        """Joint covariance (6 F, 6 F) of the free poses, perturbed on the right."""
        first = 3 * len(self.window.members)
        X = self.inverse_factor[first:, first:]
        return np.asarray(X.T @ X)

    def by_rig(self, field: Array) -> tuple[Array, Array]:
        """Derivatives by m errors of the rig of the free poses (6 F, m), perturbed on the right, and points (N, 3, m).

        The errors are considered, not estimated (Schmidt, 1966): they add ``J Σ Jᵀ`` to a covariance, with their own Σ.

        Args:
            field: derivatives (M, 3, m) of the rows' true measurements.
        """
        w, e = self.window, self.equations
        B, own = e.by_rig(field)
        X = self.inverse_factor.T @ (self.inverse_factor @ B)
        points = covariance_kernels.rig_points(
            w.column, w.place, e.E, w.pose_of, e.cross, *w.by_point, e.inverse, own, X
        )
        return X[3 * len(w.members) :], points

    def point_covariances(self, pose: int) -> tuple[Array, Array]:
        """Covariances (N, 3, 3) of the points in the coordinates of a pose, and in the world; zero for known ones."""
        e = self.equations
        w = e.window
        return covariance_kernels.point_relations(
            w.poses[pose], w.points, w.place, e.E, w.pose_of, e.cross, *w.by_point, w.column, e.inverse,
            self.inverse_factor, self.pose_covariance, int(w.column[pose]), 3 * len(w.members),
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
        w, then, first = self.window, self.equations.window, self.window.by_point[0]
        distances = kernels.left_out_distances(
            w.stereo.intrinsics, w.poses[pose], w.points[points], z, local, sigma, least, then.poses[pose],
            then.points[points],
        )  # fmt: skip
        alone = (first[points + 1] - first[points] == 1) & (w.place[points] == kernels.ELIMINATED)
        if w.information is not None:
            alone &= w.information[points, 0, 0] == 0
        return np.where(alone, 0.0, distances)


def solve(window: Window, close: float = CLOSE) -> Solution:
    """The most probable poses and points, by Gauss-Newton with halved steps.

    Args:
        window: where to begin.
        close: see `CLOSE`.

    Raises:
        numpy.linalg.LinAlgError: something is not determined, or a value is not finite.
    """
    now = linearised(window)
    for _ in range(_STEPS):
        x, rest = now.step(now.factor)
        if rest < _NEAR * close:
            return Solution(now.after(x), now, now.cost - rest)
        following = _descended(now, x)
        if following is None:
            return Solution(now.window, now, now.cost, False)
        x, rest = following.step(now.factor)
        if not np.isfinite(rest):
            raise np.linalg.LinAlgError("a window's step is not finite")
        if rest < close:  # so near the end the last factor serves once more
            return Solution(following.after(x), now, following.cost - rest)
        now = linearised(following.window)
    return Solution(now.window, now, now.cost, False)


def _descended(now: NormalEquations, x: Array) -> NormalEquations | None:
    """Equations, not whole, after a step, or the longest of its halves that does not raise the cost; None for none."""
    for halving in range(_HALVINGS):
        following = linearised(now.after(0.5**halving * x), whole=False)
        if following.cost <= now.cost + 1e-9 * abs(now.cost) + 1e-12:
            return following
    return None


def _upper_inverse(U: Array) -> Array:
    """Inverse of an upper triangular matrix (n, n), by halves: products take a fraction of the time of LAPACK's own."""
    n = len(U)
    if n <= _WHOLE:
        return np.asarray(dtrtri(U, lower=0)[0] if n else U)
    half = n // 2
    out = np.zeros((n, n), order="F")
    first, last = _upper_inverse(U[:half, :half]), _upper_inverse(U[half:, half:])
    out[:half, :half], out[half:, half:] = first, last
    out[:half, half:] = -first @ (U[:half, half:] @ last)
    return out
