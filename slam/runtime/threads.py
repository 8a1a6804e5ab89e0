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
from weakref import WeakSet

from threadpoolctl import LibController, ThreadpoolController

from slam.errors import SlamError

_F = TypeVar("_F", bound=Callable[..., Any])
T = TypeVar("T")

_LOOK = 0.1  # [s] between two looks for a signal


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


class _Call:
    """A call that is under way."""

    def __init__(self) -> None:
        self.before: list[tuple[LibController, int]] = []  # numbers of this thread, which other threads cannot set back


class _Limit:
    """The number of BLAS threads is 1 as long as any thread is inside; the last one out sets back what was changed.

    Calls that an interrupt ended on their way in or out leave a token, which goes with them, and numbers that the next
    call sets back.
    """

    def __init__(self) -> None:
        self._inside: WeakSet[_Call] = WeakSet()
        self._before: list[tuple[LibController, int]] = []

    def enter(self, call: _Call) -> None:
        for library in _blas(len(sys.modules)):
            threads = library.get_num_threads()
            if threads != 1:
                of_thread = getattr(library, "threading_layer", "") == "openmp"
                (call.before if of_thread else self._before).append((library, threads))
                _set(library, 1)
        self._inside.add(call)

    def leave(self, call: _Call) -> None:
        self._inside.discard(call)
        for before in (call.before, [] if self._inside else self._before):
            while before:
                _set(*before[-1])
                before.pop()


_limit, _lock = _Limit(), RLock()


def one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread, in whatever thread of Python's.

    As ``ThreadpoolController.limit``, but that only works in the thread that used it first, and costs twenty
    microseconds where there is one thread already. What is done with the lock stands on the lock's own line: an
    interrupt comes before it or within, where the lock is given back, but not between the end of a block and that.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        call = _Call()
        try:
            with _lock: _limit.enter(call)  # noqa: E701  # fmt: skip
            return function(*args, **kwargs)
        finally:
            with _lock: _limit.leave(call)  # noqa: E701  # fmt: skip

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
    iterator, end = iter(items), object()
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        ahead: deque[Future[Any]] = deque(pool.submit(next, iterator, end) for _ in range(depth))
        while True:
            while not ahead[0].done():  # a signal that comes just before the wait takes effect at the next look
                wait([ahead[0]], _LOOK)
            item = ahead.popleft().result()
            if item is end:
                return
            ahead.append(pool.submit(next, iterator, end))
            yield item
    finally:
        pool.shutdown(cancel_futures=True)
