"""Where all keyframes are: the path between them, and what the loops say about it, by least squares (GTSAM).

Only keyframes at which a loop ends, the first and the last one are variables; the stretches between them are one factor
each, with the summed covariance of their steps. What a stretch is moved by is then shared out among its keyframes in
proportion to their covariances, which is what the whole problem would give, to first order.

Loads gtsam: imported where a loop is to be closed, not before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import LEAST_VARIANCE, Array, adjoint, inverse
from slam.mapping.atlas.chain import Chain, spread
from slam.mapping.atlas.loops import Loop

_FIXED = 1e-6  # standard deviation of the first keyframe's pose [rad], [m], which defines the map


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
    moved = np.array([values.atPose3(k).matrix() for k in problem.ends.tolist()])
    first = problem.graph.size() - len(loops)
    errors = np.array([2 * problem.graph.at(first + i).error(values) for i in range(len(loops))])
    last = np.asarray(gtsam.Marginals(problem.graph, values).marginalCovariance(int(problem.ends[-1])))
    return Solution(spread(chain, problem.ends, moved), last, errors)


def relative_pose(chain: Chain, loops: Sequence[Loop], start: Array, first: int, second: int) -> tuple[Array, Array]:
    """Pose (4, 4) of a keyframe in another one's coordinates, as path and loops say, and its covariance (6, 6)."""
    problem = _Problem.of(chain, loops, (first, second))
    values = problem.optimised(start) if loops else problem.values(start)
    T_first, T_second = (values.atPose3(k).matrix() for k in (first, second))
    joint = gtsam.Marginals(problem.graph, values).jointMarginalCovariance([first, second])
    J = np.concatenate([-adjoint(inverse(T_second) @ T_first), np.eye(6)], axis=1)
    P = np.block([[joint.at(i, j) for j in (first, second)] for i in (first, second)])
    return inverse(T_first) @ T_second, J @ P @ J.T


@dataclass(frozen=True)
class _Problem:
    """The factor graph, and the keyframes (M,) that are its variables."""

    graph: gtsam.NonlinearFactorGraph
    ends: NDArray[np.intp]

    @classmethod
    def of(cls, chain: Chain, loops: Sequence[Loop], also: Sequence[int]) -> _Problem:
        last = len(chain.poses) - 1
        ends = np.unique([0, last, *also, *(k for loop in loops for k in (loop.first, loop.second))]).astype(np.intp)
        graph = gtsam.NonlinearFactorGraph()
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
        graph.add(gtsam.PriorFactorPose3(0, _pose3(chain.poses[0]), fixed))
        carried = chain.carried(ends)
        for a, b in zip(ends[:-1].tolist(), ends[1:].tolist()):
            graph.add(_between(a, b, inverse(chain.poses[a]) @ chain.poses[b], carried[b]))
        for loop in loops:
            graph.add(_between(loop.first, loop.second, loop.T_first_second, loop.covariance))
        return cls(graph, ends)

    def values(self, start: Array) -> gtsam.Values:
        """The variables at poses of all keyframes (K, 4, 4)."""
        values = gtsam.Values()
        for k in self.ends.tolist():
            values.insert(k, _pose3(start[k]))
        return values

    def optimised(self, start: Array) -> gtsam.Values:
        """The least squares, from poses of all keyframes (K, 4, 4)."""
        return gtsam.LevenbergMarquardtOptimizer(self.graph, self.values(start)).optimize()


def _pose3(T: Array) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])


def _between(a: int, b: int, T: Array, covariance: Array) -> gtsam.BetweenFactorPose3:
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T) + LEAST_VARIANCE * np.eye(6))
    return gtsam.BetweenFactorPose3(a, b, _pose3(T), noise)
