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

import dis
import gc
import hashlib
import linecache
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType, SimpleNamespace
from typing import Any

import numpy as np
from numba import njit
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.types.misc import unliteral

_LOG = logging.getLogger(__name__)
_ROOMS = ("slam.", "frontends.", "backends.")
_NUMPY: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is no exception
_INNER: dict[str, Any] = {**_NUMPY, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True}

#: Names of NumPy's functions and methods that make arrays.
_MAKERS = {
    "arange", "argsort", "array", "ascontiguousarray", "asarray", "astype", "concatenate", "copy", "copyto", "cross",
    "diag", "dot", "empty", "empty_like", "eye", "flatnonzero", "full", "full_like", "linalg", "linspace", "nonzero",
    "ones", "ones_like", "outer", "repeat", "reshape", "sort", "stack", "sum", "take", "tile", "where", "zeros",
    "zeros_like",
}  # fmt: skip
_VALUES = (int, float, str, tuple, np.generic, np.ndarray)


def stamp(*functions: Callable[..., Any]) -> str:
    """Digest of functions' files, of those of the helpers that they call, and of the numbers that all of them read.

    Helpers are found by their names in the module: they are imported by name, never as attributes of a module.
    """
    parts = set()
    for part in _parts(*functions):
        parts.add((part.__module__, _digest(part.__code__.co_filename, part.__module__)))
        for name in _names(part.__code__):
            value = part.__globals__.get(name)
            if isinstance(value, _VALUES):
                exact = f"{value.dtype}{value.tolist()}" if isinstance(value, np.ndarray) else repr(value)
                parts.add((f"{part.__module__}.{name}", exact))
    return hashlib.sha256(repr(sorted(parts)).encode()).hexdigest()


def makes_arrays(function: Callable[..., Any]) -> bool:
    """Whether a function, or a helper that it calls, makes an array, as far as its text shows."""
    codes = [part.__code__ for part in _parts(function)]
    products = (step.argrepr.startswith("@") for code in codes for step in dis.get_instructions(code))
    return any(name in _MAKERS for code in codes for name in _names(code)) or any(products)


def _parts(*functions: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Functions and the helpers that they call, each once."""
    waiting, known = [*functions], {*functions}
    while waiting:
        part = waiting.pop()
        yield part
        for name in _names(part.__code__):
            called = getattr(part.__globals__.get(name), "py_func", None)
            if called is not None and called not in known:
                known.add(called)
                waiting.append(called)


def _names(code: CodeType) -> Iterator[str]:
    """All global names and attributes in a function and in those inside it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


@cache
def _digest(file: str, module: str) -> str:
    """Of a file's text, which may lie in an archive; read once in a process."""
    return hashlib.sha256("".join(linecache.getlines(file, vars(sys.modules[module]))).encode()).hexdigest()


class CompileClock(event.Listener):
    """Runs while any thread compiles, of which Numba lets one at a time: the others wait for it or for the processor.

    It says once that kernels are being compiled, and keeps the garbage collector from slowing that.
    """

    watch: Callable[[int, int], None] | None = None  # is told how many kernels are compiled, of how many

    def __init__(self) -> None:
        self._missing: list[str] = []  # files in Numba's cache that kernels of the loaded modules did not have
        self._state = 0, 0.0, 0.0  # compilations under way (they nest), since when, and the time before [s]
        self._said = self._collects = False

    def change(self, by: int) -> bool:
        """A compilation begins (1) or ends (-1); whether it is the only one."""
        (under_way, since, before), now = self._state, time.perf_counter()
        alone = max(under_way, under_way + by) == 1
        self._state = under_way + by, now if not under_way else since, before + (now - since if alone and by < 0 else 0)
        return alone

    def seconds(self) -> float:
        """Wall time in which something was compiled [s]."""
        under_way, since, before = self._state
        return before + (time.perf_counter() - since if under_way else 0.0)

    def expect(self, file: str) -> None:
        """A kernel was loaded which is compiled where this file of Numba's cache is missing."""
        if not os.path.exists(file):  # noqa: PTH110 for each of some hundred kernels
            self._missing.append(file)

    def tell(self) -> bool:
        """Tell the watch how many kernels have been compiled, here or by another process; whether there is a watch."""
        if self.watch is None:
            return False
        self.watch(sum(map(os.path.exists, self._missing)), max(1, len(self._missing)))
        return True

    def on_start(self, event: Any) -> None:
        """Numba begins to compile a function."""
        if _is_own(event) and self.change(1):
            if not self.tell() and not self._said:
                _LOG.warning("compiling kernels, once on this machine; `slam warm-up` does it beforehand")
            self._said, self._collects = True, gc.isenabled()
            gc.disable()

    def on_end(self, event: Any) -> None:
        """Numba has compiled a function."""
        if _is_own(event) and self.change(-1) and self._collects:
            gc.enable()


def _is_own(event: Any) -> bool:
    function = getattr(event.data["dispatcher"], "py_func", None)
    return getattr(function, "__module__", "").startswith(_ROOMS)


#: Of this process.
compile_clock = CompileClock()
event.register("numba:compile", compile_clock)


def working_time() -> float:
    """A clock that stands still while kernels are compiled [s]."""
    return time.perf_counter() - compile_clock.seconds()


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
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.state.library = _Inlined(self.state.targetctx.codegen(), "helper")


class _Disjoint(_Helper):
    """Compiles for arrays of which none that is written to shares memory with another."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.state.flags.noalias = True


def _helper(compiler: type[Compiler] = _Helper, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    options = {**options, **_INNER, "pipeline_class": compiler}

    def made(function: Callable[..., Any]) -> Any:
        compiled = njit(**options, _nrt=makes_arrays(function))(function)
        if compiled is not function:  # NUMBA_DISABLE_JIT
            template = compiled.get_call_template
            # Else Numba would compile it for each number or truth that a caller writes as a constant.
            compiled.get_call_template = lambda args, kws: template(
                tuple(map(unliteral, args)), {name: unliteral(kind) for name, kind in kws.items()}
            )
        return compiled

    return made


helper = _helper()
#: Sums may be reordered, so that loops run on vector registers; always the same way, whatever the number of threads.
vector_helper = _helper(fastmath=True)
#: For loops over so many arrays that looking for shared memory would keep them from vector registers.
disjoint_helper, disjoint_vector_helper = _helper(_Disjoint), _helper(_Disjoint, fastmath=True)


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


class Stages:
    """Stages of one step, entered one after the other; their wall times [ms], without that in which kernels compile."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self.begun, self._since = "", 0.0  # the stage entered last, empty before the first, and when

    def stage(self, name: str) -> Stages:
        """``with`` this around a stage; where no exception ends it, its time adds to that of the same stage before."""
        self.begun, self._since = name, working_time()
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, *error: object) -> None:
        if kind is None:
            before = self.milliseconds.get(self.begun, 0.0)
            self.milliseconds[self.begun] = before + 1e3 * (working_time() - self._since)
