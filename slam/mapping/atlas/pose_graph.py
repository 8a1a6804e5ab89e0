"""Pose graph: all keyframes' poses from the path and the loops, by least squares.

Variables are the poses of keyframes at which a loop ends, of the first and of the last one, and the common errors of
all motions (see `slam.mapping.atlas.chain`). The stretch of path between two of these keyframes is one factor; its
correction is then distributed among the keyframes within, which to first order is the solution of the full problem.

It is solved by Gauss-Newton. The normal equations of the poses are sparse (SciPy's SuperLU), bordered by dense ones of
the common errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, exp, hat, inverse, log
from slam.mapping.atlas.chain import Chain, Propagated, spread
from slam.mapping.atlas.keyframes import Loop

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

_ROUNDS = 30  # numerics: most iterations
_CONVERGED = 1e-3  # numerics: decrease of χ² at which iteration ends
_FAST = 0.1  # numerics: the normal equations are kept while χ² decreases by less than this share of its last decrease
_HALVINGS = 8  # numerics: most halvings of a step that increases χ²


@dataclass(frozen=True, eq=False)
class Solution:
    """The keyframes' poses."""

    poses: Array  # T_map_left (K, 4, 4)
    # joint covariance (6 + m, 6 + m) of the last pose, perturbing on the right, and the common errors
    covariance: Array
    common: Array  # the common errors (m,)
    disagreement: Array  # of each loop with the graph (L,), χ² with 6 degrees of freedom


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Path and loops, with the poses and common errors that minimise χ²."""

    chain: Chain  # the path
    problem: _Problem  # the equations
    poses: Array  # of the keyframes that are variables (M, 4, 4)
    common: Array  # the common errors (m,)
    normal: _Normal  # the normal equations near the solution

    @classmethod
    def solved(
        cls, chain: Chain, loops: Sequence[Loop], start: Array, also: Sequence[int] = (), common: Array | None = None
    ) -> PoseGraph:
        """The graph of a path and loops, solved.

        Args:
            chain: the path.
            loops: in the graph.
            start: poses (K, 4, 4) of all keyframes, at which the graph is first linearised.
            also: further keyframes whose poses are variables, besides those at which loops end.
            common: the common errors (m,) to start from; zero by default.

        Raises:
            LinAlgError: the equations are singular to working precision.
        """
        problem = _Problem.of(chain, loops, also)
        common = np.zeros(chain.common.shape[2]) if common is None else common
        return cls(chain, problem, *problem.optimised(start[problem.ends], common))

    def with_loop(self, loop: Loop) -> PoseGraph:
        """The solved graph with one more loop, between keyframes that are variables."""
        problem = self.problem.with_loop(loop)
        starts = self.poses, self._bent(loop)
        start = min(starts, key=lambda poses: problem.cost(poses, self.common))
        return PoseGraph(self.chain, problem, *problem.optimised(start, self.common))

    def _bent(self, loop: Loop) -> Array:
        """Poses (M, 4, 4) of the variables that satisfy a loop, its correction distributed along the path.

        A stretch that is hardly known takes nearly all of the correction, and the path after it moves rigidly, however
        far that is. A linear step in the single poses would bend that part.
        """
        p, last = self.problem, len(self.poses) - 1
        noise, common = (each[p.ends] for each in p.propagated)
        path = Chain(self.poses, noise + common @ np.swapaxes(common, 1, 2))
        first, second = np.searchsorted(p.ends, loop.pair)
        ends = np.unique([0, first, second, last])
        moved = self.poses[ends].copy()
        target = self.poses[first] @ loop.T_first_second
        moved[ends >= second] = target @ inverse(self.poses[second]) @ moved[ends >= second]
        return spread(path, ends, path.propagated(ends), moved, np.zeros(0))

    def relative_pose(self, first: int, second: int) -> tuple[Array, Array]:
        """Pose (4, 4) of a keyframe in another one's coordinates, and its covariance (6, 6); both are variables."""
        rows = np.searchsorted(self.problem.ends, [first, second])
        T = inverse(self.poses[rows[0]]) @ self.poses[rows[1]]
        P = self.normal.covariance(rows.tolist())[:12, :12]
        J = np.concatenate([-adjoint(inverse(T)), np.eye(6)], axis=1)
        return T, J @ P @ J.T

    def disagreement(self) -> Array:
        """Disagreement of each loop with the graph (L,), χ² with 6 degrees of freedom."""
        p = self.problem
        return np.square(p.whitened(p.residuals(self.poses, self.common))).sum(axis=1)[len(p.ends) - 1 :]

    def solution(self) -> Solution:
        """The poses of all keyframes."""
        p, P = self.problem, self.normal.covariance([len(self.poses) - 1])
        moved = spread(self.chain, p.ends, p.propagated, self.poses, self.common)
        return Solution(moved, P, self.common, self.disagreement())


def solve(chain: Chain, loops: Sequence[Loop], start: Array) -> Solution:
    """Poses of all keyframes, given the path and at least one loop; see `PoseGraph.solved`."""
    return PoseGraph.solved(chain, loops, start).solution()


@dataclass(frozen=True, eq=False)
class _Problem:
    """Measured motions between keyframes: those of stretches first, then those of loops."""

    ends: NDArray[np.intp]  # keyframes (M,) whose poses are variables; the first one is fixed and defines the map
    a: NDArray[np.intp]  # rows of `ends` (E,): the motion is the pose of b in the coordinates of a
    b: NDArray[np.intp]
    motions: Array  # measured (E, 4, 4)
    roots: Array  # square roots of their information (E, 6, 6): a residual r costs |root r|²
    common: Array  # derivative of the motions by the common errors (E, 6, m)
    propagated: Propagated  # errors within the stretches, see `slam.mapping.atlas.chain.Chain.propagated`

    @classmethod
    def of(cls, chain: Chain, loops: Sequence[Loop], also: Sequence[int]) -> _Problem:
        last = len(chain.poses) - 1
        ends = np.unique([0, last, *also, *(k for loop in loops for k in (loop.first, loop.second))]).astype(np.intp)
        propagated = chain.propagated(ends)
        begin, end = ends[:-1], ends[1:]
        common = propagated.common[end]
        covariances = np.concatenate([propagated.noise[end], np.array([x.covariance for x in loops]).reshape(-1, 6, 6)])
        motions = inverse(chain.poses[begin]) @ chain.poses[end]
        return cls(
            ends,
            np.searchsorted(ends, [*begin, *(x.first for x in loops)]),
            np.searchsorted(ends, [*end, *(x.second for x in loops)]),
            np.concatenate([motions, np.array([x.T_first_second for x in loops]).reshape(-1, 4, 4)]),
            _root_of_information(covariances),
            np.concatenate([common, np.zeros((len(loops), *common.shape[1:]))]),
            propagated,
        )

    def with_loop(self, loop: Loop) -> _Problem:
        """A copy with one more factor, for a loop between keyframes that are variables."""
        return _Problem(
            self.ends,
            np.append(self.a, np.searchsorted(self.ends, loop.first)),
            np.append(self.b, np.searchsorted(self.ends, loop.second)),
            np.concatenate([self.motions, loop.T_first_second[None]]),
            np.concatenate([self.roots, _root_of_information(loop.covariance[None])]),
            np.concatenate([self.common, np.zeros((1, *self.common.shape[1:]))]),
            self.propagated,
        )

    def expected(self, common: Array) -> Array:
        """Errors of the motions (E, 6) due to the common errors (m,)."""
        return np.asarray(self.common @ common)

    def residuals(self, poses: Array, common: Array) -> Array:
        """Residuals (E, 6): motions of poses (M, 4, 4) against the measured ones corrected by the common errors."""
        return log(inverse(self.motions) @ inverse(poses[self.a]) @ poses[self.b]) - self.expected(common)

    def whitened(self, r: Array) -> Array:
        """Residuals (E, 6) scaled to unit variance."""
        return np.asarray((self.roots @ r[:, :, None])[:, :, 0])

    def cost(self, poses: Array, common: Array) -> float:
        """The χ² of poses (M, 4, 4) and common errors (m,)."""
        return float(np.square(self.whitened(self.residuals(poses, common))).sum() + common @ common)

    def derivatives(self, poses: Array, common: Array) -> tuple[Array, Array, Array]:
        """Residuals (E, 6) at poses (M, 4, 4) and common errors (m,), and Jacobians (E, 6, 6) by poses a and b."""
        r = self.residuals(poses, common)
        back = _by_perturbation(r + self.expected(common))
        return r, -back @ adjoint(inverse(poses[self.b]) @ poses[self.a]), back

    def gradient(self, poses: Array, common: Array) -> tuple[Array, Array]:
        """Right-hand sides of the normal equations: poses without the first (6 (M − 1),), and common errors (m,)."""
        r, A, B = self.derivatives(poses, common)
        Wr = np.swapaxes(self.roots, 1, 2) @ (self.roots @ r[:, :, None])
        right = np.zeros((len(poses), 6))
        for rows, X in ((self.a, A), (self.b, B)):
            np.add.at(right, rows, -(np.swapaxes(X, 1, 2) @ Wr)[:, :, 0])
        return right[1:].ravel(), np.tensordot(self.common, Wr[:, :, 0], axes=((0, 1), (0, 1))) - common

    def normal(self, poses: Array, common: Array) -> _Normal:
        """The normal equations about poses (M, 4, 4) and common errors (m,)."""
        _, A, B = self.derivatives(poses, common)
        W = np.swapaxes(self.roots, 1, 2) @ self.roots
        return _Normal.of(len(poses), self.a, self.b, A, B, -self.common, W)

    def optimised(self, poses: Array, common: Array) -> tuple[Array, Array, _Normal]:
        """Poses (M, 4, 4) and common errors (m,) that minimise χ², and normal equations near there.

        While steps converge fast, they reuse the previous normal equations and recompute the gradient alone. The normal
        equations are also recomputed when such a step gains nothing.
        """
        cost, gain = self.cost(poses, common), np.inf
        normal, fresh = self.normal(poses, common), True
        for _ in range(_ROUNDS):
            step, change = normal.step(*self.gradient(poses, common))
            before, less = gain, np.inf
            for half in 0.5 ** np.arange(_HALVINGS if fresh else 1):
                moved = np.concatenate([poses[:1], poses[1:] @ exp(half * step)])
                less = self.cost(moved, common + half * change)
                if less <= cost:
                    poses, common, gain, cost = moved, common + half * change, cost - less, less
                    break
            worse, whole = less > cost, half == 1
            if (gain < _CONVERGED and whole) or (worse and fresh):  # a halved step may gain little anywhere
                break
            fresh = worse or not whole or gain > _FAST * before
            normal = self.normal(poses, common) if fresh else normal
        return poses, common, normal


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of poses, sparse, and of common errors, dense."""

    solver: SuperLU  # of the poses' own part (6 (M − 1), 6 (M − 1))
    border: Array  # the part between poses and common errors (6 (M − 1), m)
    through: Array  # that part, solved for the poses
    inner: Array  # covariance of the common errors (m, m)

    @classmethod
    def of(
        cls,
        count: int,
        a: NDArray[np.intp],
        b: NDArray[np.intp],
        A: Array,
        B: Array,
        C: Array,
        W: Array,
    ) -> _Normal:
        """From residuals (E, 6) with information W that depend on poses a and b (E,) and on the common errors.

        The common errors have a prior of unit information.

        Args:
            count: number of poses, the fixed first one included.
            a: rows of the first poses (E,).
            b: rows of the second poses (E,).
            A: derivatives by the first poses (E, 6, 6).
            B: by the second poses (E, 6, 6).
            C: by the common errors (E, 6, m).
            W: information (E, 6, 6).

        Raises:
            LinAlgError: they are singular, or not finite.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import splu

        m, size = C.shape[2], 6 * (count - 1)
        rows, columns, values = [], [], []
        border = np.zeros((count, 6, m))
        for i, X in ((a, A), (b, B)):
            XW = np.swapaxes(X, 1, 2) @ W
            np.add.at(border, i, XW @ C)
            for j, Y in ((a, A), (b, B)):
                both = (i > 0) & (j > 0)
                rows.append(np.repeat(6 * (i[both, None] - 1) + np.arange(6), 6, axis=1).ravel())
                columns.append(np.tile(6 * (j[both, None] - 1) + np.arange(6), 6).ravel())
                values.append((XW @ Y)[both].ravel())
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        matrix = coo_array(entries, shape=(size, size)).tocsc()
        if not np.isfinite(entries[0]).all():
            raise np.linalg.LinAlgError("pose graph: a number is not finite")
        try:
            solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", options=_SYMMETRIC)
        except RuntimeError as error:  # SuperLU's word for it
            raise np.linalg.LinAlgError(f"pose graph: {error}") from error
        flat = border[1:].reshape(size, m)
        through = solver.solve(flat) if m else flat
        follow = np.concatenate([np.zeros((1, 6, m)), through.reshape(count - 1, 6, m)])
        rest = C - A @ follow[a] - B @ follow[b]  # Schur complement as a square, not as a difference of large squares
        # Part of a covariance, and used in every step; m is small.
        inner = np.linalg.inv(np.eye(m) + np.tensordot(rest, W @ rest, axes=((0, 1), (0, 1))))
        return cls(solver, flat, through, inner)

    def step(self, right: Array, right_common: Array) -> tuple[Array, Array]:
        """Steps of the poses without the first (M − 1, 6) and of the common errors (m,), from the right-hand sides."""
        alone = self.solver.solve(right)
        change = self.inner @ (right_common - self.border.T @ alone)
        return (alone - self.through @ change).reshape(-1, 6), change

    def covariance(self, poses: Sequence[int]) -> Array:
        """Joint covariance (6 n + m, 6 n + m) of n poses, given by their rows, and of the common errors."""
        size, m, n = len(self.border), len(self.inner), 6 * len(poses)
        picked = np.zeros((size, n))
        for i, row in enumerate(poses):
            if row > 0:  # the first one is fixed
                picked[6 * (row - 1) + np.arange(6), 6 * i + np.arange(6)] = 1
        alone = picked.T @ self.solver.solve(picked)
        by_common = -picked.T @ self.through
        P = np.zeros((n + m, n + m))
        P[:n, :n] = alone + by_common @ self.inner @ by_common.T
        P[:n, n:] = by_common @ self.inner
        P[n:, :n], P[n:, n:] = P[:n, n:].T, self.inner
        return 0.5 * (P + P.T)


#: The matrix is symmetric and positive definite, so pivots are taken from the diagonal.
_SYMMETRIC = {"SymmetricMode": True, "DiagPivotThresh": 0.0}


def _root_of_information(covariances: Array) -> Array:
    """Matrices R (E, 6, 6) with ``Rᵀ R`` the inverse of covariances (E, 6, 6), some of which may be singular.

    The noise of single steps can be zero in some directions (see `slam.mapping.atlas.keyframes`). Such directions get a
    least variance, because exact steps would make the normal equations numerically singular.
    """
    covariances = covariances + LEAST_VARIANCE * np.eye(6)
    scale = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    values, vectors = np.linalg.eigh(covariances / (scale[:, :, None] * scale[:, None, :]))
    return np.asarray(
        np.swapaxes(vectors / np.sqrt(np.maximum(values, LEAST_VARIANCE))[:, None, :], 1, 2) / scale[:, None, :]
    )


def _by_perturbation(xi: Array) -> Array:
    """Derivatives (E, 6, 6) of ``log(exp(ξ) exp(δ))`` by δ at 0, to second order of ξ (E, 6)."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = hat(xi[:, :3])
    ad[:, 3:, :3] = hat(xi[:, 3:])
    return np.asarray(np.eye(6) + 0.5 * ad + ad @ ad / 12)
