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
from types import SimpleNamespace
from typing import Any

from slam.errors import ConfigurationError
from slam.runtime.compile_clock import compile_clock
from slam.runtime.sources import makes_arrays, stamp

try:
    from numba import njit
    from numba.core import event
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
except ValueError as error:
    if not any(name.startswith("NUMBA_") for name in os.environ):
        raise
    raise ConfigurationError(f"numba cannot be loaded; one of its variables NUMBA_… is wrong: {error}") from error

_LOG = logging.getLogger(__name__)
_ROOMS = ("slam.", "frontends.", "backends.")
_NUMPY: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is no exception
_INNER: dict[str, Any] = {**_NUMPY, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True}


class _Inlined(JITCodeLibrary):
    """A helper's code as it was written: it is optimised and made machine code where it is inlined, and only there.

    Numba would do both for each helper too, and again for every helper that calls it: half of the time of deep kernels.
    """

    codegen = property(lambda self: SimpleNamespace(set_env=lambda *_: None))  # Python never calls this code

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0


class _Helper(Compiler):
    """Compiles helpers."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.state.library = _Inlined(self.state.targetctx.codegen(), "helper")


class _Disjoint(_Helper):
    """Compiles for arrays of which none that is written to shares memory with another."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.state.flags.noalias = True


def _helper(compiler: type[Compiler] = _Helper, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator of helpers."""
    options = {**options, **_INNER, "pipeline_class": compiler}
    return lambda function: njit(**options, _nrt=makes_arrays(function))(function)


helper = _helper()
#: Sums may be reordered, so that loops run on vector registers; always the same way, whatever the number of threads.
vector_helper = _helper(fastmath=True)
#: The same for loops over so many arrays that looking for shared memory would keep them from vector registers.
disjoint_vector_helper = _helper(_Disjoint, fastmath=True)


def kernel(function: Callable[..., Any]) -> Any:
    """A compiled function that Python may call; cached where there is a folder for it."""
    options = {**_NUMPY, "nogil": True, "no_cfunc_wrapper": True, "_nrt": makes_arrays(function)}
    try:
        compiled = njit(cache=True, **options)(function)
        if compiled is function:  # NUMBA_DISABLE_JIT
            return function
        index = compiled._cache._cache_file  # Numba has no public way to say that a kernel depends on other files
        index._source_stamp = (index._source_stamp, stamp(function, kernel))
        compile_clock.expect(index._index_path)
        return compiled
    except (RuntimeError, AttributeError) as error:
        _LOG.warning("set NUMBA_CACHE_DIR to a folder, or the kernels are compiled in every run: %s", error)
        return njit(**options)(function)


class _Notice(event.Listener):
    """Says that kernels are being compiled, takes the time, and keeps the garbage collector from slowing it."""

    def __init__(self) -> None:
        self._said = False
        self._collects = False

    def on_start(self, event: Any) -> None:
        if not (_is_own(event) and compile_clock.change(1)):
            return
        if not compile_clock.tell() and not self._said:
            _LOG.warning("compiling kernels, once on this machine; `slam warm-up` does it beforehand")
        self._said = True
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
