"""Tells when the kernels are being compiled: once on a machine, then they come from Numba's cache."""

from __future__ import annotations

import gc
import logging
from functools import lru_cache
from typing import Any

from numba.core import event

_LOG = logging.getLogger(__name__)
_PACKAGE = __package__ or "frontends.surf"


class _Notice(event.Listener):
    """Says once that kernels of this package are being compiled, and keeps the garbage collector from slowing it."""

    def __init__(self) -> None:
        self._said = False
        self._under_way = 0  # compilations nest
        self._collects = False

    def on_start(self, event: Any) -> None:
        if not _is_own(event):
            return
        if not self._said:
            self._said = True
            _LOG.warning("compiling the SURF kernels: some ten seconds, once; later runs load them from the cache")
        if not self._under_way:
            self._collects = gc.isenabled()
            gc.disable()
        self._under_way += 1

    def on_end(self, event: Any) -> None:
        if not _is_own(event):
            return
        self._under_way -= 1
        if not self._under_way and self._collects:
            gc.enable()


def _is_own(event: Any) -> bool:
    """A compilation of a function of this package?"""
    function = getattr(event.data["dispatcher"], "py_func", None)
    return getattr(function, "__module__", "").startswith(_PACKAGE)


@lru_cache(maxsize=1)
def announce_compilation() -> None:
    """From now on, log a warning when a kernel of this package has to be compiled."""
    event.register("numba:compile", _Notice())
