"""The stages of a step: which one is in work, and the wall time that each took, compiling left out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from slam.runtime.compilation import working_time


class Stages:
    """Stages of one step, entered one after the other.

    Attributes:
        begun: whether one has been entered.
        milliseconds: wall time of each stage that was completed [ms], without that in which kernels were compiled.
    """

    def __init__(self) -> None:
        self.begun = False
        self.milliseconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Enter a stage; its time is taken where no exception ends it."""
        self.begun = True
        start = working_time()
        yield
        self.milliseconds[name] = 1e3 * (working_time() - start)
