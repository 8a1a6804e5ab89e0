"""Lists of stamps and file names, read row by row, faults named by file and row; and whether a true path is one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from slam.checks import SINCE_1970, UNITS
from slam.errors import SequenceError, TrajectoryError
from slam.files import read_text
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.sequences.base import FaultLog

T = TypeVar("T")

#: Latest time [ns]: in the year 2262, where 64 bits end.
MOST_NANOSECONDS = 2**63 - 1

#: Largest coordinate of a true path [m]: the Earth's circumference.
LARGEST = 4.1e7

_ROTATION = 1e-2  # largest error of an element of RᵀR: files have six digits and more
_MOST_SECONDS = 1e11  # of a time, either side of zero: in nanoseconds it would not fit into 64 bits long before
_SLOWEST = 100.0  # [s] between frames, at most, of times in a unit that nobody named
_HEADING = re.compile(r"\D*(time|stamp|\bt\b|\bsec|\b[num]s\b)\D*", re.IGNORECASE)  # a first row that names the columns
_IMAGE = re.compile(r"\.(png|jpe?g|p[gp]m|bmp|tiff?|webp)$", re.IGNORECASE)
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?", re.ASCII)


def read_rows(path: Path, parse: Callable[[str], T], faults: FaultLog) -> list[T | None]:
    """The rows of a text file; blank lines, ``#`` comments, and a first row such as ``frame,timestamp`` do not count.

    A row that `parse` refuses with a ValueError is reported and stands as None, so that row numbers keep their meaning.
    SequenceError where the file cannot be read or holds no row, or where more than half of its rows are refused.
    """
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


def read_times(path: Path, faults: FaultLog) -> tuple[Array, list[str]]:
    """The times in a file by row [s], NaN for unreadable ones, and the images that its rows name, if all do.

    A row's time is its first number, or a date with the time, whatever names stand beside it; the second number where
    the first ones count rows. Times since 1970 in a finer unit are known by their size, which is said.

    SequenceError where the file cannot be read, or a time is impossible.
    """
    names: list[str] = []

    def row(text: str) -> list[float]:
        names.extend(name for name in re.split(r"[,;\s/\\]+", text) if _IMAGE.search(name))
        return _numbers_in(text)

    rows = read_rows(path, row, faults)
    table = np.array([(*(row or ())[:2], np.nan, np.nan)[:2] for row in rows])
    times, second = table.T
    low, high = SINCE_1970
    counts = len(table) > 1 and times[0] % 1 == 0 and 0 <= times[0] < low and (np.diff(times) == 1).all()
    if counts and (np.diff(second) > 0).all():
        faults.report("times", f"{path}: the first number of each row counts rows; the second one is taken as time")
        times = second
    for unit, size in UNITS if len(times) > 1 else ():
        if low <= np.nanmedian(np.abs(times)) / size <= high and np.nanmedian(np.abs(np.diff(times))) < size * _SLOWEST:
            faults.report("times", f"{path}: the times are taken as {unit}")
            times = times / size
    if (np.abs(times) > _MOST_SECONDS).any():
        raise SequenceError(f"{path}: {times[np.abs(times) > _MOST_SECONDS][0]:g} is no possible time in seconds")
    return np.asarray(times), names if len(set(names)) == len(rows) else []


def _numbers_in(text: str) -> list[float]:
    """The numbers of a row, of which the first is finite; of one that begins with a date its time [s since 1970]."""
    if date := _DATE_TIME.match(text):
        return [1e-9 * date_time(date[0])]
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
