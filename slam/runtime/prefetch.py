"""An iterator that works ahead in a thread of its own, so that the next item is made while the present one is used."""

from __future__ import annotations

import atexit
import queue
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import TypeVar

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
