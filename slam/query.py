"""The options ``key=value&key=value`` behind a sequence's name, and the values that their texts mean."""

from __future__ import annotations

import math
from collections.abc import Collection
from urllib.parse import unquote

from slam.errors import ConfigurationError
from slam.naming import unknown


def read_query(query: str, owner: str = "", known: Collection[str] | None = None) -> dict[str, str]:
    """The options of a query as texts.

    ConfigurationError where one stands twice, holds a NUL, or is not `known` to its `owner`.
    """
    texts: dict[str, str] = {}
    for part in filter(None, query.split("&")):
        key, text = (unquote(word) for word in part.partition("=")[::2])
        if key in texts or "\0" in text:
            raise ConfigurationError(f"option {key!r} {'is given twice' if key in texts else 'holds a NUL'}")
        if known is not None and key not in known:
            raise ConfigurationError(f"{owner}: {unknown('option', key, sorted(known))}")
        texts[key] = text
    return texts


def number(name: str, text: str, low: float, high: float, whole: bool = False) -> float:
    """A number in its range, both ends included; raises ConfigurationError where the text is none."""
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        kind = "a whole number" if whole else "a number"
        raise ConfigurationError(f"{name} must be {kind} from {low:.10g} to {high:.10g}, got {text!r}")
    return value


def word(name: str, text: str, words: Collection[str]) -> str:
    """One of some words; raises ConfigurationError where the text is none."""
    if text not in words:
        raise ConfigurationError(f"{name} must be {' or '.join(words)}, got {text!r}")
    return text
