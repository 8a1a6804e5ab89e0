"""Gauss-Newton over a window with its points eliminated, and the covariances of what it finds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri

from slam.geometry.arrays import Array, IndexArray
from slam.window import chart_kernels, covariance_kernels, kernels
from slam.window.carried import carried_rows
from slam.window.problem import Window

_STEPS = 12  # numerics: of Gauss-Newton at most; it converges quadratically
_HALVINGS = 8  # numerics: of a step that does not lessen the cost
#: numerics: Decrease of the cost by a step with the last factor below which that step is the last; it leaves far less.
CLOSE = 1e-2
#: numerics: The same for a step with a factor of its own, in units of `close`; it leaves the square of that.
_NEAR = 50.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A window linearised at its present values: ``H x = b``, points eliminated.

    Attributes:
        window: what was linearised.
        H: information of the unknowns (n, n), lower triangle.
        b: (n,).
        cost: sum of squares of everything, with the prior's ``δᵀ Λ δ − 2 ηᵀ δ``.
        E: derivatives of points by their charts' coordinates (N, 3, 3).
        inverse: inverse information of each eliminated point (N, 3, 3).
        gradient: of each point by its own rows (N, 3).
        cross: information that each row, then each place, shares between pose and point (M + Q, 6, 3).
    """

    window: Window
    H: Array
    b: Array
    cost: float
    E: Array
    inverse: Array
    gradient: Array
    cross: Array

    @cached_property
    def factor(self) -> Array:
        """Lower triangular L (n, n) with ``L Lᵀ = H``.

        Raises:
            numpy.linalg.LinAlgError: H is not positive definite: something is not determined.
        """
        if not len(self.H):
            return self.H
        L, info = dpotrf(self.H.T, lower=0, clean=1, overwrite_a=0)
        if info or not np.isfinite(L[-1:, -1:]).all():
            raise np.linalg.LinAlgError("the window's information is not positive definite")
        return np.asarray(L)  # upper triangle, Lᵀ in Fortran's order

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
        w, rows, m = self.window, self.window.rows, field.shape[2]
        prior = _from_prior(w)
        B = np.zeros((w.unknowns, m)) if prior is None else _placed(w, prior[1], w.prior.by_rig)
        own = covariance_kernels.rig_columns(
            w.stereo.intrinsics, w.poses, w.column, w.points, w.place, self.E, rows.pose, rows.point,
            rows.z, rows.weight, field, w.pose_of_row, self.cross, *w.by_point, self.inverse, B,
        )  # fmt: skip
        return B, own

    def after(self, x: Array) -> Window:
        """The window after a step of the unknowns."""
        w = self.window
        poses, points = kernels.step(
            w.poses, w.column, w.points, w.place, self.E, w.pose_of_row, self.cross, *w.by_point, self.inverse,
            self.gradient, x,
        )  # fmt: skip
        moved = replace(w, poses=poses, points=points)
        for name in ("members", "basis", "place", "column", "unknowns", "by_point", "pose_of_row"):
            moved.__dict__[name] = getattr(w, name)  # these do not change
        return moved


def linearised(w: Window, centre: int = 0, whole: bool = True) -> NormalEquations:
    """The normal equations of a window at its present values.

    Args:
        w: the window.
        centre: the pose from which inverse distances of points outside the prior count.
        whole: with H; without it, H is left undefined, and only a factor of other equations may be used.
    """
    n, rows = w.unknowns, w.rows
    H, b = np.zeros((n, n)) if whole else np.empty((n, n)), np.zeros(n)
    cost = _begin_with_prior(w, H, b, whole)
    E = chart_kernels.charts(w.poses, centre, w.points, w.place, w.basis, 0)
    squares, information, gradient, cross = kernels.linearise(
        w.stereo.intrinsics, w.poses, w.column, w.points, w.place, E, rows.pose, rows.point, rows.z, rows.weight, whole,
        H, b,
    )  # fmt: skip
    cost += float(squares.sum())
    if len(w.places):
        p = w.places
        more, its = kernels.place_rows(
            w.poses, w.column, w.points, w.place, E, p.pose, p.point, p.basis, p.origin, p.root, whole, H, b,
            information, gradient,
        )  # fmt: skip
        cost, cross = cost + more, np.concatenate([cross, its])
    if w.information is not None and w.mean is not None:
        cost += kernels.own_priors(w.points, w.place, E, w.mean, w.information, information, gradient)
    if len(w.motion.poses):
        m = w.motion
        cost += kernels.motion_rows(w.poses, w.column, m.poses, m.interval, m.weight, H, b)
    if len(w.carried.poses):
        c = w.carried
        cost += carried_rows(
            w.poses, w.column, c.cameras, c.covariance, c.poses, c.interval, c.mean, c.variance, H, b
        )  # fmt: skip
    inverse = kernels.eliminate(
        w.column, w.place, w.pose_of_row, cross, *w.by_point, information, gradient, whole, H, b
    )  # fmt: skip
    return NormalEquations(w, H, b, cost, E, inverse, gradient, cross)


def _from_prior(w: Window) -> tuple[Array, Array] | None:
    """δ (n,) of the prior, and its derivative (n, 6) by the first pose; None where a point has left its chart."""
    prior, n = w.prior, len(w.prior.vector)
    delta, A = np.empty(n), np.empty((n, 6))
    covered = not n or kernels.prior_rows(
        w.poses, w.points, prior.points, prior.T, prior.relative, prior.basis, prior.origin,
        np.arange(len(prior.relative)), delta, A,
    )  # fmt: skip
    return (delta, A) if covered else None


def _placed(w: Window, A: Array, pull: Array) -> Array:
    """What pulls at the prior's δ (n, ...), at the window's unknowns; A (n, 6) as of `_from_prior`."""
    D, J, n = 3 * len(w.prior.points), 3 * len(w.joining), len(pull)
    out = np.zeros((w.unknowns, *pull.shape[1:]))
    out[:D], out[D + J : n + J] = pull[:D], pull[D:]
    out[D + J : D + J + 6] = A.T @ pull
    return out


def _begin_with_prior(w: Window, H: Array, b: Array, whole: bool) -> float:
    """Begin the normal equations with the prior; returns its cost, ∞ where a point has left its chart."""
    prior, n = w.prior, len(w.prior.vector)
    if not n:
        return 0.0
    found = _from_prior(w)
    if found is None:
        return np.inf
    delta, A = found
    D, J = 3 * len(prior.points), 3 * len(w.joining)
    pull = prior.vector - prior.information @ delta
    b[:] = _placed(w, A, pull)
    if whole:
        V, poses, reference = prior.information @ A, slice(D + J, n + J), slice(D + J, D + J + 6)
        H[:D, :D], H[poses, :D] = prior.information[:D, :D], prior.information[D:, :D]
        H[poses, poses] = prior.information[D:, D:]
        H[reference, :D], H[poses, reference], H[reference, poses] = V[:D].T, V[D:], V[D:].T
        H[reference, reference] = A.T @ V
    return float(-delta @ (pull + prior.vector))


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
        upper = self.equations.factor
        return np.asarray(dtrtri(upper, lower=0)[0].T if len(upper) else upper)

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
        X = np.ascontiguousarray(dpotrs(e.factor, B, lower=0)[0]) if B.size else B
        points = covariance_kernels.rig_points(
            w.column, w.place, e.E, w.pose_of_row, e.cross, *w.by_point, e.inverse, own, X
        )
        return X[3 * len(w.members) :], points

    def point_covariances(self, pose: int) -> tuple[Array, Array]:
        """Covariances (N, 3, 3) of the points in the coordinates of a pose, and in the world; zero for known ones."""
        e = self.equations
        w = e.window
        return covariance_kernels.point_relations(
            w.poses[pose], w.points, w.place, e.E, w.pose_of_row, e.cross, *w.by_point, w.column, e.inverse,
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
            least: share of its noise that a row's residual must have to be tested; ∞ where it has less.
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
