"""Lists of stamps and file names, read row by row, faults named by file and row; and whether a true path is one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from slam.errors import SequenceError, TrajectoryError
from slam.files import read_text
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.sequences.faults import FaultLog

T = TypeVar("T")

#: Latest time [ns]: in the year 2262, where 64 bits end.
MOST_NANOSECONDS = 2**63 - 1

#: Largest coordinate of a true path [m]: the Earth's circumference.
LARGEST = 4.1e7

_ROTATION = 1e-2  # largest error of an element of RᵀR: files have six digits and more
_MOST_SECONDS = 1e11  # of a time, either side of zero: in nanoseconds it would not fit into 64 bits long before
_EARLIEST, _LATEST = 1e8, 1e10  # of a likely time since 1970 [s]: 1973 to 2286
_UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?", re.ASCII)


def read_rows(path: Path, parse: Callable[[str], T], faults: FaultLog) -> list[T | None]:
    """The rows of a text file; blank lines and ``#`` comments do not count.

    A row that `parse` refuses with a ValueError is reported and stands as None, so that row numbers keep their meaning.
    SequenceError where the file cannot be read or holds no row, or where more than half of its rows are refused.
    """
    rows: list[T | None] = []
    refused: list[str] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        content = line.strip()
        if not content or content.startswith("#"):
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


def read_times(path: Path, faults: FaultLog) -> Array:
    """The times in a file by row [s], NaN for unreadable ones.

    A row's time is its first number, whatever names stand beside it; the second one where the first ones count rows.
    """
    rows = read_rows(path, _numbers_in, faults)
    table = np.array([(*(row or ())[:2], np.nan, np.nan)[:2] for row in rows])
    first, second = table.T
    if len(table) > 1 and (np.diff(first) == 1).all() and (np.diff(second) > 0).all() and first[0] in (0, 1):
        faults.report("times", f"{path}: the first number of each row counts rows; the second one is taken as time")
        return second
    return first


def _numbers_in(text: str) -> list[float]:
    """The numbers of a row, of which the first is a finite number of seconds."""
    found: list[float] = []
    for word in re.split(r"[,;\s]+", text):
        try:
            found.append(float(word))
        except ValueError:
            continue
    if not found:
        raise ValueError(f"{shorten(text)} is not a time in seconds")
    if not np.isfinite(found[0]):
        raise ValueError(f"{shorten(text)} is not a finite time")
    if abs(found[0]) > _MOST_SECONDS:
        unit = next((unit for unit, size in _UNITS if _EARLIEST <= abs(found[0]) / size <= _LATEST), None)
        hint = f" (is it in {unit}?): give it in seconds" if unit else ""
        raise ValueError(f"{shorten(text)} is no possible time in seconds{hint}")
    return found


def date_time(text: str) -> int:
    """Nanoseconds since 1970 of ``2011-09-26 13:10:51.174740992``."""
    try:
        if not _DATE_TIME.fullmatch(text):
            raise ValueError
        return int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a date and time") from None


def numbers(text: str, count: int, what: str) -> list[float]:
    """The first finite numbers of a row, so many; `what` it should be is said where it is not."""
    try:
        row = [float(word) for word in text.split()[:count]]
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a row of numbers") from None
    if len(row) < count or not np.isfinite(row).all():
        raise ValueError(f"{shorten(text)} is not {what}")
    return row


def shorten(text: str, length: int = 40) -> str:
    """The text in quotes, cut where it is long."""
    return repr(text if len(text) <= length else text[:length] + "…")


def require_truth(path: Trajectory, source: Path) -> Trajectory:
    """The true path of a file.

    TrajectoryError where a rotation is none (a matrix of zeros, a reflection), a position beyond the Earth, or every
    position exactly zero: errors against such a path would mean nothing.
    """
    if not len(path):
        raise TrajectoryError(f"{source}: no pose is left")
    R, positions = path.poses[:, :3, :3], path.positions
    beyond = np.abs(positions).max(axis=1) > LARGEST
    if beyond.any():
        raise TrajectoryError(f"{source}: the position of pose {int(np.argmax(beyond))} is beyond the Earth")
    R = np.where((np.abs(R).max(axis=(1, 2)) > 1 + _ROTATION)[:, None, None], 0.0, R)
    improper = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2)) > _ROTATION
    improper |= np.linalg.det(R) < 0
    if improper.any():
        raise TrajectoryError(f"{source}: the rotation of pose {int(np.argmax(improper))} is none")
    if len(path) > 1 and not positions.any():
        raise TrajectoryError(f"{source}: every position is zero")
    return path
