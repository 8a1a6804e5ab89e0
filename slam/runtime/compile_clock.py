"""How long this process has been compiling kernels; no compiler has to be loaded to ask."""

from __future__ import annotations

import time
from dataclasses import dataclass
from threading import RLock


@dataclass(frozen=True)
class _State:
    """Compilations under way (they nest, and threads compile at the same time), since when, and the time before [s]."""

    under_way: int = 0
    since: float = 0.0
    seconds: float = 0.0


class CompileClock:
    """Runs while any thread compiles: the others wait for it, or for the same processor.

    Reading the clock needs no lock. For why a block stands on the lock's own line, see `slam.runtime.blas`.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._state = _State()

    def start(self) -> bool:
        """A compilation begins; whether no other was under way."""
        with self._lock: return self._start()  # noqa: E701  # fmt: skip

    def stop(self) -> bool:
        """A compilation has ended; whether none is under way any more."""
        with self._lock: return self._stop()  # noqa: E701  # fmt: skip

    def seconds(self) -> float:
        """Wall time in which something was compiled [s]."""
        s = self._state
        return s.seconds + (time.perf_counter() - s.since if s.under_way else 0.0)

    def _start(self) -> bool:
        s = self._state
        self._state = _State(s.under_way + 1, s.since if s.under_way else time.perf_counter(), s.seconds)
        return not s.under_way

    def _stop(self) -> bool:
        s = self._state
        done = 0.0 if s.under_way > 1 else time.perf_counter() - s.since
        self._state = _State(s.under_way - 1, s.since, s.seconds + done)
        return s.under_way == 1


#: Of this process.
compile_clock = CompileClock()


def working_time() -> float:
    """A clock that stands still while kernels are compiled [s]."""
    return time.perf_counter() - compile_clock.seconds()
