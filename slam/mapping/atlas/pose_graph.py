"""Where all keyframes are: the path between them, and what the loops say about it, by least squares.

Only keyframes at which a loop ends, the first and the last one are variables, besides the common errors of all steps
(see `slam.mapping.atlas.chain`); the stretches between them are one equation each. What a stretch is moved by is then
shared out among its keyframes, which is what the whole problem would give, to first order.

Gauss-Newton. The normal equations of the poses are sparse (SciPy's SuperLU); the common errors are a dense border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, exp, hat, inverse, log
from slam.mapping.atlas.chain import Chain, adjoints, spread
from slam.mapping.atlas.keyframes import Loop

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

_ROUNDS = 30  # of least squares, at most
_CONVERGED = 1e-3  # decrease of χ² that is none any more
_HALVINGS = 8  # of a step that makes χ² larger


@dataclass(frozen=True)
class Solution:
    """The keyframes' poses.

    Attributes:
        poses: T_map_left (K, 4, 4).
        covariance: of the last one, perturbing on the right, and of the common errors (6 + m, 6 + m).
        common: the common errors (m,).
        disagreement: of each loop with the whole, as a χ² of 6 degrees of freedom (L,).
    """

    poses: Array
    covariance: Array
    common: Array
    disagreement: Array


def solve(chain: Chain, loops: Sequence[Loop], start: Array) -> Solution:
    """Poses of all keyframes, given the path and the loops.

    Args:
        chain: the path.
        loops: at least one.
        start: poses (K, 4, 4) to linearise at first.
    """
    problem = _Problem.of(chain, loops, ())
    poses, common = problem.optimised(start[problem.ends])
    r = problem.residuals(poses, common)
    last = len(poses) - 1
    P = problem.normal(poses, common).covariance([last])
    disagreement = np.square(problem.whitened(r)).sum(axis=1)[len(r) - len(loops) :]
    return Solution(spread(chain, problem.ends, problem.carried, poses, common), P, common, disagreement)


def relative_pose(chain: Chain, loops: Sequence[Loop], start: Array, first: int, second: int) -> tuple[Array, Array]:
    """Pose (4, 4) of a keyframe in another one's coordinates, as path and loops say, and its covariance (6, 6).

    Args:
        chain: the path.
        loops: what is known already.
        start: poses (K, 4, 4) that they have led to.
        first: number of the one keyframe.
        second: number of the other one.
    """
    problem = _Problem.of(chain, loops, (first, second))
    poses, common = problem.optimised(start[problem.ends])
    rows = np.searchsorted(problem.ends, [first, second])
    T = inverse(poses[rows[0]]) @ poses[rows[1]]
    P = problem.normal(poses, common).covariance(rows.tolist())[:12, :12]
    J = np.concatenate([-adjoint(inverse(T)), np.eye(6)], axis=1)
    return T, J @ P @ J.T


@dataclass(frozen=True)
class _Problem:
    """Measured motions between keyframes: those of stretches first, then those of loops.

    Attributes:
        ends: keyframes (M,) whose poses are variables; the first one is fixed and defines the map.
        a, b: rows of `ends` (E,): motion b is seen from a.
        motions: measured (E, 4, 4).
        roots: of their information (E, 6, 6): a residual r weighs |root r|².
        common: derivative of the motions by the common errors (E, 6, m).
        carried: of all keyframes, see `slam.mapping.atlas.chain.Chain.carried`.
    """

    ends: NDArray[np.intp]
    a: NDArray[np.intp]
    b: NDArray[np.intp]
    motions: Array
    roots: Array
    common: Array
    carried: tuple[Array, Array]

    @classmethod
    def of(cls, chain: Chain, loops: Sequence[Loop], also: Sequence[int]) -> _Problem:
        last = len(chain.poses) - 1
        ends = np.unique([0, last, *also, *(k for loop in loops for k in (loop.first, loop.second))]).astype(np.intp)
        noise, common = chain.carried(ends)
        begin, end = ends[:-1], ends[1:]
        covariances = np.concatenate([noise[end], np.array([x.covariance for x in loops]).reshape(-1, 6, 6)])
        motions = inverse(chain.poses[begin]) @ chain.poses[end]
        return cls(
            ends,
            np.searchsorted(ends, [*begin, *(x.first for x in loops)]),
            np.searchsorted(ends, [*end, *(x.second for x in loops)]),
            np.concatenate([motions, np.array([x.T_first_second for x in loops]).reshape(-1, 4, 4)]),
            _root_of_information(covariances),
            np.concatenate([common[end], np.zeros((len(loops), *common.shape[1:]))]),
            (noise, common),
        )

    def residuals(self, poses: Array, common: Array) -> Array:
        """What the motions (E, 6) of poses (M, 4, 4) differ by from the measured ones."""
        return log(inverse(self.motions) @ inverse(poses[self.a]) @ poses[self.b]) - self.common @ common

    def whitened(self, r: Array) -> Array:
        """Residuals (E, 6) of unit variance."""
        return np.asarray((self.roots @ r[:, :, None])[:, :, 0])

    def cost(self, poses: Array, common: Array) -> float:
        """The χ² of poses (M, 4, 4) and common errors (m,)."""
        return float(np.square(self.whitened(self.residuals(poses, common))).sum() + common @ common)

    def normal(self, poses: Array, common: Array) -> _Normal:
        """The normal equations about poses (M, 4, 4) and common errors (m,)."""
        r = self.residuals(poses, common)
        back = _by_perturbation(r + self.common @ common)
        W = np.swapaxes(self.roots, 1, 2) @ self.roots
        A = -back @ adjoints(inverse(poses[self.b]) @ poses[self.a])
        return _Normal.of(len(poses), self.a, self.b, A, back, -self.common, W, r, common)

    def optimised(self, poses: Array) -> tuple[Array, Array]:
        """Poses (M, 4, 4) and common errors (m,) of least χ², from poses (M, 4, 4)."""
        common = np.zeros(self.common.shape[2])
        cost = self.cost(poses, common)
        for _ in range(_ROUNDS):
            step, change = self.normal(poses, common).step()
            for half in 0.5 ** np.arange(_HALVINGS):
                moved = np.concatenate([poses[:1], poses[1:] @ exp(half * step)])
                less = self.cost(moved, common + half * change)
                if less <= cost:
                    break
            else:
                break
            poses, common, gain, cost = moved, common + half * change, cost - less, less
            if gain < _CONVERGED:
                break
        return poses, common


@dataclass(frozen=True)
class _Normal:
    """Normal equations of poses, sparse, and of common errors, dense.

    Attributes:
        solver: of the poses' own part (6 (M − 1), 6 (M − 1)).
        border: the part between poses and common errors (6 (M − 1), m).
        through: that part, solved for the poses.
        inner: covariance of the common errors (m, m).
        right: right side of the poses (6 (M − 1),).
        right_common: right side of the common errors (m,).
    """

    solver: SuperLU
    border: Array
    through: Array
    inner: Array
    right: Array
    right_common: Array

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
        r: Array,
        common: Array,
    ) -> _Normal:
        """Of residuals r (E, 6) with information W, by poses a and b (E,) of `count`, and by the common errors.

        Args:
            count: number of poses, the fixed first one included.
            a: rows of the first poses (E,).
            b: rows of the second poses (E,).
            A: derivatives by the first poses (E, 6, 6).
            B: by the second poses (E, 6, 6).
            C: by the common errors (E, 6, m).
            W: information (E, 6, 6).
            r: residuals (E, 6).
            common: the common errors (m,), with unit information about zero.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import splu

        m, size = C.shape[2], 6 * (count - 1)
        rows, columns, values = [], [], []
        border, right = np.zeros((count, 6, m)), np.zeros((count, 6))
        for i, X in ((a, A), (b, B)):
            XW = np.swapaxes(X, 1, 2) @ W
            np.add.at(border, i, XW @ C)
            np.add.at(right, i, -(XW @ r[:, :, None])[:, :, 0])
            for j, Y in ((a, A), (b, B)):
                both = (i > 0) & (j > 0)
                rows.append(np.repeat(6 * (i[both, None] - 1) + np.arange(6), 6, axis=1).ravel())
                columns.append(np.tile(6 * (j[both, None] - 1) + np.arange(6), 6).ravel())
                values.append((XW @ Y)[both].ravel())
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        solver = splu(coo_array(entries, shape=(size, size)).tocsc(), permc_spec="MMD_AT_PLUS_A", options=_SYMMETRIC)
        flat = border[1:].reshape(size, m)
        through = solver.solve(flat) if m else flat
        CW = np.swapaxes(C, 1, 2) @ W
        inner = np.linalg.inv(np.eye(m) + (CW @ C).sum(axis=0) - flat.T @ through)
        right_common = -(CW @ r[:, :, None]).sum(axis=0)[:, 0] - common
        return cls(solver, flat, through, inner, right[1:].ravel(), right_common)

    def step(self) -> tuple[Array, Array]:
        """Steps of the poses but the first (M − 1, 6), and of the common errors (m,)."""
        alone = self.solver.solve(self.right)
        change = self.inner @ (self.right_common - self.border.T @ alone)
        return (alone - self.through @ change).reshape(-1, 6), change

    def covariance(self, poses: Sequence[int]) -> Array:
        """Joint covariance (6 n + m, 6 n + m) of n poses, by their rows, and of the common errors."""
        size, m, n = len(self.right), len(self.inner), 6 * len(poses)
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


#: The matrix is symmetric and positive definite: no pivots are looked for off its diagonal.
_SYMMETRIC = {"SymmetricMode": True, "DiagPivotThresh": 0.0}


def _root_of_information(covariances: Array) -> Array:
    """Matrices R (E, 6, 6) with ``Rᵀ R`` the inverse of covariances (E, 6, 6), which rounding may have made none."""
    scale = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2) + LEAST_VARIANCE)
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
