"""One BLAS thread: the same sums in the same order on every machine, and no threads for small matrices."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import LibController, ThreadpoolController

_F = TypeVar("_F", bound=Callable[..., Any])


@lru_cache(maxsize=1)
def _libraries() -> list[LibController]:
    """The BLAS libraries that are loaded, looked up once."""
    return [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]


def one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread.

    As ``ThreadpoolController.limit``, but where there is one thread already it costs a microsecond and not twenty.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        changed = [(library, threads) for library in _libraries() if (threads := library.get_num_threads()) != 1]
        try:
            for library, _ in changed:
                library.set_num_threads(1)
            return function(*args, **kwargs)
        finally:
            for library, threads in changed:
                library.set_num_threads(threads)

    return limited  # type: ignore[return-value]
