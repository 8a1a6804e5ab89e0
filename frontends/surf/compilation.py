"""Tells when the kernels are being compiled: once on a machine, then they come from Numba's cache."""

from __future__ import annotations

import logging
from functools import lru_cache
from typing import Any

from numba.core import event

_LOG = logging.getLogger(__name__)
_PACKAGE = __package__ or "frontends.surf"


class _Notice(event.Listener):
    """Says once that kernels of this package are being compiled."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        kernel = getattr(event.data["dispatcher"], "py_func", None)
        if not self._said and getattr(kernel, "__module__", "").startswith(_PACKAGE):
            self._said = True
            _LOG.warning("compiling the SURF kernels: some ten seconds, once; later runs load them from the cache")

    def on_end(self, event: Any) -> None:
        pass


@lru_cache(maxsize=1)
def announce_compilation() -> None:
    """From now on, log a warning when a kernel of this package has to be compiled."""
    event.register("numba:compile", _Notice())
