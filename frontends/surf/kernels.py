"""How the compiled functions of this package are compiled.

Kernels are called from Python: they let go of the global lock and are cached on disk, in the package's folder or, where
that is read-only, in the user's cache. Helpers are called from kernels of the same file alone, because Numba notices
changes in a kernel's own file only.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from numba import njit

_LOG = logging.getLogger(__name__)
_NUMPY: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is no exception
_INNER: dict[str, Any] = {**_NUMPY, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

helper = njit(**_INNER)
#: Sums may be reordered, so that loops run on vector registers; always the same way, whatever the number of threads.
vector_helper = njit(fastmath=True, **_INNER)


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python may call; cached where there is a folder for it."""
    try:
        return njit(cache=True, nogil=True, no_cfunc_wrapper=True, **_NUMPY)(function)
    except RuntimeError as error:
        _LOG.warning("set NUMBA_CACHE_DIR to a folder, or the kernels are compiled in every run: %s", error)
        return njit(nogil=True, no_cfunc_wrapper=True, **_NUMPY)(function)
