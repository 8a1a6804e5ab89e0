"""A fixed lag: which variables leave the problem, so that neither a frame's cost nor memory grows with the run.

What leaves is marginalised (see `backends.smoother.marginal`), all at the values of that moment, and the solver is made
anew of what is left. So it is done for many poses together: a share of the lag.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from backends.smoother.held import Held
from backends.smoother.landmarks import Track
from backends.smoother.marginal import MarginalPrior, marginal_prior
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.solver import FAILURES, Change, Solver, SolverError
from backends.smoother.variables import pose_key, put, size_of

#: cost: Poses leave once so many are there as the lag and one part in so many of it.
_SHARE = 2


@dataclass(frozen=True)
class Rest:
    """The problem without what has left.

    Attributes:
        first: frame of the oldest pose.
        gone: landmark variables that have left.
        finished: tracks whose factor has become part of the prior.
        prior: what has left, on what stays.
        held: the oldest pose, where it is held.
        change: all factors and values for a new solver.
        slots: places of the old solver's factors in the change.
    """

    first: int
    gone: list[int]
    finished: list[Track]
    prior: MarginalPrior
    held: Held | None
    change: Change
    slots: dict[int, int]


def overdue(log: MeasurementLog, lag: int) -> int | None:
    """Frame of the oldest pose that shall stay, where it is time that others leave."""
    first = log.path.count - lag
    return first if first >= log.history.first + max(1, lag // _SHARE) else None


def without_old(log: MeasurementLog, solver: Solver, first: int, most: int) -> Rest:
    """Marginalise the poses before frame `first`, and landmark variables last measured before it.

    Those of landmarks that are not in the map any more leave, and those of others where there are more than `most`.
    Nothing is changed on record or in the solver; the prior that follows is put on record by the caller.

    Raises:
        SolverError: what leaves cannot be marginalised.
    """
    history, kept = log.history, Change()
    gone = _old_landmarks(log, first, most)
    leaving = {*map(pose_key, range(history.first, first)), *gone}
    touched, staying = gtsam.NonlinearFactorGraph(), set()
    slots: dict[int, int] = {}
    held_keys, keep = [] if history.held is None else [history.held.key], kept.factors.add
    for slot, factor in solver.factors():  # there are thousands
        keys = factor.keys()
        if leaving.isdisjoint(keys):
            slots[slot] = len(slots)
            keep(factor)
        elif keys != held_keys or not isinstance(factor, gtsam.PriorFactorPose3):
            touched.add(factor)  # but not what holds the oldest pose; a prior on that alone is a `CustomFactor`
            staying.update(keys)
    values = solver.values()
    if history.held is not None and history.held.pulled(values.atPose3(history.held.key).matrix()):
        values = _solved_together(kept.factors, touched, values)
    ordered = sorted(staying - leaving, key=lambda key: (-size_of(key), key))  # poses first
    prior = marginal_prior(touched, values, sorted(leaving), ordered)
    held = held_pose(log, prior, values)
    kept.factors.add(prior.factor())
    if held is not None:
        kept.factors.add(held.factor())
    for key in [*map(pose_key, range(first, log.path.count)), *history.explicit]:
        if key not in leaving:
            put(kept.values, key, values)
    oldest = pose_key(first)
    finished = [track for track in log.landmarks.tracks.values() if track.keys and track.keys[0] < oldest]
    return Rest(first, gone, finished, prior, held, kept, slots)


def held_pose(log: MeasurementLog, prior: MarginalPrior, values: gtsam.Values) -> Held | None:
    """The oldest pose, held where it stands; None where landmarks that are known in the world tell where that is."""
    if any(known.frame is None for known in log.history.known.values()):
        return None
    return prior.held(values.atPose3(prior.poses[0]).matrix())


def _solved_together(
    some: gtsam.NonlinearFactorGraph, others: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> gtsam.Values:
    """One step of Gauss-Newton with all variables linearised where they stand; none where it gains nothing.

    Raises:
        SolverError: gtsam failed.
    """
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(some)
    graph.push_back(others)
    mine = gtsam.Values()
    for key in graph.keyVector():
        put(mine, key, values)
    try:
        better = mine.retract(graph.linearize(mine).optimize())
        return better if graph.error(better) < graph.error(mine) else mine
    except FAILURES as error:
        raise SolverError(f"gtsam: {' '.join(str(error).split())[:200]}") from error


def _old_landmarks(log: MeasurementLog, first: int, most: int) -> list[int]:
    """Landmark variables to leave: last measured before frame `first`, those of erased landmarks and the surplus."""
    marks, history, frame = log.landmarks, log.history, log.measurements.frame
    used = marks.used()
    mapped = dict(zip(marks.serial[used].tolist(), marks.last[used].tolist()))
    old = []
    for key, rows in history.explicit.items():
        serial = history.owner[key]
        last = mapped.get(serial, int(frame[rows[-1]]) if rows else -1)
        if last < first:
            old.append((serial in mapped, last, key))
    erased = sum(not in_map for in_map, _, _ in old)
    surplus = len(history.explicit) - most
    return [key for _, _, key in sorted(old)[: max(erased, surplus)]]
