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
def keep_freed_memory() -> bool:
    """Have the process keep up to 128 MB that were freed, in two heaps; says whether that could be set.

    It cannot where the C library is another than glibc. Where one of glibc's environment variables for it is set, that
    is left as it is.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _VARIABLES):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    wanted = (_TRIM, _KEPT), (_MMAP, _LARGE), (_ARENAS, _HEAPS)
    return mallopt is not None and all([mallopt(number, value) for number, value in wanted])


def give_back_freed_memory() -> None:
    """Give the system what is free, before something else than frames needs memory; nothing where that cannot be."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
