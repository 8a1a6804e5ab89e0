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

#: For whoever reads a configuration from text with pydantic: a key that is not a field is an error.
FORBID_UNKNOWN = {"extra": "forbid"}

#: Numbers of settings lie below this, in whatever unit: their squares and products stay far from overflow.
MOST = 1e9

#: Positive settings, such as standard deviations, lie above this: so do the squares of their inverses.
LEAST = 1e-9

_COUNTS = 10**6  # whole numbers of settings: of frames, features, landmarks
_WORD, _TUPLE = 4096, 16  # most characters of a text, most elements of a tuple

#: Ranges of fields whose cost grows faster than their value, in every class.
_COSTLY = {"grid": (1, 1000)}

_C = TypeVar("_C")
Ranges = Mapping[str, tuple[float, float]]


def require_positive(config: object, ranges: Ranges | None = None, owner: str = "") -> None:
    """Check the types of a configuration dataclass, and that its numbers are positive and in their ranges.

    `ranges` has least and largest values by field, both allowed; default: `LEAST` to `MOST`, counts to a million.
    `owner` says whose settings they are.

    Raises:
        ConfigurationError: a value is of the wrong type or out of its range.
    """
    _require(config, ranges or {}, owner, positive=True)


def require_not_negative(config: object, ranges: Ranges | None = None, owner: str = "") -> None:
    """As `require_positive`, for numbers that may be zero."""
    _require(config, ranges or {}, owner, positive=False)


def _require(config: object, ranges: Ranges, owner: str, positive: bool) -> None:
    mark = f"{owner}: " if owner else ""
    hints = _hints(type(config))  # type: ignore[arg-type]
    for f in fields(config):  # type: ignore[arg-type]
        value = getattr(config, f.name)
        fault = _type_fault(value, hints[f.name])
        if fault:
            raise ConfigurationError(f"{mark}{f.name} must be {fault}, got {value!r}")
        for number in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(number, numbers.Real) and not isinstance(number, (bool, np.bool_)):
                fault = _range_fault(number, ranges.get(f.name, _COSTLY.get(f.name)), positive)
                if fault:
                    raise ConfigurationError(f"{mark}{f.name} must be {fault}, got {value}")


def _range_fault(number: Any, limits: tuple[float, float] | None, positive: bool) -> str:
    """What is required of a number outside its range; empty if it is inside."""
    whole = isinstance(number, numbers.Integral)
    text = "positive and finite" if positive else "finite and not negative"
    if limits is not None and number == limits[1]:  # which may be infinite
        return ""
    if not (whole or np.isfinite(number)) or number < 0 or (positive and number == 0):
        return text
    least, most = limits or (0 if whole else LEAST, _COUNTS if whole else MOST)
    zero = number == 0 and limits is None and not positive
    return "" if zero or least <= number <= most else f"{text}, from {least:g} to {most:g}"


@lru_cache(maxsize=64)
def _hints(kind: type) -> dict[str, Any]:
    """Types of a dataclass's fields."""
    return get_type_hints(kind)


def _type_fault(value: Any, hint: Any) -> str:
    """What is required of a value of the wrong type; empty if the type is right."""
    if get_origin(hint) in (Union, UnionType):
        faults = [_type_fault(value, kind) for kind in get_args(hint)]
        return "" if "" in faults else " or ".join(filter(None, faults))
    if hint is NoneType:
        return "" if value is None else "none"
    if hint is bool:
        return "" if isinstance(value, (bool, np.bool_)) else "true or false"
    if hint is str:
        return "" if isinstance(value, str) and len(value) <= _WORD and "\0" not in value else "a text"
    if hint is int or hint is float:
        kind = numbers.Integral if hint is int else numbers.Real
        good = isinstance(value, kind) and not isinstance(value, (bool, np.bool_))
        return "" if good else "a whole number" if hint is int else "a number"
    if get_origin(hint) is tuple:
        return _tuple_fault(value, get_args(hint))
    if get_origin(hint) is dict:
        good = isinstance(value, dict) and all(isinstance(key, str) for key in value)
        return "" if good else "a mapping of names to values"
    if isinstance(hint, type) and is_dataclass(hint):
        return "" if isinstance(value, hint) else f"of type {hint.__name__}"
    return ""


def _tuple_fault(value: Any, kinds: tuple[Any, ...]) -> str:
    """As `_type_fault`, for a tuple, or a list in its place."""
    if not isinstance(value, (tuple, list)):
        return "a list"
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        if not 1 <= len(value) <= _TUPLE:
            return f"a list of 1 to {_TUPLE} values"
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        return f"a list of {len(kinds)} values"
    faults = [_type_fault(v, kind) for v, kind in zip(value, kinds)]
    return next((f"a list, each {fault}" for fault in faults if fault), "")


def from_options(kind: type[_C], owner: str, options: Mapping[str, Any]) -> _C:
    """A configuration, of the dataclass `kind`, from keyword options of a front end or back end, its `owner`.

    Raises:
        ConfigurationError: an option is unknown (the message lists the known ones) or out of its range.
    """
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for key in options:
        if key not in known:
            raise ConfigurationError(f"{owner}: {unknown('option', key, known)}")
    return kind(**options)
