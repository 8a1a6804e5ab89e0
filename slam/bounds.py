"""Checks of configuration classes: the type of every field, and ranges with an upper end."""

from __future__ import annotations

import numbers
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from slam.errors import ConfigurationError
from slam.naming import unknown

#: Numbers of settings lie below this, in whatever unit: their squares and products stay far from overflow.
MOST = 1e9

#: Positive settings, such as standard deviations, lie above this: so do the squares of their inverses.
LEAST = 1e-9

_COUNTS = 10**6  # whole numbers of settings: of frames, features, landmarks
_WORD, _TUPLE = 4096, 16  # most characters of a text, most elements of a tuple

_C = TypeVar("_C")
Ranges = Mapping[str, tuple[float, float]]


def require_not_negative(config: object, ranges: Ranges | None = None, owner: str = "") -> None:
    """Check the types of a configuration dataclass, and that its numbers are finite, not negative, and in their ranges.

    `ranges` has least and largest values by field, both allowed. Without one a number is zero, or `LEAST` to `MOST`;
    counts go to a million. `owner` says whose settings they are. Raises ConfigurationError.
    """
    mark, hints = f"{owner}: " if owner else "", _hints(type(config))  # type: ignore[arg-type]
    for f in fields(config):  # type: ignore[arg-type]
        value = getattr(config, f.name)
        if wanted := _wanted(value, hints[f.name], (ranges or {}).get(f.name)):
            raise ConfigurationError(f"{mark}{f.name} must be {wanted}, got {value!r}")


_hints = lru_cache(maxsize=64)(get_type_hints)

#: By type: what a value is an instance of, and that in words.
_TYPES: dict[Any, tuple[Any, str]] = {
    NoneType: (NoneType, "none"),
    bool: ((bool, np.bool_), "true or false"),
    str: (str, "a text"),
    int: (numbers.Integral, "a whole number"),
    float: (numbers.Real, "a number"),
    dict: (dict, "a mapping of names to values"),
}


def _wanted(value: Any, hint: Any, limits: tuple[float, float] | None) -> str:
    """What is required of a value of the wrong type, or out of its range; empty if it is right."""
    kind, kinds = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        faults = [_wanted(value, one, limits) for one in kinds]
        return "" if "" in faults else ", or ".join(faults)
    if kind is tuple:
        return _wanted_each(value, kinds, limits)
    of_class = (kind, f"of type {getattr(kind, '__name__', kind)}") if is_dataclass(kind) else (object, "")
    accepted, words = _TYPES.get(kind, of_class)
    fine = isinstance(value, accepted)
    if kind in (int, float):
        if not fine or isinstance(value, (bool, np.bool_)):
            return words
        least, most = limits or (0, _COUNTS if isinstance(value, numbers.Integral) else MOST)
        tiny = limits is None and 0 < value < LEAST
        return "" if least <= value <= most and not tiny else f"finite, from {least:g} to {most:g}"
    if kind is str:
        fine = fine and len(value) <= _WORD and "\0" not in value
    elif kind is dict:
        fine = fine and all(isinstance(key, str) for key in value)
    return "" if fine else words


def _wanted_each(value: Any, kinds: tuple[Any, ...], limits: tuple[float, float] | None) -> str:
    """As `_wanted`, for a tuple, or a list in its place."""
    if not isinstance(value, (tuple, list)):
        return "a list"
    if kinds[1:] == (Ellipsis,):
        if not 1 <= len(value) <= _TUPLE:
            return f"a list of 1 to {_TUPLE} values"
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        return f"a list of {len(kinds)} values"
    wanted = next(filter(None, (_wanted(one, kind, limits) for one, kind in zip(value, kinds))), "")
    return wanted and f"a list, each {wanted}"


def from_options(kind: type[_C], owner: str, options: Mapping[str, Any]) -> _C:
    """A configuration, of the dataclass `kind`, from keyword options of a front end or back end, its `owner`.

    Raises ConfigurationError where an option is unknown (the message lists the known ones) or out of its range.
    """
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for key in options:
        if key not in known:
            raise ConfigurationError(f"{owner}: {unknown('option', key, known)}")
    return kind(**options)
