"""Memory that was freed stays with the process, so that not each frame has to ask for it again.

The C library of most Linux systems (glibc) returns the end of its heap to the system as soon as some megabytes of it
are free. Arrays that live for a part of a step are as large as that, so in every frame the system would take thousands
of pages away and give them back filled with zeros: a tenth of the time.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache

_TRIM, _MMAP, _ARENAS = -1, -3, -8  # glibc's numbers of these parameters
_KEPT = 2**27  # bytes at the end of the heap that may be free
_LARGE = 2**25  # bytes of an array from which it gets pages of its own: the most that glibc takes
_HEAPS = 2  # one for each thread would keep what that thread alone has freed
_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_ARENA_MAX", "GLIBC_TUNABLES")


@cache
def keep_freed_memory() -> None:
    """Have the process keep up to 128 MB that were freed, in two heaps.

    Nothing is changed where the C library is another than glibc, or one of its environment variables for that is set.
    """
    if not any(name in os.environ for name in _VARIABLES):
        for parameter, value in ((_TRIM, _KEPT), (_MMAP, _LARGE), (_ARENAS, _HEAPS)):
            _call("mallopt", parameter, value)


def give_back_freed_memory() -> None:
    """Give the system what is free, before something else than frames needs memory."""
    _call("malloc_trim", 0)


def _call(name: str, *numbers: int) -> None:
    """Call a function of glibc, where that is the C library."""
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*numbers)
