"""Restores the measurement log after an interrupted call.

Lists of rows only grow at their end or are replaced, so it is enough to keep their lengths; arrays are copied, and so
are dictionaries, whose values are never changed unless they are lists. Earlier poses may have been revised since; these
newer values are as good.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np

from backends.smoother.measurement_log import MeasurementLog


def snapshot(log: MeasurementLog) -> Callable[[], None]:
    """A function that restores the log to its present state."""
    parts = (log.path, log.measurements, log.landmarks, log.history)
    states = [_state(part) for part in parts]

    def restore() -> None:
        for part, state in zip(parts, states):
            _put_back(part, state)

    return restore


#: Arrays that only grow, and are revised in place: poses and measurements.
_GROWING = frozenset(("_stamps", "_poses", "_z", "_frame", "_landmark"))


def _state(part: Any) -> dict[str, Any]:
    """The values of a part's attributes."""
    out: dict[str, Any] = {}
    for name, value in vars(part).items():
        if isinstance(value, np.ndarray) and name not in _GROWING:
            out[name] = value.copy()
        elif isinstance(value, list):
            out[name] = (value, len(value))
        elif isinstance(value, dict):  # all values of one are of the same type
            lists = isinstance(next(iter(value.values()), None), list)
            out[name] = (value.copy(), [len(v) for v in value.values()] if lists else None)
        else:
            out[name] = value
    return out


def _put_back(part: Any, state: dict[str, Any]) -> None:
    for name, value in state.items():
        setattr(part, name, copy(_as_it_was(value)))


def _as_it_was(value: Any) -> Any:
    """A list, or the lists in a dictionary, cut to their former length; anything else as it is."""
    if not isinstance(value, tuple):
        return value
    before, length = value
    if isinstance(before, list):
        return before[:length]
    return before if length is None else {key: v[:n] for (key, v), n in zip(before.items(), length)}
