"""How many frames worker processes have done: one number in memory that they share, for the progress bar alone."""

from __future__ import annotations

from multiprocessing.sharedctypes import Synchronized

_shared: Synchronized[int] | None = None


def count_in(counter: Synchronized[int] | None) -> None:
    """Count this process's frames in a number that it shares with others."""
    global _shared
    _shared = counter


def count_one() -> None:
    """One more frame is done; nothing where nobody asked."""
    if _shared is not None:
        with _shared.get_lock():
            _shared.value += 1
