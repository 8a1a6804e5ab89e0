"""Threads: the cores that there are, one BLAS thread, objects for one thread, and an iterator that works ahead in one.

With one BLAS thread sums have the same order on every machine, and small matrices wait for no threads.
"""

from __future__ import annotations

import atexit
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache, wraps
from threading import RLock
from typing import Any, TypeVar
from weakref import WeakSet

from threadpoolctl import LibController, ThreadpoolController

from slam.errors import SlamError


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_F = TypeVar("_F", bound=Callable[..., Any])
_Changed = list[tuple[LibController, int]]


def _libraries() -> tuple[list[LibController], list[LibController]]:
    """The BLAS libraries that are loaded: with one number of threads for the process, and with one per thread."""
    return _found(len(sys.modules))


@lru_cache(maxsize=1)
def _found(modules: int) -> tuple[list[LibController], list[LibController]]:
    """Looked up again whenever `modules`, their number, has changed: any of them may have brought a library."""
    found = [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]
    own = [library for library in found if getattr(library, "threading_layer", "") == "openmp"]
    return [library for library in found if library not in own], own


class _Call:
    """A call that is under way."""


class _Limit:
    """The number of BLAS threads of the process is 1 as long as any thread is inside.

    What is done with the lock stands on the lock's own line: an interrupt comes before it or within, where the lock is
    given back, but not between the end of a block and that. Calls that an interrupt ended on their way in or out leave
    no more than a token, which goes with them.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._inside: WeakSet[_Call] = WeakSet()
        self._changed: _Changed = []

    def enter(self, call: _Call) -> None:
        with self._lock: self._enter(call)  # noqa: E701  # fmt: skip

    def leave(self, call: _Call) -> None:
        with self._lock: self._leave(call)  # noqa: E701  # fmt: skip

    def _enter(self, call: _Call) -> None:
        if not self._inside:
            more = _with_more(_libraries()[0])
            self._changed = [*self._changed, *more]
            _set([(library, 1) for library, _ in more])
        self._inside.add(call)

    def _leave(self, call: _Call) -> None:
        self._inside.discard(call)
        if not self._inside:
            _set(self._changed)
            self._changed = []


_limit = _Limit()


def one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread, in whatever thread of Python's.

    As ``ThreadpoolController.limit``, but that only works in the thread that used it first, and costs twenty
    microseconds where there is one thread already. Where the number is one for the whole process, it is set back when
    no thread needs it any more.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        changed = _with_more(_libraries()[1])
        call = _Call()
        _limit.enter(call)
        try:
            _set([(library, 1) for library, _ in changed])
            return function(*args, **kwargs)
        finally:
            _set(changed)
            _limit.leave(call)

    return limited  # type: ignore[return-value]


def _with_more(libraries: list[LibController]) -> _Changed:
    """Those that have more threads than one, and how many."""
    return [(library, threads) for library in libraries if (threads := library.get_num_threads()) != 1]


def _set(numbers: _Changed) -> None:
    """Set numbers of threads. Since 3.8, threadpoolctl heeds only one thread of Python's unless that is cleared."""
    for library, threads in numbers:
        clear = getattr(library, "clear_controlling_thread", None)
        if clear is not None:
            clear(force=True)
        library.set_num_threads(threads)
        if clear is not None:
            clear(force=True)


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


T = TypeVar("T")

_LOOK = 0.1  # [s] between two looks for a signal


class _End:
    """What follows the last item: nothing, or the exception that ended the work."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


def _next(ready: queue.Queue[T]) -> T:
    """The next item of a queue. A signal that comes just before the wait takes effect at the next look."""
    while True:
        with suppress(queue.Empty):
            return ready.get(timeout=_LOOK)


def prefetch(items: Iterable[T], depth: int = 2) -> Iterator[T]:
    """The same items in the same order, made in a thread that is at most `depth` items ahead of the one in use.

    An exception of the iterator is raised where its item would have come. The thread ends with the generator: after its
    last item, when it is closed, or with the program, if an exception left the generator half used.
    """
    ready: queue.Queue[T | _End] = queue.Queue()
    places = threading.Semaphore(depth)
    stopped = threading.Event()

    def work() -> None:
        try:
            iterator = iter(items)
            while places.acquire() and not stopped.is_set():
                ready.put(next(iterator))
        except StopIteration:
            ready.put(_End())
        except BaseException as error:  # noqa: BLE001 - it is raised in the caller's thread
            ready.put(_End(error))

    def end() -> None:
        stopped.set()
        places.release()
        thread.join()

    thread = threading.Thread(target=work, name="prefetch", daemon=True)
    thread.start()
    atexit.register(end)  # a thread that runs on while Python is taken down may hang or abort it
    try:
        while not isinstance(item := _next(ready), _End):
            places.release()
            yield item
        if item.error is not None:
            raise item.error
    finally:
        atexit.unregister(end)
        end()
