"""Names: suggestions for unknown ones, for error messages, and how any can be shown."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

_UNSHOWN = "\N{REPLACEMENT CHARACTER}"
_LIKE = 0.6  # least similarity of a suggestion, from 0 to 1


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The most similar known name, upper and lower case alike; None where none is similar."""
    by_case = {other.lower(): other for other in known}
    near = get_close_matches(str(name).lower(), by_case, 1, _LIKE)
    return by_case[near[0]] if near else None


def printable(text: str) -> str:
    """A text for pictures and pages: control characters and halves of characters are replaced.

    >>> printable("a" + chr(27) + "b")
    'a�b'
    """
    return "".join(letter if letter.isprintable() else _UNSHOWN for letter in text)


def suggestion(name: str, known: Iterable[str]) -> str:
    """The most similar known name as `` (did you mean 'x'?)``; empty where none is similar.

    >>> suggestion("smother", ["batch", "ekf", "smoother"])
    " (did you mean 'smoother'?)"
    >>> suggestion("kalman", ["batch", "ekf", "smoother"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near!r}?)" if near else ""


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The line for a name that is not known: the nearest known name, and all of them.

    >>> unknown("back end", "efk", ["ekf", "smoother"])
    "unknown back end 'efk' (did you mean 'ekf'?); known: ekf, smoother"
    """
    names = list(known)
    return f"unknown {what} {name!r}{suggestion(name, names)}; known: {', '.join(names)}"
