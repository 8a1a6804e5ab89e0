"""Exceptions of third-party back ends and front ends, in one line that names the part, the call and the frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from traceback import walk_tb

from slam.errors import PartError, SlamError, cause, text_of

_OURS = ("slam", "backends", "frontends")


@contextmanager
def named_failures(place: str, *parts: object) -> Iterator[None]:
    """Turn exceptions that a third-party part raised, or that its return values may have caused, into `PartError`.

    If all parts are our own, exceptions pass unchanged.

    Args:
        place: the present operation, for the message.
        parts: the back end, the front end.

    Raises:
        PartError: chained from the exception.
    """
    try:
        yield
    except SlamError:
        raise
    except (Exception, SystemExit) as error:  # whatever a third-party class does
        foreign = [part for part in parts if type(part).__module__.partition(".")[0] not in (*_OURS, "builtins")]
        if not foreign or (isinstance(error, SystemExit) and not any(_raised_by(part, error) for part in foreign)):
            raise
        part, call = next(((part, f".{call}") for part in foreign if (call := _call(error, part))), (foreign[0], ""))
        failed = "failed" if call else "may have failed"  # what it answered may have broken something of ours
        raise PartError(f"{place}: {type(part).__name__}{call} {failed}: {cause(error)}") from error


def _raised_by(part: object, error: BaseException) -> bool:
    """Whether an exception was raised in the module of `part`, not by a signal handler elsewhere."""
    *_, (frame, _) = walk_tb(error.__traceback__)
    return frame.f_globals.get("__name__") == type(part).__module__


def _call(error: BaseException, part: object) -> str:
    """The method of `part` that raised an exception, or was called wrongly; empty for none."""
    for frame, _ in walk_tb(error.__traceback__):
        first = frame.f_code.co_varnames[:1]
        if first and frame.f_locals.get(first[0]) is part:
            return frame.f_code.co_name
    name, dot, rest = text_of(error).partition(".")
    return rest.partition("(")[0] if dot and isinstance(error, TypeError) and name == type(part).__qualname__ else ""
