"""The options of a sequence, ``PATH?key=value``: read where they mean something, refused where nothing reads them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from slam.errors import ConfigurationError

#: Options that every recorded format knows; which of them mean something depends on what is found in the folder.
_CALIBRATION, _IMAGES = {"calibration", "unit", "rectified", "fisheye"}, {"left", "right", "layout", "mask"}
OPTIONS = frozenset({"kind", "tolerance", "times", "fps"} | _CALIBRATION | _IMAGES)

#: Frame rates that are believed [1/s].
SLOWEST, FASTEST = 1e-3, 1e5

#: Most that the option ``tolerance`` takes [s].
WIDEST_TOLERANCE = 10.0
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
        """Raise where an option was not read by anything.

        Raises:
            ConfigurationError: one was not.
        """
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


def number(options: Mapping[str, str], name: str, low: float, high: float) -> float | None:
    """An option that is a number; None where it is not given.

    Raises:
        ConfigurationError: it is none, or out of its range.
    """
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
    """An option that is yes or no.

    Raises:
        ConfigurationError: it is neither.
    """
    text = options.get(name, "no").lower()
    if text not in _YES:
        raise ConfigurationError(f"{name} must be yes or no, got {text!r}")
    return _YES[text]


def layout_of(options: Mapping[str, str]) -> str | None:
    """The option ``layout``; None where it is not given.

    Raises:
        ConfigurationError: it is none.
    """
    layout = options.get("layout")
    if layout not in (None, "sbs"):
        raise ConfigurationError(f"layout must be sbs (side by side), got {layout!r}")
    return layout
