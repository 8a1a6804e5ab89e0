"""Faults of single frames: one clear line each, summed up where they repeat."""

from __future__ import annotations

import logging
from collections import Counter
from types import TracebackType

from slam.errors import one_line

logger = logging.getLogger("slam.sequences")

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

    def report(self, kind: str, line: str) -> None:
        """Report one fault; faults of the same `kind` are counted together."""
        self._counts[kind] += 1
        if self._counts[kind] <= _LINES_PER_KIND:
            self._emit(line)

    def close(self) -> None:
        """Report how many faults were only counted."""
        for kind, count in self._counts.items():
            if count > _LINES_PER_KIND:
                self._emit(f"{kind}: {count} in all, {count - _LINES_PER_KIND} not listed")
        self._counts.clear()

    def _emit(self, line: str) -> None:
        line = one_line(line)
        logger.warning("%s", line)
        if line not in self._lines:
            self._lines.append(line)

    def __enter__(self) -> FaultLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
