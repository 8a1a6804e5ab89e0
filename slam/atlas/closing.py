"""Which loops are closed: those that agree with the path and with each other; of contradictory ones the largest set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import eigvalsh

from slam.atlas.atlas import Atlas
from slam.atlas.config import AtlasConfig
from slam.atlas.keyframes import Loop, distance
from slam.atlas.pose_graph import Chain, PoseGraph
from slam.chi_square import chi_square_limit
from slam.data import CommonError
from slam.geometry.se3 import Array, adjoint, inverse

_DIMENSIONS = 6  # fixed: mean of χ² of a pose
#: Largest squared Mahalanobis distance of a loop from the path alone: a number beyond five sigma is as rare. Drift
#: grows by errors that neighbouring frames share, of which the path's covariance is a model, so it may be somewhat too
#: small; and where right loops are refused the path stays wrong.
_FROM_PATH = chi_square_limit(_DIMENSIONS, 1 - 5.7e-7)
#: The same where loops speak, each a measurement of its own: one right loop in 3,000 is farther off, for which others
#: of its place stand in, while a lookalike that is let in bends the map.
_AMONG_LOOPS = chi_square_limit(_DIMENSIONS, 1 - 1 / 3000)


def close(atlas: Atlas, loop: Loop, rig: CommonError, same_view: bool) -> Atlas:
    """Close a loop that the last keyframe sees, if it agrees with the path and a keyframe shortly before saw the same.

    Else it is refused; one that cannot be judged, too. With `same_view` the camera sees the same from the same place,
    which is believed against the path: the covariance of the path between is then as much too small as the two
    disagree. The path is that of the keyframes as estimated at the time.
    """
    given, common = atlas, None if atlas.solved is None else atlas.solved.belief(rig)[0]
    between = any(x.first < loop.second and x.second > loop.first for x in atlas.loops)
    limit = _AMONG_LOOPS if between else _FROM_PATH

    def without_it(atlas: Atlas) -> tuple[Chain, PoseGraph]:
        """The path, and the graph without the loop."""
        chain = atlas.chain(rig)
        return chain, PoseGraph.solved(chain, atlas.loops, atlas.in_map(chain.poses), loop.pair, common)

    try:
        chain, graph = without_it(atlas)
        off = disagreement(graph, loop)
        if off > limit and not (same_view and np.isfinite(off)):
            return _refused(atlas, chain, loop, rig)
        atlas = replace(atlas, pending=loop, confirmed=_agree(chain, given.pending, loop))
        if not atlas.confirmed or (off <= limit and atlas.loops and not is_informative(graph, loop)):
            return atlas.with_inactive_loop(loop)
        if off > limit:
            atlas = atlas.inflated(loop.first, loop.second, off / _DIMENSIONS)
            chain, graph = without_it(atlas)
        # one that was the first may be farther off the path than those that came after it
        limits = np.where(graph.disagreement() > _AMONG_LOOPS, _FROM_PATH, _AMONG_LOOPS)
        graph = graph.with_loop(loop)
        if (graph.disagreement() > [*limits, limit]).any():
            return _refused(replace(atlas, pending=None), chain, loop, rig)
        return atlas.with_loop(loop).solved_by(graph, rig)
    except np.linalg.LinAlgError:
        return replace(given, refused=(*given.refused, loop.pair))


def _refused(atlas: Atlas, chain: Chain, loop: Loop, rig: CommonError) -> Atlas:
    """Refuse a loop that contradicts path and others, or the others if fewer places support them.

    Neither is refused if all that was seen of these places, solved together, agrees.
    """
    start = atlas.in_map(chain.poses)
    atlas = replace(atlas.with_inactive_loop(loop), refused=(*atlas.refused, loop.pair))
    if not atlas.loops:
        return atlas
    every, before = (*atlas.loops, *atlas.inactive_loops), {x.pair for x in atlas.loops}
    rival = agreeing(chain, every, loop, chain.poses)
    places = spaced(atlas, rival)
    contradicted = not before <= {x.pair for x in rival}
    if contradicted and len(places) <= len(spaced(atlas, agreeing(chain, every, atlas.loops[-1], start))):
        return atlas
    held = {x.pair: x for x in (*places, *(x for x in rival if x.pair in before), loop)}
    atlas = atlas.with_loops(sorted(held.values(), key=lambda x: x.second), rival)
    return atlas.solved_by(PoseGraph.solved(chain, atlas.loops, start), rig)


def _agree(chain: Chain, before: Loop | None, loop: Loop) -> bool:
    """Whether two loops, seen by keyframes shortly after each other, are consistent with each other."""
    if before is None or loop.second - before.second > 3:  # keyframes
        return False
    T_old, P_old = chain.motion(before.first, loop.first)
    T_new, P_new = chain.motion(before.second, loop.second)
    expected = inverse(T_old) @ before.T_first_second @ T_new
    back, far = adjoint(inverse(T_new)), adjoint(inverse(expected))
    P = back @ before.covariance @ back.T + P_new + loop.covariance + far @ P_old @ far.T
    return distance(expected, loop.T_first_second, P) < _AMONG_LOOPS


def is_informative(graph: PoseGraph, loop: Loop) -> bool:
    """Whether a loop is more certain than what path and loops so far say of it, in any direction.

    In a place that is seen again and again they soon know as much, and most loops add nothing.
    """
    return bool(eigvalsh(graph.relative_pose(*loop.pair)[1], loop.covariance)[-1] > 1.0)


def disagreement(graph: PoseGraph, loop: Loop) -> float:
    """Squared Mahalanobis distance of a loop that is not in the graph from the graph's relative pose."""
    T, P = graph.relative_pose(*loop.pair)
    return distance(T, loop.T_first_second, P + loop.covariance)


def agreeing(chain: Chain, loops: Sequence[Loop], seed: Loop, start: Array) -> list[Loop]:
    """Loops that agree with the path, with the seed and with each other, in order of their second keyframes.

    The set grows from the seed: the loops nearest to it on the path are tested first, then each time twice as many.
    Loops that join shrink the path's covariance, against which the next ones are tested. It is empty if the seed
    contradicts the path.

    `start` (K, 4, 4) are poses of all keyframes, at which the graph is first linearised.
    """
    others = sorted((x for x in loops if x is not seed), key=lambda x: (abs(x.second - seed.second), x.first))
    also = [k for x in others for k in x.pair]
    graph = PoseGraph.solved(chain, [], start, [*also, *seed.pair])
    if disagreement(graph, seed) > _FROM_PATH:
        return []
    members, begin, size = [seed], 0, 1
    graph = PoseGraph.solved(chain, members, start, also)
    while begin < len(others):
        joined = [x for x in others[begin : begin + size] if disagreement(graph, x) <= _AMONG_LOOPS]
        begin, size = begin + size, 2 * size
        while joined:
            whole = PoseGraph.solved(chain, [*members, *joined], start, also)
            off = whole.disagreement()
            if off[0] <= _FROM_PATH and (off[1:] <= _AMONG_LOOPS).all():
                members, graph = [*members, *joined], whole
                break
            del joined[int(np.argmax(off[len(members) :]))]
    return sorted(members, key=lambda x: x.second)


def spaced(atlas: Atlas, loops: Sequence[Loop]) -> list[Loop]:
    """One loop of each place, in order of the second keyframes.

    Loops at one place are not independent evidence: they see the same things, or the same lookalikes.
    """
    chosen: list[Loop] = []
    left = -np.inf  # length of the path at which the last one's place is left [m]
    for loop in sorted(loops, key=lambda x: x.second):
        keyframe = atlas.keyframes[loop.second]
        if keyframe.travelled > left:
            chosen.append(loop)
            left = keyframe.travelled + AtlasConfig.return_depths * keyframe.depth
    return chosen
