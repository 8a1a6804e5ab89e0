"""One BLAS thread: the same sums in the same order on every machine, and no threads for small matrices."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

_F = TypeVar("_F", bound=Callable[..., Any])


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    """The BLAS libraries that are loaded, looked up once."""
    return ThreadpoolController()


def one_blas_thread(function: _F) -> _F:
    """Run with one BLAS thread."""

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited  # type: ignore[return-value]
