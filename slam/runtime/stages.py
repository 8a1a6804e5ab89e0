"""The stages of a step: which one is in work, and the wall time that each took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stages:
    """Stages of one step, entered one after the other.

    Attributes:
        current: the stage entered last; after an exception, the one that it ended. None before the first.
        milliseconds: wall time of each stage that was completed [ms].
    """

    def __init__(self) -> None:
        self.current: str | None = None
        self.milliseconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Enter a stage; its time is taken where no exception ends it."""
        self.current = name
        start = time.perf_counter()
        yield
        self.milliseconds[name] = 1e3 * (time.perf_counter() - start)
