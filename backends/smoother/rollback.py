"""Restores the measurement log after a call that was interrupted.

Lists of rows only grow at their end or are replaced by new ones, so that their lengths are enough; arrays are copied.
Values of poses and measurements that were there before may have been revised since: the solver's are as good as those.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np

from backends.smoother.landmarks import Track
from backends.smoother.measurement_log import MeasurementLog


def snapshot(log: MeasurementLog) -> Callable[[], None]:
    """A function that puts the log back to how it is now."""
    parts = (log.path, log.measurements, log.landmarks, log.history)
    states = [_state(part) for part in parts]
    tracks = {slot: (track, *_of_track(track)) for slot, track in log.landmarks.tracks.items()}

    def restore() -> None:
        for part, state in zip(parts, states):
            _put_back(part, state)
        for track, count, rows, points, keys, stereo, factor in tracks.values():
            track.rows, track.points, track.keys = rows[:count], points[:count], keys[:count]
            track.stereo, track.factor = stereo, factor
        log.landmarks.tracks = {slot: entry[0] for slot, entry in tracks.items()}

    return restore


def _of_track(track: Track) -> tuple[int, list[int], list[Any], list[int], int, int]:
    """What may change of a track: the length of its lists, these, and the rest; there are hundreds, in every call."""
    return len(track.rows), track.rows, track.points, track.keys, track.stereo, track.factor


#: Arrays that only grow, and are revised in place: poses and measurements.
_GROWING = frozenset(("_stamps", "_poses", "_z", "_frame", "_landmark"))


def _state(part: Any) -> dict[str, Any]:
    """What is in the attributes of a part."""
    out: dict[str, Any] = {}
    for name, value in vars(part).items():
        if isinstance(value, np.ndarray) and name not in _GROWING:
            out[name] = value.copy()
        elif isinstance(value, list):
            out[name] = (value, len(value))
        elif isinstance(value, dict):
            out[name] = {key: (v, len(v)) if isinstance(v, list) else v for key, v in value.items()}
        else:
            out[name] = value
    return out


def _put_back(part: Any, state: dict[str, Any]) -> None:
    for name, value in state.items():
        if isinstance(value, dict):
            value = {key: _shortened(v) for key, v in value.items()}
        setattr(part, name, copy(_shortened(value)))


def _shortened(value: Any) -> Any:
    """A list as long as it was; anything else as it is."""
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], list):
        return value[0][: value[1]]
    return value
