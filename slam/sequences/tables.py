"""Lists of stamps and file names, read row by row, faults named by file and row; and whether a true path is one."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from slam.checks import SINCE_1970, UNITS
from slam.errors import SequenceError, TrajectoryError
from slam.files import read_text
from slam.geometry.se3 import Array, is_rotation
from slam.geometry.trajectory import Trajectory
from slam.sequences.base import FaultLog

T = TypeVar("T")

#: Latest time [ns]: in the year 2262, where 64 bits end.
MOST_NANOSECONDS = 2**63 - 1

#: Largest coordinate of a true path [m]: the Earth's circumference.
LARGEST = 4.1e7

_ROTATION = 1e-2  # largest error of an element of RRᵀ: files have six digits and more
_MOST_SECONDS = 1e11  # of a time, either side of zero: in nanoseconds it would not fit into 64 bits long before
_SLOWEST, _USUAL = 10.0, 0.05  # [s] between frames: at most, else they are in another unit; by which it is found
_HEADING = re.compile(r"\D*(time|stamp|\bt\b|\bsec|\b[num]s\b)\D*", re.IGNORECASE)  # a first row that names the columns
_IMAGE = re.compile(r"\.(png|jpe?g|p[gp]m|bmp|tiff?|webp)$", re.IGNORECASE)
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?", re.ASCII)


def read_rows(path: Path, parse: Callable[[str], T], faults: FaultLog) -> list[T | None]:
    """What `parse` makes of the rows of a text, but comments and a heading; None for one refused with a ValueError."""
    rows: list[T | None] = []
    refused: list[str] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        content = line.strip()
        if not content or content.startswith("#") or (not rows and _HEADING.fullmatch(content)):
            continue
        try:
            rows.append(parse(content))
        except ValueError as error:
            rows.append(None)
            refused.append(f"{path}, row {number}: {error}")
    if not rows:
        raise SequenceError(f"{path}: the file has no rows")
    if 2 * len(refused) > len(rows):
        raise SequenceError(refused[0])
    for line in refused:
        faults.report(f"{path}: rows left out", f"{line}; row left out")
    return rows


class Times(NamedTuple):
    """A file of times."""

    path: Path
    rows: Array  # times by row [s], NaN for unreadable ones
    names: list[str]  # of the images by row, where all rows name one


def read_times(path: Path, faults: FaultLog) -> Times:
    """The times in a file.

    A row's time is its first number, or a date with the time; the second number where the first ones count rows. Times
    in a finer unit are known by their steps. SequenceError where a time is impossible.
    """
    names: list[str] = []

    def row(text: str) -> list[float]:
        names.extend(name for name in re.split(r"[,;\s/\\]+", text) if _IMAGE.search(name))
        return [*_numbers_in(text), np.nan][:2]

    rows = read_rows(path, row, faults)
    times, second = np.array([row or [np.nan, np.nan] for row in rows]).T
    counts = len(times) > 1 and times[0] % 1 == 0 and 0 <= times[0] < SINCE_1970[0] and (np.diff(times) == 1).all()
    if counts and (np.diff(second) > 0).all():
        faults.report("times", f"{path}: the first number of each row counts rows; the second one is taken as time")
        times = second
    told = times[np.isfinite(times)]
    since_1970 = len(told) > 0 and SINCE_1970[0] <= told[0] <= SINCE_1970[1]  # seconds, however far apart
    if not since_1970 and (step := np.median([0.0, *np.abs(np.diff(told))])) > _SLOWEST:  # as a camera's in that unit
        unit, size = min(UNITS, key=lambda one: abs(np.log(step / one[1] / _USUAL)))
        faults.report("times", f"{path}: the times are taken as {unit}")
        times = times / size
    if (np.abs(times) > _MOST_SECONDS).any():
        raise SequenceError(f"{path}: {times[np.abs(times) > _MOST_SECONDS][0]:g} is no possible time in seconds")
    return Times(path, np.asarray(times), names if len(set(names)) == len(rows) else [])


def _numbers_in(text: str) -> list[float]:
    """The numbers of a row, of which the first is finite; of one that begins with a date its time [s since 1970]."""
    if date := _DATE_TIME.match(text):
        return [1e-9 * date_time(date[0])]
    found: list[float] = []
    for word in re.split(r"[,;\s]+", text):
        with suppress(ValueError):
            found.append(float(word))
    if not found or not np.isfinite(found[0]):
        raise ValueError(f"{text!r:.40} is not a {'finite time' if found else 'time in seconds'}")
    return found


def date_time(text: str) -> int:
    """Nanoseconds since 1970 of ``2011-09-26 13:10:51.174740992``."""
    with suppress(ValueError):  # of the 31st of February
        if _DATE_TIME.fullmatch(text):
            return int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
    raise ValueError(f"{text!r:.40} is not a date and time")


def numbers(text: str, count: int, what: str) -> list[float]:
    """The first finite numbers of a row, so many; `what` it should be is said where it is not."""
    try:
        row = [float(word) for word in text.split()[:count]]
    except ValueError:
        raise ValueError(f"{text!r:.40} is not a row of numbers") from None
    if len(row) < count or not np.isfinite(row).all():
        raise ValueError(f"{text!r:.40} is not {what}")
    return row


def require_truth(path: Trajectory, source: Path) -> Trajectory:
    """The true path of a file; TrajectoryError where a rotation or position is impossible, or all positions zero."""
    if not len(path):
        raise TrajectoryError(f"{source}: no pose is left")
    improper = ~is_rotation(path.poses[:, :3, :3], _ROTATION)
    beyond = np.abs(path.positions).max(axis=1) > LARGEST
    for wrong, what in ((beyond, "position of pose {} is beyond the Earth"), (improper, "rotation of pose {} is none")):
        if wrong.any():
            raise TrajectoryError(f"{source}: the {what.format(int(np.argmax(wrong)))}")
    if len(path) > 1 and not path.positions.any():
        raise TrajectoryError(f"{source}: every position is zero")
    return path
