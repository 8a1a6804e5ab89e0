"""What a compiled kernel is made of: the source files of the helpers that it calls, and the numbers that it reads."""

from __future__ import annotations

import hashlib
import linecache
import sys
from collections.abc import Callable, Iterator
from functools import cache
from types import CodeType
from typing import Any

import numpy as np

_VALUES = (int, float, str, tuple, np.generic, np.ndarray)


def stamp(*functions: Callable[..., Any]) -> str:
    """Digest of functions' files, of those of the helpers that they call, and of the numbers that all of them read.

    Helpers are found by their names in the module: they are imported by name, never as attributes of a module.
    """
    waiting, known, parts = [*functions], {*functions}, set()
    while waiting:
        part = waiting.pop()
        parts.add((part.__module__, _digest(part.__code__.co_filename, part.__module__)))
        for name in _names(part.__code__):
            value = part.__globals__.get(name)
            called = getattr(value, "py_func", None)
            if called is not None and called not in known:
                known.add(called)
                waiting.append(called)
            elif isinstance(value, _VALUES):
                exact = f"{value.dtype}{value.tolist()}" if isinstance(value, np.ndarray) else repr(value)
                parts.add((f"{part.__module__}.{name}", exact))
    return hashlib.sha256(repr(sorted(parts)).encode()).hexdigest()


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
