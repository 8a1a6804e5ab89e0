"""A fixed lag: which variables are marginalised, so that neither a frame's cost nor memory grows with the run.

They are marginalised (see `backends.smoother.marginal`) at their present values, and a new solver is built of the rest.
That is costly, so it is done for many poses together: a share of the lag.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from backends.smoother.marginal import MarginalPrior, marginal_prior
from backends.smoother.measurement_log import MeasurementLog
from backends.smoother.reference_pose import ReferencePose
from backends.smoother.solver import FAILURES, Change, Solver, SolverError
from backends.smoother.variables import pose_key, put, size_of

#: cost: Poses leave once so many are there as the lag and one part in so many of it.
_SHARE = 2


@dataclass(frozen=True, eq=False)
class Marginalised:
    """The problem after marginalisation.

    Attributes:
        first: frame of the oldest pose.
        gone: landmark variables that were marginalised.
        finished: landmarks, by slot, whose track's factor has become part of the prior.
        prior: what the marginalised part says of the rest.
        held: the oldest pose, if it is held; else None.
        change: all factors and values for a new solver.
        slots: places of the old solver's factors in the change.
    """

    first: int
    gone: list[int]
    finished: list[int]
    prior: MarginalPrior
    held: ReferencePose | None
    change: Change
    slots: dict[int, int]


def overdue(log: MeasurementLog, lag: int | None, coming: int = 0) -> int | None:
    """Frame of the oldest pose to keep, if it is time to marginalise others, or is when `coming` more are there."""
    if lag is None:
        return None
    first = log.path.count + coming - lag
    return first if first >= log.history.first + max(1, lag // _SHARE) else None


def without_old(log: MeasurementLog, solver: Solver, first: int, most: int) -> Marginalised:
    """Marginalise the poses before frame `first`, and landmark variables last measured before it.

    Those of erased landmarks leave, and of the others the oldest if there are more than `most`.
    Neither log nor solver is changed; the caller enters the prior in the log.

    Raises:
        SolverError: the variables cannot be marginalised.
    """
    history, kept = log.history, Change()
    gone = _old_landmarks(log, first, most)
    leaving = {*map(pose_key, range(history.first, first)), *gone}
    touched, staying = gtsam.NonlinearFactorGraph(), set()
    slots: dict[int, int] = {}
    held_keys, keep = [] if history.reference is None else [history.reference.key], kept.factors.add
    for slot, factor in solver.factors():  # there are thousands
        keys = factor.keys()
        if leaving.isdisjoint(keys):
            slots[slot] = len(slots)
            keep(factor)
        elif keys != held_keys or not isinstance(factor, gtsam.PriorFactorPose3):
            touched.add(factor)  # but not what holds the oldest pose; a prior on that alone is a `CustomFactor`
            staying.update(keys)
    values = solver.values()
    if history.reference is not None and history.reference.is_strained(values.atPose3(history.reference.key).matrix()):
        values = _solved_together(kept.factors, touched, values)
    ordered = sorted(staying - leaving, key=lambda key: (-size_of(key), key))  # poses first
    prior = marginal_prior(touched, values, sorted(leaving), ordered)
    held = reference_pose(log, prior, values)
    kept.factors.add(prior.factor())
    if held is not None:
        kept.factors.add(held.factor())
    for key in [*map(pose_key, range(first, log.path.count)), *history.explicit]:
        if key not in leaving:
            put(kept.values, key, values)
    oldest = pose_key(first)
    finished = [slot for slot, track in log.landmarks.tracks.items() if track.keys and track.keys[0] < oldest]
    return Marginalised(first, gone, finished, prior, held, kept, slots)


def reference_pose(log: MeasurementLog, prior: MarginalPrior, values: gtsam.Values) -> ReferencePose | None:
    """The oldest pose, held where it is; None if landmarks with a prior in the world fix it already."""
    if any(known.frame is None for known in log.history.known.values()):
        return None
    return prior.held(values.atPose3(prior.poses[0]).matrix())


def _solved_together(
    some: gtsam.NonlinearFactorGraph, others: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> gtsam.Values:
    """One step of Gauss-Newton with all variables linearised at their values; no step if it gains nothing.

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
    """Landmark variables to marginalise: last measured before frame `first`, erased from the map or surplus."""
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
