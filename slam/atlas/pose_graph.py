"""Pose graph: all keyframes' poses from the path and the loops, by least squares.

Variables are the poses of keyframes at which a loop ends, of the first and of the last one, and the common errors of
all motions. The stretch of path between two of these keyframes is one factor; its correction is then distributed among
the keyframes within, which to first order is the solution of the full problem.

Each motion of the path has two errors: noise of its own, and the rig's error, which all motions share. Along the path
the shared error adds up, while noise averages out, so the two are kept apart: with T the estimated motion,

    T_true = T exp(noise + C c),

where c are common errors of unit variance, the same for all steps (a consider state: Schmidt, 1966).

It is solved by Gauss-Newton. The normal equations of the poses are sparse (SciPy's SuperLU), bordered by dense ones of
the common errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam.atlas.keyframes import Loop
from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, exp, hat, inverse, log
from slam.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import SuperLU


@dataclass(frozen=True, eq=False)
class Chain:
    """The path of the keyframes as the back end estimated it, step by step."""

    poses: Array  # T_odom_left (K, 4, 4)
    # covariance (K, 6, 6) by noise of the motion from the keyframe before, perturbing on the right; the first has no
    # meaning
    steps: Array
    # derivative (K, 6, m) of the same motion by the common errors, which have unit variance; m is 0 by default
    common: Array = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        if self.common is None:
            object.__setattr__(self, "common", np.zeros((len(self.poses), 6, 0)))

    def propagated(self, ends: NDArray[np.intp]) -> tuple[Array, Array]:
        """Error accumulated from the begin of its stretch to each keyframe, perturbing the pose at the stretch's end.

        `ends` are the keyframes that bound the stretches, ascending, including the first and the last one. The errors
        are the covariance (K, 6, 6) by noise, and the derivative (K, 6, m) by the common errors.
        """
        number = np.arange(len(self.poses))
        end = ends[np.searchsorted(ends, number)]
        begin = ends[np.maximum(np.searchsorted(ends, number) - 1, 0)]
        A = adjoint(inverse(self.poses[end]) @ self.poses)
        parts = []
        for step in (A @ self.steps @ np.swapaxes(A, 1, 2), A @ self.common):
            step[ends[0]] = 0
            total = np.cumsum(step, axis=0)
            total -= total[begin]
            parts.append(total)
        return parts[0], parts[1]

    def motion(self, first: int, second: int) -> tuple[Array, Array]:
        """Motion (4, 4) from one keyframe to another, and its covariance (6, 6), perturbing on the right."""
        a, b = sorted((first, second))
        rows = slice(a, b + 1)
        part = Chain(self.poses[rows], self.steps[rows], self.common[rows])
        noise, common = (each[-1] for each in part.propagated(np.unique([0, b - a])))
        P = noise + common @ common.T
        T = inverse(self.poses[a]) @ self.poses[b]
        if first > second:
            A = adjoint(T)
            T, P = inverse(T), A @ P @ A.T
        return T, P


def spread(chain: Chain, ends: NDArray[np.intp], propagated: tuple[Array, Array], moved: Array, common: Array) -> Array:
    """Poses (K, 4, 4) of all keyframes, where those (M,) that bound stretches have `moved` to poses (M, 4, 4).

    Of a stretch's change each motion gets its part by the `common` errors (m,); the rest is distributed in proportion
    to the noise, see `Chain.propagated`.
    """
    number = np.arange(len(chain.poses))
    at = np.maximum(np.searchsorted(ends, number), 1) - 1  # row of each keyframe's stretch
    rest = inverse(chain.poses) @ chain.poses[ends[at + 1]]
    noise, expected = propagated[0], propagated[1] @ common
    change = log(inverse(chain.poses[ends[1:]]) @ chain.poses[ends[:-1]] @ inverse(moved[:-1]) @ moved[1:])
    whole = noise[ends[1:]] + LEAST_VARIANCE * np.eye(6)
    weight = np.linalg.solve(whole, (change - expected[ends[1:]])[:, :, None])
    part = expected + (noise @ weight[at])[:, :, 0]
    part[ends[0]] = 0
    part[ends[1:]] = change
    out = spread_over(moved[at], inverse(chain.poses[ends[:-1]])[at] @ chain.poses, rest, part)
    out[ends] = moved
    return out


def spread_over(begin: Array, motion: Array, rest: Array, change: Array) -> Array:
    """Poses (N, 4, 4) on stretches that begin at moved poses, by the estimated `motion` from there to the poses.

    The `change` (N, 6) of the motions perturbs the stretches' ends on the right, to which the path goes by `rest`.
    """
    return np.asarray(begin @ motion @ exp((adjoint(rest) @ change[:, :, None])[:, :, 0]))


def between_keyframes(path: Trajectory, stamps: Array, moved: Array, unseen_time: Callable[[Array], Array]) -> Array:
    """Poses (N, 4, 4) of a path whose keyframes, at `stamps` (K,) [s], are moved to other poses (K, 4, 4).

    Between two keyframes the change is interpolated in time; with a gap between them, over its `unseen_time` alone.
    """
    rows = np.searchsorted(path.stamps, stamps)
    odom = path.poses[rows]
    at = np.clip(np.searchsorted(stamps, path.stamps, side="right") - 1, 0, len(stamps) - 1)
    to = np.minimum(at + 1, len(stamps) - 1)
    step = inverse(odom[at]) @ odom[to]
    change = log(inverse(step) @ inverse(moved[at]) @ moved[to])
    since, span = (unseen_time(x) - unseen_time(stamps[at]) for x in (path.stamps, stamps[to]))
    seen = span <= 0
    since, span = np.where(seen, path.stamps - stamps[at], since), np.where(seen, stamps[to] - stamps[at], span)
    share = np.clip(since / np.where(to > at, span, 1.0), 0.0, 1.0)
    return spread_over(
        moved[at], inverse(odom[at]) @ path.poses, inverse(path.poses) @ odom[to], share[:, None] * change
    )


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Path and loops, with the poses and common errors that minimise χ²."""

    chain: Chain  # the path
    loops: tuple[Loop, ...]  # in the graph
    ends: NDArray[np.intp]  # keyframes (M,) whose poses are variables; the first one is fixed and defines the map
    propagated: tuple[Array, Array]  # errors within the stretches between them
    motions: _Motions  # the equations
    poses: Array  # T_map_left of the keyframes that are variables (M, 4, 4)
    common: Array  # the common errors (m,)
    normal: _Normal  # the normal equations near the solution

    @classmethod
    def solved(
        cls, chain: Chain, loops: Sequence[Loop], start: Array, also: Sequence[int] = (), common: Array | None = None
    ) -> PoseGraph:
        """The graph of a path and loops, solved from poses (K, 4, 4) of all keyframes and the common errors (m,).

        Keyframes `also` are variables besides those at which loops end. Raises LinAlgError where the equations are
        singular to working precision.
        """
        ends = np.unique([0, len(chain.poses) - 1, *also, *(k for x in loops for k in x.pair)]).astype(np.intp)
        propagated = chain.propagated(ends)
        motions = _Motions.of(chain, loops, ends, propagated)
        common = np.zeros(chain.common.shape[2]) if common is None else common
        return cls(chain, tuple(loops), ends, propagated, motions, *motions.optimised(start[ends], common))

    def with_loop(self, loop: Loop) -> PoseGraph:
        """The solved graph with one more loop, between keyframes that are variables."""
        loops = (*self.loops, loop)
        motions = _Motions.of(self.chain, loops, self.ends, self.propagated)
        start = min((self.poses, self._bent(loop)), key=lambda poses: motions.cost(poses, self.common))
        solution = motions.optimised(start, self.common)
        return PoseGraph(self.chain, loops, self.ends, self.propagated, motions, *solution)

    def _bent(self, loop: Loop) -> Array:
        """Poses (M, 4, 4) of the variables that satisfy a loop, its correction distributed along the path.

        A stretch that is hardly known takes nearly all of the correction, and the path after it moves rigidly, however
        far that is. A linear step in the single poses would bend that part.
        """
        noise, common = (each[self.ends] for each in self.propagated)
        path = Chain(self.poses, noise + common @ np.swapaxes(common, 1, 2))
        first, second = np.searchsorted(self.ends, loop.pair)
        ends = np.unique([0, first, second, len(self.poses) - 1])
        moved = self.poses[ends].copy()
        target = self.poses[first] @ loop.T_first_second
        moved[ends >= second] = target @ inverse(self.poses[second]) @ moved[ends >= second]
        return spread(path, ends, path.propagated(ends), moved, np.zeros(0))

    def relative_pose(self, first: int, second: int) -> tuple[Array, Array]:
        """Pose (4, 4) of a keyframe in another one's coordinates, and its covariance (6, 6); both are variables."""
        rows = np.searchsorted(self.ends, [first, second])
        T = inverse(self.poses[rows[0]]) @ self.poses[rows[1]]
        P = self.normal.covariance(rows.tolist())[:12, :12]
        J = np.concatenate([-adjoint(inverse(T)), np.eye(6)], axis=1)
        return T, J @ P @ J.T

    def disagreement(self) -> Array:
        """Disagreement of each loop with the graph (L,), χ² with 6 degrees of freedom."""
        return np.square(self.motions.residuals(self.poses, self.common)).sum(axis=1)[len(self.ends) - 1 :]

    def keyframe_poses(self) -> Array:
        """Poses T_map_left (K, 4, 4) of all keyframes."""
        return spread(self.chain, self.ends, self.propagated, self.poses, self.common)

    def covariance(self) -> Array:
        """Joint covariance (6 + m, 6 + m) of the last pose, perturbing on the right, and the common errors."""
        return self.normal.covariance([len(self.poses) - 1])


@dataclass(frozen=True, eq=False)
class _Motions:
    """Measured motions between poses (E): those of stretches of the path first, then those of loops."""

    a: NDArray[np.intp]  # rows of the poses (E,): a motion is the pose of b in the coordinates of a
    b: NDArray[np.intp]
    measured: Array  # (E, 4, 4)
    roots: Array  # square roots of their information (E, 6, 6): a residual r costs |root r|²
    common: Array  # derivative of the motions by the common errors (E, 6, m)

    @classmethod
    def of(cls, chain: Chain, loops: Sequence[Loop], ends: NDArray[np.intp], errors: tuple[Array, Array]) -> _Motions:
        begin, end = ends[:-1], ends[1:]
        noise, common = (part[end] for part in errors)
        covariances = np.concatenate([noise, np.array([x.covariance for x in loops]).reshape(-1, 6, 6)])
        motions = inverse(chain.poses[begin]) @ chain.poses[end]
        return cls(
            np.searchsorted(ends, [*begin, *(x.first for x in loops)]),
            np.searchsorted(ends, [*end, *(x.second for x in loops)]),
            np.concatenate([motions, np.array([x.T_first_second for x in loops]).reshape(-1, 4, 4)]),
            _root_of_information(covariances),
            np.concatenate([common, np.zeros((len(loops), *common.shape[1:]))]),
        )

    def residuals(self, poses: Array, common: Array) -> Array:
        """Residuals (E, 6) of unit variance: motions of poses (M, 4, 4) less the measured and corrected ones."""
        r = log(inverse(self.measured) @ inverse(poses[self.a]) @ poses[self.b]) - self.common @ common
        return np.asarray((self.roots @ r[:, :, None])[:, :, 0])

    def cost(self, poses: Array, common: Array) -> float:
        """The χ² of poses (M, 4, 4) and common errors (m,)."""
        return float(np.square(self.residuals(poses, common)).sum() + common @ common)

    def normal(self, poses: Array) -> _Normal:
        """The normal equations about poses (M, 4, 4)."""
        back = self.roots @ _by_perturbation(log(inverse(self.measured) @ inverse(poses[self.a]) @ poses[self.b]))
        by_a = -back @ adjoint(inverse(poses[self.b]) @ poses[self.a])
        return _Normal.of(len(poses), self.a, self.b, by_a, back, -self.roots @ self.common)

    def optimised(self, poses: Array, common: Array) -> tuple[Array, Array, _Normal]:
        """Poses (M, 4, 4) and common errors (m,) that minimise χ², and normal equations near there."""
        cost = self.cost(poses, common)
        for _ in range(30):  # most graphs need one to nine; the bound is for steps that are halved again and again
            normal = self.normal(poses)
            step, change = normal.step(self.residuals(poses, common), common)
            for half in 0.5 ** np.arange(8):  # of a step that increases χ²
                moved = np.concatenate([poses[:1], poses[1:] @ exp(half * step)])
                less = self.cost(moved, common + half * change)
                if less <= cost:
                    break
            else:
                break
            poses, common, gain, cost = moved, common + half * change, cost - less, less
            if gain < 1e-3 and half == 1:  # far below 1, a standard deviation's; a halved step may gain little anywhere
                break
        return poses, common, normal


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of poses but the first, sparse, and of common errors with unit prior information, dense."""

    solver: SuperLU  # of the poses' own part (6 (M − 1), 6 (M − 1))
    J: csr_array  # derivatives of the residuals by the poses (6 E, 6 (M − 1))
    C: Array  # by the common errors (6 E, m)
    through: Array  # the part between poses and common errors, solved for the poses (6 (M − 1), m)
    inner: Array  # covariance of the common errors (m, m)

    @classmethod
    def of(cls, count: int, a: NDArray[np.intp], b: NDArray[np.intp], A: Array, B: Array, C: Array) -> _Normal:
        """Of `count` poses, from derivatives (E, 6, 6) of residuals by poses a and b, and (E, 6, m) by common errors.

        Raises LinAlgError where they are singular, or not finite.
        """
        from scipy.sparse import bsr_array
        from scipy.sparse.linalg import splu

        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise np.linalg.LinAlgError("pose graph: a number is not finite")
        blocks = np.stack([A, B], axis=1).reshape(-1, 6, 6), np.stack([a, b], axis=1).ravel(), 2 * np.arange(len(a) + 1)
        J, C = bsr_array(blocks, (6 * len(a), 6 * count)).tocsr()[:, 6:], C.reshape(6 * len(a), -1)
        try:
            solver = splu((J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", options=_SYMMETRIC)
        except RuntimeError as error:  # SuperLU's word for it
            raise np.linalg.LinAlgError(f"pose graph: {error}") from error
        through = solver.solve(J.T @ C) if C.shape[1] else np.zeros((J.shape[1], 0))
        rest = C - J @ through  # Schur complement as a square, not as a difference of large squares
        # Part of a covariance, and used in every step; m is small.
        return cls(solver, J, C, through, np.linalg.inv(np.eye(C.shape[1]) + rest.T @ rest))

    def step(self, residuals: Array, common: Array) -> tuple[Array, Array]:
        """Steps of the poses but the first (M − 1, 6) and of the common errors (m,), from residuals (E, 6)."""
        r = residuals.ravel()
        alone = -self.solver.solve(self.J.T @ r)
        change = -self.inner @ (self.C.T @ (r + self.J @ alone) + common)
        return (alone - self.through @ change).reshape(-1, 6), change

    def covariance(self, poses: Sequence[int]) -> Array:
        """Joint covariance (6 n + m, 6 n + m) of n poses, given by their rows, and of the common errors."""
        m, n = len(self.inner), 6 * len(poses)
        rows = (6 * np.array(poses)[:, None] + np.arange(6)).ravel()
        picked = (6 + np.arange(len(self.through))[:, None] == rows).astype(float)  # the first pose is fixed
        by_common = -picked.T @ self.through
        P = np.zeros((n + m, n + m))
        P[:n, :n] = picked.T @ self.solver.solve(picked) + by_common @ self.inner @ by_common.T
        P[:n, n:] = by_common @ self.inner
        P[n:, :n], P[n:, n:] = P[:n, n:].T, self.inner
        return 0.5 * (P + P.T)


#: The matrix is symmetric and positive definite, so pivots are taken from the diagonal.
_SYMMETRIC = {"SymmetricMode": True, "DiagPivotThresh": 0.0}


def _root_of_information(covariances: Array) -> Array:
    """Matrices R (E, 6, 6) with ``Rᵀ R`` the inverse of covariances (E, 6, 6), some of which may be singular.

    The noise of single steps can be zero in some directions (see `slam.atlas.keyframes`). Such directions get a
    least variance, because exact steps would make the normal equations numerically singular.
    """
    covariances = covariances + LEAST_VARIANCE * np.eye(6)
    scale = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    values, vectors = np.linalg.eigh(covariances / (scale[:, :, None] * scale[:, None, :]))
    roots = vectors / np.sqrt(np.maximum(values, LEAST_VARIANCE))[:, None, :]
    return np.asarray(np.swapaxes(roots, 1, 2) / scale[:, None, :])


def _by_perturbation(xi: Array) -> Array:
    """Derivatives (E, 6, 6) of ``log(exp(ξ) exp(δ))`` by δ at 0, to second order of ξ (E, 6)."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = hat(xi[:, :3])
    ad[:, 3:, :3] = hat(xi[:, 3:])
    return np.asarray(np.eye(6) + 0.5 * ad + ad @ ad / 12)
