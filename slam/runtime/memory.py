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

_TRIM, _MMAP = -1, -3  # glibc's numbers of these parameters
_KEPT = 2**27  # bytes at the end of the heap that may be free
_LARGE = 2**25  # bytes of an array from which it gets pages of its own: the most that glibc takes
_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


@cache
def keep_freed_memory() -> bool:
    """Have the process keep up to 128 MB that were freed; says whether that could be set.

    It cannot where the C library is another than glibc. Where one of glibc's environment variables for it is set, that
    is left as it is.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _VARIABLES):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and bool(mallopt(_TRIM, _KEPT)) and bool(mallopt(_MMAP, _LARGE))
