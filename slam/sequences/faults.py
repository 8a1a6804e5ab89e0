"""Faults of files and of single frames: one clear line each, summed up where they repeat."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType

from slam.errors import one_line

logger = logging.getLogger("slam.sequences")

_silent: ContextVar[bool] = ContextVar("whether lines are kept, but not logged", default=False)

#: So many faults of one kind are reported one by one; the others are counted.
_LINES_PER_KIND = 5


class FaultLog:
    """Reports faults on the logger ``slam.sequences`` and keeps them in `lines`; a context manager.

    The first few faults of a kind get a line each; the number of the others is reported when the log is closed. A line
    that is known already (a second pass over the same sequence) is logged again, but kept once. `at_the_end` logs them
    when the log is closed, and not at all above an error, which is said alone.
    """

    def __init__(self, lines: list[str], at_the_end: bool = False) -> None:
        self._lines, self._at_the_end = lines, at_the_end
        self._counts: Counter[str] = Counter()
        self._waiting: list[str] = []

    def report(self, kind: str, line: str) -> None:
        """Report one fault; faults of the same `kind` are counted together."""
        self._counts[kind] += 1
        if self._counts[kind] <= _LINES_PER_KIND:
            self._keep(line)

    def _keep(self, line: str) -> None:
        line = one_line(line)
        if line not in self._lines:
            self._lines.append(line)
        self._waiting.append(line)
        if not self._at_the_end:
            self._log()

    def _log(self) -> None:
        for line in self._waiting if not _silent.get() else ():
            logger.warning("%s", line)
        self._waiting.clear()

    def __enter__(self) -> FaultLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for what, count in self._counts.items():
            if count > _LINES_PER_KIND:
                self._keep(f"{what}: {count} in all, {count - _LINES_PER_KIND} not listed")
        if error is None:
            self._log()


@contextmanager
def said_before() -> Iterator[None]:
    """For opening a sequence once more: what its files lack was logged the first time, and is only kept."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)
