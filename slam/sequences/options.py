"""The options of a sequence, ``PATH?key=value``: checked before any file is read, refused where nothing uses them."""

from __future__ import annotations

import math
from typing import Any

from slam.errors import ConfigurationError
from slam.geometry.camera import UNITS
from slam.geometry.trajectory import TruthNoise
from slam.query import number, read_query, word

#: Options of every format whose calibration is in a file that can be named.
CALIBRATION = frozenset({"calibration", "unit", "rectified", "fisheye", "kind", "mask", "swap"})

#: Options that every recorded format knows; which of them mean something depends on what is found in the folder.
RECORDED = CALIBRATION | {"tolerance", "times", "fps", "left", "right", "layout", "truth", "truth_sigma"}

#: Frame rates that are believed [1/s].
SLOWEST, FASTEST = 1e-3, 1e5

#: Most that the option ``tolerance`` takes [s].
WIDEST_TOLERANCE = 10.0

_WORDS: dict[str, dict[str, Any]] = {
    "kind": {"driving": "driving", "handheld": "handheld"},
    "unit": UNITS,
    "layout": {"sbs": "sbs"},  # side by side
    **{name: {"yes": True, "no": False} for name in ("rectified", "fisheye", "swap")},
}
_RANGES = {
    "fps": (SLOWEST, FASTEST),
    "tolerance": (0.0, WIDEST_TOLERANCE),
    "wait": (0.0, 86400.0),
    "width": (1, 100_000),
    "height": (1, 100_000),
}


def value_of(name: str, text: str) -> Any:
    """The value of an option: a word's, a number in its range, or the text; ConfigurationError where it is none."""
    if name in _WORDS:
        return _WORDS[name][word(name, text, _WORDS[name])]
    return number(name, text, *_RANGES[name]) if name in _RANGES else text


def truth_noise(text: str) -> TruthNoise:
    """The errors of a true path, of each axis: ``METRES`` or ``METRES,DEGREES``; ConfigurationError for others."""
    metres, comma, degrees = text.partition(",")
    sigma = number("truth_sigma in metres", metres, 0.0, 100.0)
    turned = number("truth_sigma in degrees", degrees, 0.0, 90.0) if comma else 0.0
    return TruthNoise(rotation=math.radians(turned), translation=sigma)


class Options(dict[str, Any]):
    """Options of a format by name, with their values; they remember which of them were read.

    ConfigurationError where the query has one twice, one that is not `known`, or whose value is none.
    """

    def __init__(self, query: str, format: str, known: frozenset[str]) -> None:
        self._read = {"kind"}
        texts = read_query(query, f"format {format}", known)
        super().__init__({name: value_of(name, text) for name, text in texts.items()})

    def __getitem__(self, name: str) -> Any:
        self._read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """The option, or what stands for it."""
        self._read.add(name)
        return super().get(name, default)

    def require_read(self, what: str) -> None:
        """Raise ConfigurationError where an option was not read by anything."""
        for name in sorted(set(self) - self._read):
            raise ConfigurationError(f"option {name!r} does nothing here: {what}")
