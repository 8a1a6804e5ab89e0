"""A call that is interrupted, or raises an exception, leaves the filter as it was before."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])


def all_or_nothing(method: _F) -> _F:
    """Put the object back as it was where the method does not come to its end, as by an interrupt from the keyboard.

    The object offers ``saved()``, which returns a function that does so. The parts of a filter make that cheap: they
    replace their arrays, or note what stood there before they change one in place.
    """

    @wraps(method)
    def whole(self: Any, *args: Any, **kwargs: Any) -> Any:
        restore = self.saved()
        try:
            return method(self, *args, **kwargs)
        except BaseException:
            restore()
            raise

    return whole  # type: ignore[return-value]
