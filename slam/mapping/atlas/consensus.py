"""Which of several contradictory loops are kept: the largest set that agrees with the path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.geometry.se3 import Array
from slam.mapping.atlas.chain import Chain
from slam.mapping.atlas.keyframes import Loop, distance
from slam.mapping.atlas.pose_graph import PoseGraph


def agreeing(chain: Chain, loops: Sequence[Loop], seed: Loop, start: Array, limit: float) -> list[Loop]:
    """Loops that agree with the path, with the seed and with each other, in order of their second keyframes.

    The set grows from the seed: the loops nearest to it on the path are tested first, then each time twice as many.
    Loops that join shrink the path's covariance, against which the next ones are tested. It is empty if the seed
    contradicts the path.

    Args:
        chain: the path.
        loops: to choose from.
        seed: the loop that must be in the set.
        start: poses (K, 4, 4) of all keyframes, at which the graph is first linearised.
        limit: largest squared Mahalanobis distance of a loop from the pose graph.
    """
    others = sorted((x for x in loops if x is not seed), key=lambda x: (abs(x.second - seed.second), x.first))
    also = [k for x in others for k in (x.first, x.second)]
    graph = PoseGraph.solved(chain, [], start, [*also, seed.first, seed.second])
    if disagreement(graph, seed) > limit:
        return []
    members, begin, size = [seed], 0, 1
    graph = PoseGraph.solved(chain, members, start, also)
    while begin < len(others):
        joined = [x for x in others[begin : begin + size] if disagreement(graph, x) <= limit]
        begin, size = begin + size, 2 * size
        while joined:
            whole = PoseGraph.solved(chain, [*members, *joined], start, also)
            off = whole.disagreement()
            if (off <= limit).all():
                members, graph = [*members, *joined], whole
                break
            del joined[int(np.argmax(off[len(members) :]))]
    return sorted(members, key=lambda x: x.second)


def disagreement(graph: PoseGraph, loop: Loop) -> float:
    """Squared Mahalanobis distance of a loop that is not in the graph from the graph's relative pose."""
    T, P = graph.relative_pose(loop.first, loop.second)
    return distance(T, loop.T_first_second, P + loop.covariance)


def spaced(loops: Sequence[Loop], travelled: Array, apart: Array) -> list[Loop]:
    """One loop of each place, in order of the second keyframes.

    Loops at one place are not independent evidence: they see the same things, or the same lookalikes.

    Args:
        loops: all of them.
        travelled: length of the path up to each keyframe (K,) [m].
        apart: distance from each keyframe (K,) [m], along the path, beyond which its place is left.
    """
    chosen: list[Loop] = []
    for loop in sorted(loops, key=lambda x: x.second):
        if not chosen or travelled[loop.second] - travelled[chosen[-1].second] > apart[chosen[-1].second]:
            chosen.append(loop)
    return chosen
