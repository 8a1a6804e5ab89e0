"""How functions are compiled by Numba, and the notice that it is being done: once on a machine, then they are loaded.

Kernels are called from Python: they let go of the global lock and are cached on disk, in their package's folder or,
where that is read-only, in the user's cache. Helpers are called from kernels of the same file alone, because Numba
notices changes in a kernel's own file only. They are always inlined: a call would go to whichever copy of the helper
the process has got first, its own or that of another kernel, and these are optimised differently. The results would
depend on whether a kernel was compiled or loaded.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit
from numba.core import event

_LOG = logging.getLogger(__name__)
_NUMPY: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is no exception
_INNER: dict[str, Any] = {**_NUMPY, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True}

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


class _Notice(event.Listener):
    """Says once that a package's kernels are being compiled, and keeps the garbage collector from slowing it."""

    def __init__(self, package: str, what: str) -> None:
        self._package = package
        self._what = what
        self._said = False
        self._under_way = 0  # compilations nest
        self._collects = False

    def on_start(self, event: Any) -> None:
        if not self._is_own(event):
            return
        if not self._said:
            self._said = True
            _LOG.warning("compiling %s, once; later runs load them from the cache", self._what)
        if not self._under_way:
            self._collects = gc.isenabled()
            gc.disable()
        self._under_way += 1

    def on_end(self, event: Any) -> None:
        if not self._is_own(event):
            return
        self._under_way -= 1
        if not self._under_way and self._collects:
            gc.enable()

    def _is_own(self, event: Any) -> bool:
        """A compilation of a function of the package?"""
        function = getattr(event.data["dispatcher"], "py_func", None)
        return getattr(function, "__module__", "").startswith(self._package)


@cache
def announce_compilation(package: str, what: str) -> None:
    """From now on, log a warning when a kernel of a package has to be compiled.

    Args:
        package: its name.
        what: the kernels, and how long they take.
    """
    event.register("numba:compile", _Notice(package, what))
