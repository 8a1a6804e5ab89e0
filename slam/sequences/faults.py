"""Faults of single frames: one clear line each, summed up where they repeat."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType

from slam.errors import ConfigurationError, one_line

logger = logging.getLogger("slam.sequences")

_instead: ContextVar[list[str] | None] = ContextVar("where lines go instead of the log", default=None)

#: So many faults of one kind are reported one by one; the others are counted.
_LINES_PER_KIND = 5


class FaultLog:
    """Reports faults on the logger ``slam.sequences`` and keeps the lines; a context manager.

    The first few faults of a kind get a line each; the number of the others is reported when the log is closed. A
    line that is known already (a second pass over the same sequence) is logged again, but kept once.
    """

    def __init__(self, lines: list[str]) -> None:
        self._lines = lines
        self._counts: Counter[str] = Counter()
        self._assumptions: list[str] = []

    def report(self, kind: str, line: str) -> None:
        """Report one fault; faults of the same `kind` are counted together."""
        self._counts[kind] += 1
        if self._counts[kind] <= _LINES_PER_KIND:
            self._emit(line)

    def assume(self, line: str) -> None:
        """Report what is assumed for want of better, at the end, and not at all where an error ends the work."""
        self._assumptions.append(line)

    def _emit(self, line: str) -> None:
        line = one_line(line)
        _log(line)
        if line not in self._lines:
            self._lines.append(line)

    def __enter__(self) -> FaultLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for line in self._assumptions if kind is None else ():
            self._emit(line)
        for what, count in self._counts.items():
            if count > _LINES_PER_KIND:
                self._emit(f"{what}: {count} in all, {count - _LINES_PER_KIND} not listed")


def _log(line: str) -> None:
    lines = _instead.get()
    if lines is None:
        logger.warning("%s", line)
    else:
        lines.append(line)


@contextmanager
def said_before() -> Iterator[None]:
    """For opening a sequence once more: what its files lack was logged the first time, and is only kept."""
    token = _instead.set([])
    try:
        yield
    finally:
        _instead.reset(token)


@contextmanager
def held_back() -> Iterator[None]:
    """Lines are logged at the end, and not at all where an option turns out to be wrong."""
    lines: list[str] = []
    token = _instead.set(lines)
    try:
        yield
    except ConfigurationError:
        lines.clear()
        raise
    finally:
        _instead.reset(token)
        for line in lines:
            _log(line)
