"""Lists of stamps and file names: text tables read row by row, faults named by file and row."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from slam.errors import SequenceError
from slam.files import read_text
from slam.sequences.faults import FaultLog

T = TypeVar("T")

#: Latest time [ns]: in the year 2262, where 64 bits end.
MOST_NANOSECONDS = 2**63 - 1

_MOST_SECONDS = 1e11  # of a time, either side of zero: in nanoseconds it would not fit into 64 bits long before
_EARLIEST, _LATEST = 1e8, 1e10  # of a likely time since 1970 [s]: 1973 to 2286
_UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?", re.ASCII)


def read_rows(path: Path, parse: Callable[[str], T], faults: FaultLog) -> list[T | None]:
    """The rows of a text file; blank lines and ``#`` comments do not count.

    A row that `parse` refuses with a ValueError is reported to `faults` and stands as None, so that row numbers keep
    their meaning.

    Raises:
        SequenceError: the file cannot be read or holds no row, or more than half of its rows are refused (the
            message names the first of them).
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


def seconds(text: str) -> float:
    """A finite number of seconds."""
    try:
        value = float(text.split()[0])
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a time in seconds") from None
    if not np.isfinite(value):
        raise ValueError(f"{shorten(text)} is not a finite time")
    if abs(value) > _MOST_SECONDS:
        unit = next((unit for unit, size in _UNITS if _EARLIEST <= abs(value) / size <= _LATEST), None)
        hint = f" (is it in {unit}?): give it in seconds" if unit else ""
        raise ValueError(f"{shorten(text)} is no possible time in seconds{hint}")
    return value


def date_time(text: str) -> int:
    """Nanoseconds since 1970 of ``2011-09-26 13:10:51.174740992``."""
    try:
        if not _DATE_TIME.fullmatch(text):
            raise ValueError
        return int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a date and time") from None


def numbers(text: str, count: int, what: str, separator: str | None = None, exactly: bool = False) -> list[float]:
    """The first finite numbers of a row, so many; `what` it should be is said where it is not, or not `exactly`."""
    words = text.split(separator)
    try:
        row = [float(word) for word in words[:count]]
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a row of numbers") from None
    if len(row) < count or not np.isfinite(row).all() or (exactly and len(words) > count):
        raise ValueError(f"{shorten(text)} is not {what}")
    return row


def stamp_and_name(text: str) -> tuple[int, str]:
    """A row of EuRoC's ``data.csv``: nanoseconds and file name; the name defaults to the stamp."""
    stamp, name = (cell.strip() for cell in f"{text},".split(",")[:2])
    try:
        value = int(stamp)
    except ValueError:
        raise ValueError(f"{shorten(stamp)} is not a time in whole nanoseconds") from None
    if not 0 <= value <= MOST_NANOSECONDS:
        raise ValueError(f"{shorten(stamp)} is no possible time in nanoseconds")
    return value, name or f"{stamp}.png"


def shorten(text: str, length: int = 40) -> str:
    """The text in quotes, cut where it is long."""
    return repr(text if len(text) <= length else text[:length] + "…")
