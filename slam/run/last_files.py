"""The files at the end of a run: each is written even if another one fails."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from slam.errors import SlamError, one_line, text_of

logger = logging.getLogger("slam.run")


class LastFiles:
    """Does each of the last things although another one fails, and says in the end which did."""

    def __init__(self) -> None:
        self.failures: list[Exception] = []

    @contextmanager
    def each(self) -> Iterator[None]:
        """One of them."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 `report` raises it
            self.failures.append(error)

    @property
    def lines(self) -> list[str]:
        """What failed, a line each."""
        return [one_line(text_of(error)) or type(error).__name__ for error in self.failures]

    def report(self, stopped_by: BaseException | None) -> None:
        """Raise what failed, in one line with the error that stopped the run; a signal goes on, after warnings.

        Raises:
            SlamError: a file could not be written.
            Exception: a defect of the program, as it is.
        """
        if not self.failures:
            return
        if stopped_by is not None and not isinstance(stopped_by, SlamError):
            for line in dict.fromkeys(self.lines):
                logger.warning("%s", line)
            return
        for error in self.failures:
            if stopped_by is None and not isinstance(error, SlamError):
                raise error
        first = [] if stopped_by is None else [str(stopped_by)]
        kind = SlamError if stopped_by is None else type(stopped_by)
        raise kind("; ".join(dict.fromkeys([*first, *self.lines]))) from stopped_by
