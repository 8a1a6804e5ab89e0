"""How long this process has been compiling kernels; no compiler has to be loaded to ask."""

from __future__ import annotations

import time
from threading import Lock


class CompileClock:
    """Runs while any thread compiles: the others wait for it, or for the same processor."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._under_way = 0  # compilations nest, and threads compile at the same time
        self._since = 0.0
        self._seconds = 0.0

    def start(self) -> bool:
        """A compilation begins; whether no other was under way."""
        with self._lock:
            self._under_way += 1
            if self._under_way == 1:
                self._since = time.perf_counter()
            return self._under_way == 1

    def stop(self) -> bool:
        """A compilation has ended; whether none is under way any more."""
        with self._lock:
            self._under_way -= 1
            if not self._under_way:
                self._seconds += time.perf_counter() - self._since
            return not self._under_way

    def seconds(self) -> float:
        """Wall time in which something was compiled [s]."""
        with self._lock:
            return self._seconds + (time.perf_counter() - self._since if self._under_way else 0.0)


#: Of this process.
compile_clock = CompileClock()


def working_time() -> float:
    """A clock that stands still while kernels are compiled [s]."""
    return time.perf_counter() - compile_clock.seconds()
