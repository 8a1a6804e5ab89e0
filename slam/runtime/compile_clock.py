"""How long this process has been compiling kernels; no compiler has to be loaded to ask."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from threading import RLock


class CompileClock:
    """Runs while any thread compiles: the others wait for it, or for the same processor.

    Reading the clock needs no lock. For why a block stands on the lock's own line, see `slam.runtime.blas`.
    """

    watch: Callable[[int, int], None] | None = None  # is told how many kernels are compiled, of how many

    def __init__(self) -> None:
        self._missing: list[str] = []  # files in Numba's cache that kernels of the loaded modules did not have
        self._lock = RLock()
        self._state = 0, 0.0, 0.0  # compilations under way (they nest), since when, and the time before [s]

    def change(self, by: int) -> bool:
        """A compilation begins (1) or ends (-1); whether it is the only one."""
        with self._lock: return self._change(by, time.perf_counter())  # noqa: E701  # fmt: skip

    def seconds(self) -> float:
        """Wall time in which something was compiled [s]."""
        under_way, since, before = self._state
        return before + (time.perf_counter() - since if under_way else 0.0)

    def expect(self, file: str) -> None:
        """A kernel was loaded which is compiled where this file of Numba's cache is missing."""
        if not os.path.exists(file):  # noqa: PTH110 for each of some hundred kernels
            self._missing.append(file)

    def tell(self) -> bool:
        """Tell the watch how many kernels have been compiled, here or by another process; whether there is a watch."""
        if self.watch is None:
            return False
        self.watch(sum(map(os.path.exists, self._missing)), max(1, len(self._missing)))
        return True

    def _change(self, by: int, now: float) -> bool:
        under_way, since, before = self._state
        alone = max(under_way, under_way + by) == 1
        self._state = under_way + by, now if not under_way else since, before + (now - since if alone and by < 0 else 0)
        return alone


#: Of this process.
compile_clock = CompileClock()


def working_time() -> float:
    """A clock that stands still while kernels are compiled [s]."""
    return time.perf_counter() - compile_clock.seconds()
