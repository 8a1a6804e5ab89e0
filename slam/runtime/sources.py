"""What a compiled kernel is made of: the helpers that it calls, their source files, and the numbers that it reads."""

from __future__ import annotations

import dis
import hashlib
import linecache
import sys
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType
from typing import Any

import numpy as np

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
