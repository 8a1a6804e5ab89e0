"""A fixed lag: which variables leave the problem, so that neither a frame's cost nor memory grows with the run.

What leaves is marginalised (see `backends.smoother.marginal`), all at the values of that moment, and the solver is made
anew of what is left. So it is done for many poses together: a share of the lag.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from backends.smoother.marginal import MarginalPrior, marginal_prior
from backends.smoother.measurement_log import MeasurementLog, Track
from backends.smoother.solver import Change, Solver
from backends.smoother.variables import pose_key, put, size_of

#: Poses leave once so many are there as the lag and one part in so many of it.
_SHARE = 4


@dataclass(frozen=True)
class Rest:
    """The problem without what has left.

    Attributes:
        first: frame of the oldest pose.
        gone: landmark variables that have left.
        finished: tracks whose factor has become part of the prior.
        prior: what has left, on what stays.
        change: all factors and values for a new solver; the prior is the last of the factors.
        slots: places of the old solver's factors in the change.
    """

    first: int
    gone: list[int]
    finished: list[Track]
    prior: MarginalPrior
    change: Change
    slots: dict[int, int]


def overdue(measurement_log: MeasurementLog, lag: int) -> int | None:
    """Frame of the oldest pose that shall stay, where it is time that others leave."""
    first = measurement_log.path.count - lag
    return first if first >= measurement_log.history.first + max(1, lag // _SHARE) else None


def without_old(measurement_log: MeasurementLog, solver: Solver, first: int, most: int) -> Rest:
    """Marginalise the poses before frame `first`, and landmark variables last measured before it.

    Those of landmarks that are not in the map any more leave, and those of others where there are more than `most`.
    Nothing is changed on record or in the solver; the prior that follows is put on record by the caller.

    Raises:
        SolverError: what leaves cannot be marginalised.
    """
    history, values, kept = measurement_log.history, solver.values(), Change()
    gone = _old_landmarks(measurement_log, first, most)
    leaving = {*map(pose_key, range(history.first, first)), *gone}
    touched, slots, staying = gtsam.NonlinearFactorGraph(), {}, set()
    for slot, factor in solver.factors():
        keys = factor.keys()
        if leaving.isdisjoint(keys):
            slots[slot] = kept.factors.size()
            kept.factors.add(factor)
        else:
            touched.add(factor)
            staying.update(keys)
    ordered = sorted(staying - leaving, key=lambda key: (-size_of(key), key))  # poses first
    prior = marginal_prior(touched, values, sorted(leaving), ordered)
    kept.factors.add(prior.factor())
    for key in [*map(pose_key, range(first, measurement_log.path.count)), *history.explicit]:
        if key not in leaving:
            put(kept.values, key, values)
    oldest = pose_key(first)
    finished = [track for track in measurement_log.landmarks.tracks.values() if track.keys and track.keys[0] < oldest]
    return Rest(first, gone, finished, prior, kept, slots)


def _old_landmarks(measurement_log: MeasurementLog, first: int, most: int) -> list[int]:
    """Landmark variables to leave: last measured before frame `first`, those of erased landmarks and the surplus."""
    marks, history, frame = measurement_log.landmarks, measurement_log.history, measurement_log.measurements.frame
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
