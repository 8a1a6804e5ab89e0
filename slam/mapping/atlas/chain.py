"""The keyframes' path as relative motions with covariances, and how moving its ends moves the poses between.

Each motion has two errors: noise of its own, and the rig's error, which all motions share. Along the path the shared
error adds up, while noise averages out, so the two are kept apart: with T the estimated motion,

    T_true = T exp(noise + C c),

where c are common errors of unit variance, the same for all steps (a consider state: Schmidt, 1966).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, exp, inverse, log
from slam.geometry.trajectory import Trajectory


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
    """Poses (K, 4, 4) of all keyframes, from those that bound stretches: each stretch's change is distributed.

    Each motion gets its part by the common errors; the rest is distributed in proportion to the noise.

    `ends` (M,) are the keyframes that bound stretches, `moved` (M, 4, 4) their new poses, `common` (m,) the common
    errors; for `propagated` see `Chain.propagated`.
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
    """Poses (N, 4, 4) on stretches whose ends move.

    Args:
        begin: the moved poses (N, 4, 4) at which their stretches begin.
        motion: estimated motion from there to the poses (N, 4, 4).
        rest: estimated motion from the poses to the ends of their stretches (N, 4, 4).
        change: of the motions (N, 6), perturbing the poses at the stretches' ends on the right.
    """
    return np.asarray(begin @ motion @ exp((adjoint(rest) @ change[:, :, None])[:, :, 0]))


def between_keyframes(path: Trajectory, stamps: Array, moved: Array, unseen_time: Callable[[Array], Array]) -> Array:
    """Poses (N, 4, 4) of a path whose keyframes, at `stamps` (K,) [s], are moved to other poses (K, 4, 4).

    Between two keyframes the change is interpolated in time; if there was a gap between them, all
    of it is put into the gap, of which `unseen_time` gives the duration.
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
