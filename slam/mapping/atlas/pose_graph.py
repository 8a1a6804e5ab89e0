"""Where all keyframes are: the path between them, and what the loops say about it, by least squares (GTSAM).

Only keyframes at which a loop ends, the first and the last one are variables; the stretches between them are one factor
each, with the summed covariance of their steps. What a stretch is moved by is then shared out among its keyframes in
proportion to their covariances, which is what the whole problem would give, to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import Array, adjoint, exp, hat, inverse, log
from slam.mapping.atlas.loops import Loop

_FIXED = 1e-6  # standard deviation of the first keyframe's pose [rad], [m], which defines the map
_LEAST = 1e-12  # variance [rad², m²] that keeps a factor's covariance invertible


@dataclass(frozen=True)
class Chain:
    """The path of the keyframes as the back end estimated it, step by step.

    Attributes:
        poses: T_odom_left (K, 4, 4).
        steps: covariance (K, 6, 6) of the motion from the keyframe before, perturbing on the right; the first has no
            meaning.
    """

    poses: Array
    steps: Array

    def carried(self, ends: NDArray[np.intp]) -> Array:
        """Covariance (K, 6, 6) of each keyframe within its stretch, seen from where the stretch ends.

        Args:
            ends: the keyframes that bound stretches, ascending, the first and the last one among them.
        """
        number = np.arange(len(self.poses))
        end = ends[np.searchsorted(ends, number)]
        A = _adjoints(inverse(self.poses[end]) @ self.poses)
        Q = A @ self.steps @ np.swapaxes(A, 1, 2)
        Q[ends[0]] = 0
        total = np.cumsum(Q, axis=0)
        begin = ends[np.maximum(np.searchsorted(ends, number) - 1, 0)]
        return np.asarray(total - total[begin])

    def motion(self, first: int, second: int) -> tuple[Array, Array]:
        """Motion (4, 4) from one keyframe to another, and its covariance (6, 6), perturbing on the right."""
        a, b = sorted((first, second))
        part = Chain(self.poses[a : b + 1], self.steps[a : b + 1])
        P = part.carried(np.unique([0, b - a]))[-1]
        T = inverse(self.poses[first]) @ self.poses[second]
        if first > second:
            A = adjoint(inverse(T))
            P = A @ P @ A.T
        return T, P


@dataclass(frozen=True)
class Solution:
    """The keyframes' poses.

    Attributes:
        poses: T_map_left (K, 4, 4).
        covariance: of the last one (6, 6), perturbing on the right.
        disagreement: of each loop with the whole, as a χ² of 6 degrees of freedom (L,).
    """

    poses: Array
    covariance: Array
    disagreement: Array


def solve(chain: Chain, loops: Sequence[Loop], start: Array) -> Solution:
    """Poses of all keyframes, given the path and the loops.

    Args:
        chain: the path.
        loops: at least one.
        start: poses (K, 4, 4) to linearise at first.
    """
    problem = _Problem.of(chain, loops, ())
    values = problem.optimised(start)
    import gtsam

    moved = np.array([values.atPose3(int(k)).matrix() for k in problem.ends])
    marginals = gtsam.Marginals(problem.graph, values)
    errors = [2 * problem.graph.at(problem.graph.size() - len(loops) + i).error(values) for i in range(len(loops))]
    last = np.asarray(marginals.marginalCovariance(int(problem.ends[-1])))
    return Solution(_spread(chain, problem.ends, moved), last, np.array(errors))


def relative_pose(chain: Chain, loops: Sequence[Loop], start: Array, first: int, second: int) -> tuple[Array, Array]:
    """Pose (4, 4) of a keyframe in another one's coordinates, as path and loops say, and its covariance (6, 6)."""
    import gtsam

    problem = _Problem.of(chain, loops, (first, second))
    values = problem.optimised(start) if loops else problem.values(start)
    T_first, T_second = (values.atPose3(k).matrix() for k in (first, second))
    joint = gtsam.Marginals(problem.graph, values).jointMarginalCovariance([first, second])
    back = _adjoints((inverse(T_second) @ T_first)[None])[0]
    J = np.concatenate([-back, np.eye(6)], axis=1)
    P = np.block([[joint.at(i, j) for j in (first, second)] for i in (first, second)])
    return inverse(T_first) @ T_second, J @ P @ J.T


@dataclass(frozen=True)
class _Problem:
    """The factor graph, and the keyframes (M,) that are its variables."""

    graph: object
    ends: NDArray[np.intp]

    @classmethod
    def of(cls, chain: Chain, loops: Sequence[Loop], also: Sequence[int]) -> _Problem:
        import gtsam

        last = len(chain.poses) - 1
        ends = np.unique([0, last, *also, *(k for loop in loops for k in (loop.first, loop.second))]).astype(np.intp)
        graph = gtsam.NonlinearFactorGraph()
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
        graph.add(gtsam.PriorFactorPose3(int(ends[0]), _pose3(chain.poses[ends[0]]), fixed))
        carried = chain.carried(ends)
        for a, b in zip(ends[:-1].tolist(), ends[1:].tolist()):
            graph.add(_between(a, b, inverse(chain.poses[a]) @ chain.poses[b], carried[b]))
        for loop in loops:
            graph.add(_between(loop.first, loop.second, loop.T_first_second, loop.covariance))
        return cls(graph, ends)

    def values(self, start: Array):
        import gtsam

        values = gtsam.Values()
        for k in self.ends.tolist():
            values.insert(k, _pose3(start[k]))
        return values

    def optimised(self, start: Array):
        import gtsam

        return gtsam.LevenbergMarquardtOptimizer(self.graph, self.values(start)).optimize()


def _spread(chain: Chain, ends: NDArray[np.intp], moved: Array) -> Array:
    """Poses (K, 4, 4) of all keyframes, from those of some (M, 4, 4): each stretch's change is shared out."""
    number = np.arange(len(chain.poses))
    at = np.maximum(np.searchsorted(ends, number), 1)
    begin, end = ends[at - 1], ends[at]
    carried = chain.carried(ends)
    a = inverse(chain.poses[begin])
    step = a @ chain.poses[end]
    change = log(inverse(step) @ inverse(moved[at - 1]) @ moved[at])
    whole = carried[end] + _LEAST * np.eye(6)
    part = (carried @ np.linalg.solve(whole, change[:, :, None]))[:, :, 0]
    part[ends[0]] = 0
    part[ends[1:]] = change[ends[1:]]
    out = shared_out(moved[at - 1], a @ chain.poses, inverse(chain.poses) @ chain.poses[end], part)
    out[ends] = moved
    return out


def shared_out(begin: Array, motion: Array, rest: Array, change: Array) -> Array:
    """Poses (N, 4, 4) on stretches whose ends move.

    Args:
        begin: the moved poses (N, 4, 4) at which their stretches begin.
        motion: from there to the poses (N, 4, 4), as it was estimated.
        rest: from the poses to where their stretches end (N, 4, 4).
        change: of the motions (N, 6), perturbing on the right the poses at which the stretches end.
    """
    return np.asarray(begin @ motion @ exp((_adjoints(rest) @ change[:, :, None])[:, :, 0]))


def _adjoints(T: Array) -> Array:
    """Adjoints (N, 6, 6) of poses (N, 4, 4)."""
    out = np.zeros((len(T), 6, 6))
    R = T[:, :3, :3]
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return out


def _pose3(T: Array):
    import gtsam

    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])


def _between(a: int, b: int, T: Array, covariance: Array):
    import gtsam

    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T) + _LEAST * np.eye(6))
    return gtsam.BetweenFactorPose3(a, b, _pose3(T), noise)
