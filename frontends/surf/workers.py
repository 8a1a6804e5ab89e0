"""Work on one image in several threads; what comes out does not depend on their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.threads import free_cores

_SMALLEST_SHARE = 32  # cost: items that are worth a task


class Workers:
    """A few threads, the caller's own included, for kernels that let go of Python's global lock."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pool: ThreadPoolExecutor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """What a copy holds: no threads; it starts its own."""
        return {**vars(self), "_pool": None}

    def run(self, tasks: Sequence[Callable[[], Any]]) -> list[Any]:
        """Results of independent tasks, in their order."""
        if len(tasks) < 2 or min(self._threads, free_cores()) == 1:
            return [task() for task in tasks]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._threads - 1, thread_name_prefix="surf")
        futures = [self._pool.submit(task) for task in tasks[1:]]
        first = tasks[0]()
        # The caller takes what nobody has begun yet, from the far end.
        results = [task() if future.cancel() else future for task, future in zip(tasks[:0:-1], futures[::-1])][::-1]
        return [first, *(r.result() if isinstance(r, Future) else r for r in results)]

    def over(self, count: int, function: Callable[[int, int], tuple[NDArray, ...]]) -> list[NDArray]:
        """The arrays of ``function(first, last)`` of consecutive shares of `count` items, put together."""
        shares = max(1, min(self._threads, free_cores(), count // _SMALLEST_SHARE))
        edges = [count * k // shares for k in range(shares + 1)]
        found = self.run([partial(function, a, b) for a, b in pairwise(edges)])
        return list(found[0]) if shares == 1 else [np.concatenate(parts) for parts in zip(*found)]
