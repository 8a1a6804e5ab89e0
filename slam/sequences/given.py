"""The options of a sequence, ``PATH?key=value``: read where they mean something, refused where nothing reads them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl

from slam.errors import ConfigurationError
from slam.naming import suggestion, unknown

#: Kinds of motion.
KINDS = ("driving", "handheld")

#: Options of every format whose calibration is in a file that can be named.
CALIBRATION_OPTIONS = frozenset({"calibration", "unit", "rectified", "fisheye", "kind", "mask"})

#: Options that every recorded format knows; which of them mean something depends on what is found in the folder.
OPTIONS = CALIBRATION_OPTIONS | {"tolerance", "times", "fps", "left", "right", "layout"}

#: Frame rates that are believed [1/s].
SLOWEST, FASTEST = 1e-3, 1e5

#: Most that the option ``tolerance`` takes [s].
WIDEST_TOLERANCE = 10.0

_MOST_OPTIONS = 100
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_YES = {"1": True, "yes": True, "true": True, "0": False, "no": False, "false": False}


class Given(dict[str, str]):
    """Options that remember which of them were read."""

    def __init__(self, options: Mapping[str, str]) -> None:
        super().__init__(options)
        self._read = {"kind"}

    def __getitem__(self, name: str) -> str:
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

    def rate(self) -> float | None:
        """Frames per second by ``fps``."""
        return number(self, "fps", SLOWEST, FASTEST)

    def tolerance(self) -> int | None:
        """How far the stamps of a pair may be apart [ns] by ``tolerance`` [s]."""
        seconds = number(self, "tolerance", 0.0, WIDEST_TOLERANCE)
        return None if seconds is None else round(1e9 * seconds)


def read_options(query: str) -> dict[str, str]:
    """The options ``key=value&key=value`` behind a question mark."""
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, max_num_fields=_MOST_OPTIONS))
    except ValueError:
        raise ConfigurationError(f"more than {_MOST_OPTIONS} options") from None
    for key, value in options.items():
        if "\0" in value:
            raise ConfigurationError(f"option {key!r} holds a NUL")
    return options


def check_options(format: str, options: Mapping[str, str], known: frozenset[str]) -> None:
    """Raise ConfigurationError where an option is not known, or where a number, a word, yes or no is none."""
    strange = sorted(set(options) - known)
    if strange:
        hint = f"{suggestion(strange[0], known)}; known: {', '.join(sorted(known))}"
        raise ConfigurationError(f"unknown option {strange[0]!r} of format {format}{hint}")
    if options.get("kind", KINDS[0]) not in KINDS:
        raise ConfigurationError(unknown("kind of motion", options["kind"], KINDS))
    given = Given(options)
    given.rate(), given.tolerance(), metres_per_unit(given), layout_of(given)
    for name in ("rectified", "fisheye"):
        flag(given, name)


def number(options: Mapping[str, str], name: str, low: float, high: float) -> float | None:
    """An option that is a number in a range; None where it is not given."""
    if name not in options:
        return None
    try:
        value = float(options[name])
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ConfigurationError(f"{name} must be a number from {low:g} to {high:g}, got {options[name]!r}")
    return value


def flag(options: Mapping[str, str], name: str) -> bool:
    """An option that is yes or no."""
    text = options.get(name, "no").lower()
    if text not in _YES:
        raise ConfigurationError(f"{name} must be yes or no, got {text!r}")
    return _YES[text]


def metres_per_unit(options: Mapping[str, str]) -> float:
    """The option ``unit``, of length."""
    unit = options.get("unit", "m")
    if unit not in _UNITS:
        raise ConfigurationError(f"unit must be one of {', '.join(_UNITS)}, got {unit!r}")
    return _UNITS[unit]


def layout_of(options: Mapping[str, str]) -> str | None:
    """The option ``layout``; None where it is not given."""
    layout = options.get("layout")
    if layout not in (None, "sbs"):
        raise ConfigurationError(f"layout must be sbs (side by side), got {layout!r}")
    return layout
