"""How functions are compiled by Numba, once on a machine, then they are loaded; how long it takes is counted.

Kernels are called from Python: they let go of the global lock and are cached on disk, in their package's folder or,
where that is read-only, in the user's cache. Helpers are called from kernels, of any file that imports them by name:
what is cached counts only while the sources of all helpers that a kernel calls are what they were. They are always
inlined: a call would go to whichever copy of the helper the process has got first, its own or that of another kernel,
and these are optimised differently. The results would depend on whether a kernel was compiled or loaded.

A function that makes no array is compiled without Numba's runtime, which would count the references to its arguments:
twice for each helper that it calls, a tenth of the time of small ones.
"""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable
from typing import Any

from slam.errors import ConfigurationError
from slam.runtime.compile_clock import compile_clock
from slam.runtime.sources import makes_arrays, stamp

try:
    from numba import njit
    from numba.core import event
    from numba.core.compiler import Compiler
except ValueError as error:
    if not any(name.startswith("NUMBA_") for name in os.environ):
        raise
    raise ConfigurationError(f"numba cannot be loaded; one of its variables NUMBA_… is wrong: {error}") from error

_LOG = logging.getLogger(__name__)
_ROOMS = ("slam.", "frontends.", "backends.")
_NUMPY: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is no exception
_INNER: dict[str, Any] = {**_NUMPY, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True}


class _Disjoint(Compiler):
    """Compiles for arrays of which none that is written to shares memory with another."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.state.flags.noalias = True


def _helper(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator of helpers."""
    return lambda function: njit(**options, **_INNER, _nrt=makes_arrays(function))(function)


helper = _helper()
#: Sums may be reordered, so that loops run on vector registers; always the same way, whatever the number of threads.
vector_helper = _helper(fastmath=True)
#: The same for loops over so many arrays that looking for shared memory would keep them from vector registers.
disjoint_vector_helper = _helper(fastmath=True, pipeline_class=_Disjoint)


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python may call; cached where there is a folder for it."""
    options = {**_NUMPY, "nogil": True, "no_cfunc_wrapper": True, "_nrt": makes_arrays(function)}
    try:
        compiled = njit(cache=True, **options)(function)
        if compiled is function:  # NUMBA_DISABLE_JIT
            return function
        index = compiled._cache._cache_file  # Numba has no public way to say that a kernel depends on other files
        index._source_stamp = (index._source_stamp, stamp(function, kernel))
        compile_clock.kernels += not os.path.exists(index._index_path)  # noqa: PTH110 for each of some hundred
        return compiled
    except (RuntimeError, AttributeError) as error:
        _LOG.warning("set NUMBA_CACHE_DIR to a folder, or the kernels are compiled in every run: %s", error)
        return njit(**options)(function)


class _Notice(event.Listener):
    """Says that kernels are being compiled, takes the time, and keeps the garbage collector from slowing it."""

    def __init__(self) -> None:
        self._collects = False

    def on_start(self, event: Any) -> None:
        if not (_is_own(event) and compile_clock.change(1)):
            return
        compile_clock.begun += 1
        if compile_clock.watch is not None:
            compile_clock.watch(compile_clock.begun, max(compile_clock.begun, compile_clock.kernels))
        elif compile_clock.begun == 1:
            text = "compiling kernels, once on this machine, at most %d; `slam warm-up` does it beforehand"
            _LOG.warning(text, max(1, compile_clock.kernels))
        self._collects = gc.isenabled()
        gc.disable()

    def on_end(self, event: Any) -> None:
        if _is_own(event) and compile_clock.change(-1) and self._collects:
            gc.enable()


def _is_own(event: Any) -> bool:
    """A compilation of a kernel or helper of this project?"""
    function = getattr(event.data["dispatcher"], "py_func", None)
    return getattr(function, "__module__", "").startswith(_ROOMS)


event.register("numba:compile", _Notice())
