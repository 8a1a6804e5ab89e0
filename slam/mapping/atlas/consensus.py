"""Which loops are believed where some contradict others: those of the largest set that agrees with the path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.geometry.se3 import Array
from slam.mapping.atlas.chain import Chain
from slam.mapping.atlas.keyframes import Loop, distance
from slam.mapping.atlas.pose_graph import PoseGraph


def agreeing(chain: Chain, loops: Sequence[Loop], seed: Loop, start: Array, limit: float) -> list[Loop]:
    """The loops that agree with the path, with one of them and with each other, by their second keyframes; maybe none.

    The set grows from the seed: loops nearest to it on the path are tried first, then twice as many as the set was
    asked before. What joins sharpens the path's covariance, against which the next ones are tested.

    Args:
        chain: the path.
        loops: the others.
        seed: the one that must be among them.
        start: poses (K, 4, 4) of all keyframes to linearise at first.
        limit: largest squared Mahalanobis distance of a pose from what path and loops say of it.
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
    """Squared Mahalanobis distance of a loop, which the graph does not hold, from what it says of both keyframes."""
    T, P = graph.relative_pose(loop.first, loop.second)
    return distance(T, loop.T_first_second, P + loop.covariance)


def spaced(loops: Sequence[Loop], travelled: Array, apart: Array) -> list[Loop]:
    """Those loops, in order of their second keyframes, that show another place than the last one did.

    Keyframes of one place see the same things, be it the same houses again or others that look like them: together
    they are one witness.

    Args:
        loops: all of them.
        travelled: length of the path up to each keyframe (K,) [m].
        apart: way from each keyframe (K,) [m] after which its place is left.
    """
    chosen: list[Loop] = []
    for loop in sorted(loops, key=lambda x: x.second):
        if not chosen or travelled[loop.second] - travelled[chosen[-1].second] > apart[chosen[-1].second]:
            chosen.append(loop)
    return chosen
