"""Threads: the cores that there are, one BLAS thread, objects for one thread, and an iterator that works ahead in one.

With one BLAS thread sums have the same order on every machine, and small matrices wait for no threads.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache, wraps
from threading import RLock
from typing import Any, TypeVar

from threadpoolctl import LibController, ThreadpoolController

from slam.errors import SlamError

_F = TypeVar("_F", bound=Callable[..., Any])
T = TypeVar("T")

_LOOK = 0.1  # [s] between two looks for a signal


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_ahead = threading.local()  # of a thread that works ahead: `busy` is set while the thread that it works for is so too


def free_cores() -> int:
    """Number of cores for the work of this thread: one less where it works ahead of another that is busy itself."""
    busy = getattr(_ahead, "busy", None)
    return max(1, available_cores() - (busy is not None and busy.is_set()))


@lru_cache(maxsize=1)
def _blas(modules: int) -> list[LibController]:
    """The BLAS libraries that are loaded; looked up again whenever the number of `modules` has changed."""
    return [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]


def _set(library: LibController, threads: int) -> None:
    """Since 3.8, threadpoolctl heeds only one thread of Python's unless that is cleared."""
    clear = getattr(library, "clear_controlling_thread", lambda force: None)
    clear(force=True)
    library.set_num_threads(threads)
    clear(force=True)


_lock = RLock()
_inside: set[object] = set()  # a token of each call that is under way
_before: list[tuple[LibController, int]] = []  # what the last one out sets back


def _enter(call: object) -> None:
    """One thread from here on."""
    _inside.add(call)
    for library in _blas(len(sys.modules)):
        if (threads := library.get_num_threads()) != 1:
            _before.append((library, threads))
            _set(library, 1)


def _leave(call: object) -> None:
    """As many threads as before, if this is the last one out."""
    _inside.discard(call)
    while _before and not _inside:
        _set(*_before[-1])
        _before.pop()


def one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread, in whatever thread of Python's; the last of several calls out sets back what was.

    As ``ThreadpoolController.limit``, but that only works in the thread that used it first, and costs twenty
    microseconds where there is one thread already.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        call = object()
        try:  # the lock is held for one line: an interrupt between two would leave it locked
            with _lock: _enter(call)  # fmt: skip  # noqa: E701
            return function(*args, **kwargs)
        finally:
            with _lock: _leave(call)  # fmt: skip  # noqa: E701

    return limited  # type: ignore[return-value]


class OneThread:
    """``with`` this around what one thread may do at a time, not nested; SlamError refuses `what` to another.

    A copy, also a pickled one, is free.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._inside: dict[str, int] = {}  # the thread inside; `setdefault` is atomic

    def __enter__(self) -> None:
        here = threading.get_ident()
        if self._inside.setdefault("thread", here) != here:
            raise SlamError(f"{self._what} is in use by another thread: give each thread its own, or take turns")

    def __exit__(self, *error: object) -> None:
        self._inside.clear()

    def __reduce__(self) -> tuple[type[OneThread], tuple[str]]:
        return OneThread, (self._what,)


def prefetch(items: Iterable[T], depth: int = 2) -> Iterator[T]:
    """The same items in the same order, made in a thread that is at most `depth` items ahead of the one in use.

    An exception of the iterator is raised where its item would have come. The thread ends with the generator: after its
    last item, when it is closed, or with the program, if an exception left the generator half used.
    """
    iterator, end, busy = iter(items), object(), threading.Event()
    pool = ThreadPoolExecutor(1, "prefetch", lambda: setattr(_ahead, "busy", busy))
    try:
        ahead: deque[Future[Any]] = deque(pool.submit(next, iterator, end) for _ in range(depth))
        while True:
            busy.clear()
            while not ahead[0].done():  # a signal that comes just before the wait takes effect at the next look
                wait([ahead[0]], _LOOK)
            item = ahead.popleft().result()
            if item is end:
                return
            ahead.append(pool.submit(next, iterator, end))
            busy.set()
            yield item
    finally:
        pool.shutdown(cancel_futures=True)
