"""The options of a sequence, ``PATH?key=value``: checked before any file is read, refused where nothing uses them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl

from slam.errors import ConfigurationError
from slam.naming import suggestion, unknown

#: Options of every format whose calibration is in a file that can be named.
CALIBRATION = frozenset({"calibration", "unit", "rectified", "fisheye", "kind", "mask"})

#: Options that every recorded format knows; which of them mean something depends on what is found in the folder.
RECORDED = CALIBRATION | {"tolerance", "times", "fps", "left", "right", "layout"}

#: Frame rates that are believed [1/s].
SLOWEST, FASTEST = 1e-3, 1e5

#: Most that the option ``tolerance`` takes [s].
WIDEST_TOLERANCE = 10.0

#: Metres per unit of length.
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}

_MOST_OPTIONS = 100
_YES = {"1": True, "yes": True, "true": True, "0": False, "no": False, "false": False}


def _number(low: float, high: float) -> Callable[[str, str], float]:
    def read(name: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ConfigurationError(f"{name} must be a number from {low:g} to {high:g}, got {text!r}")
        return value

    return read


def _yes_or_no(name: str, text: str) -> bool:
    if text.lower() not in _YES:
        raise ConfigurationError(f"{name} must be yes or no, got {text!r}")
    return _YES[text.lower()]


def _kind(name: str, text: str) -> str:
    if text not in ("driving", "handheld"):
        raise ConfigurationError(unknown("kind of motion", text, ("driving", "handheld")))
    return text


def metres(name: str, text: str) -> float:
    """Metres in a unit of length."""
    if text not in METRES:
        raise ConfigurationError(f"{name} must be one of {', '.join(METRES)}, got {text!r}")
    return METRES[text]


def _layout(name: str, text: str) -> str:
    if text != "sbs":
        raise ConfigurationError(f"{name} must be sbs (side by side), got {text!r}")
    return text


#: What options are that are no plain texts.
_READERS: dict[str, Callable[[str, str], Any]] = {
    "kind": _kind,
    "unit": metres,
    "layout": _layout,
    "rectified": _yes_or_no,
    "fisheye": _yes_or_no,
    "swap": _yes_or_no,
    "fps": _number(SLOWEST, FASTEST),
    "tolerance": _number(0.0, WIDEST_TOLERANCE),
    "wait": _number(0.0, 86400.0),
    "width": _number(1, 100_000),
    "height": _number(1, 100_000),
}


class Options(dict[str, Any]):
    """Options by name, with their values; they remember which of them were read.

    Args:
        query: ``key=value&key=value``.
        format: for which they are, for messages.
        known: names of the options that the format has.

    Raises:
        ConfigurationError: an option is not known, or its value is none.
    """

    def __init__(self, query: str, format: str, known: frozenset[str]) -> None:
        super().__init__()
        self._read = {"kind"}
        texts = read_options(query)
        strange = sorted(set(texts) - known)
        if strange:
            hint = f"{suggestion(strange[0], known)}; known: {', '.join(sorted(known))}"
            raise ConfigurationError(f"unknown option {strange[0]!r} of format {format}{hint}")
        for name, text in texts.items():
            self[name] = _READERS[name](name, text) if name in _READERS else text

    def __getitem__(self, name: str) -> Any:
        self._read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """The option, or what stands for it."""
        self._read.add(name)
        return super().get(name, default)

    def require_read(self, what: str) -> None:
        """Raise ConfigurationError where an option was not read by anything."""
        unread = sorted(set(self) - self._read)
        if unread:
            raise ConfigurationError(f"option {unread[0]!r} does nothing here: {what}")


def read_options(query: str) -> dict[str, str]:
    """The options ``key=value&key=value`` as texts."""
    try:
        texts = dict(parse_qsl(query, keep_blank_values=True, max_num_fields=_MOST_OPTIONS))
    except ValueError:
        raise ConfigurationError(f"more than {_MOST_OPTIONS} options") from None
    for name, text in texts.items():
        if "\0" in text:
            raise ConfigurationError(f"option {name!r} holds a NUL")
    return texts
