"""Objects for one thread at a time: a second one is refused, in one line, instead of spoiling the first one's work."""

from __future__ import annotations

import threading

from slam.errors import SlamError


class OneThread:
    """``with`` this around what one thread may do at a time; not to be nested.

    A copy, also a pickled one, is free.

    Args:
        what: is refused, for the message.

    Raises:
        SlamError: on entry, while another thread is inside.
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
