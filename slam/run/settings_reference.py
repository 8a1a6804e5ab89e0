"""All settings with meaning, unit, default and range, from the configuration classes: their docstrings and checks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import partial
from inspect import cleandoc
from math import inf
from typing import Any, get_args, get_type_hints

from slam import registry
from slam.bounds import LEAST
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.models import KINDS

_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.M)
_UNIT = re.compile(r"\[((?:px|m|rad|s|degrees|grey levels)(?:[²³]|/s²?|/√s)*(?: / √s)?)\]")
_TRIED = 130  # whole numbers from zero on that are tried one by one, to find sets such as 16 and 64
_LARGE, _SMALL, _STEPS = 1e15, 1e-12, 110  # taken for infinity, and for zero; bisections between the two
_PARTS = ("frontend", "backend")  # sections whose settings are those of a class chosen by name


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        key: as ``--set`` takes it, such as ``"map.grid"``.
        owner: the front end or back end that has it; empty for settings that all runs have.
        defaults: by kind of motion.
        unit: empty for words, counts and ratios.
        text: what it means.
        range: the values that are accepted while all others have their defaults, as an interval or as a list.
    """

    key: str
    owner: str
    defaults: dict[str, Any]
    unit: str
    text: str
    range: str


def settings() -> Iterator[Setting]:
    """All settings: those of every run, and those of each front end and back end that can be loaded."""
    configs = {kind: SystemConfig.for_kind(kind) for kind in KINDS}
    for f in fields(SystemConfig):
        if f.name not in _PARTS:
            yield from _of_class({kind: getattr(config, f.name) for kind, config in configs.items()}, f.name, "")
    for section in _PARTS:
        for name in registry.names(f"{section}s"):
            parts = {kind: _config_of(section, name, kind) for kind in KINDS}
            if all(map(is_dataclass, parts.values())):
                yield from _of_class(parts, section, name)


def descriptions(config: object, section: str) -> dict[str, dict[str, str]]:
    """Unit and meaning of each setting of a configuration, by key; nested configurations included.

    Args:
        config: a dataclass with its fields described under ``Attributes:``; nothing comes of another object.
        section: its name, in front of each key.
    """
    found: dict[str, dict[str, str]] = {}
    if not is_dataclass(config) or isinstance(config, type):
        return found
    texts = documented(type(config))
    for f in fields(config):
        value, key = getattr(config, f.name), f"{section}.{f.name}".lstrip(".")
        if is_dataclass(value):
            found |= descriptions(value, key)
        elif section:
            unit, text = texts.get(f.name, ("", ""))
            found[key] = {"unit": unit, "meaning": text}
    return found


def documented(kind: type) -> dict[str, tuple[str, str]]:
    """Unit and meaning of each field of a class, from the ``Attributes:`` of its docstring and of its bases'."""
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        section = re.search(r"^Attributes:\n((?: {4}.*\n?|\n)*)", cleandoc(base.__doc__ or ""), re.M)
        for names, text in _ENTRY.findall(section[1] if section else ""):
            plain = " ".join(text.split())
            units, each = _UNIT.findall(plain), names.split(", ")
            for i, name in enumerate(each):
                unit = units[i] if len(units) == len(each) else units[0] if units else ""
                found[name] = unit, plain.replace("``", "").rstrip(".")
    return found


def _of_class(configs: dict[str, Any], section: str, owner: str) -> Iterator[Setting]:
    """Settings of one configuration class, given its instances by kind of motion."""
    first = next(iter(configs.values()))
    texts, types = documented(type(first)), get_type_hints(type(first))
    for f in fields(first):
        values, key = {kind: getattr(config, f.name) for kind, config in configs.items()}, f"{section}.{f.name}"
        if is_dataclass(getattr(first, f.name)):
            yield from _of_class(values, key, owner)
        else:
            unit, text = texts.get(f.name, ("", ""))
            yield Setting(key, owner, values, unit, text, _range(first, f.name, types[f.name], text))


def _config_of(section: str, name: str, kind: str) -> Any:
    """The configuration of a front end or back end as it is made by default; None where it has none."""
    rig = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)
    named: dict[str, Any] = {section: name}
    options = getattr(SystemConfig.for_kind(kind, **named), section)
    return getattr(registry.create(f"{section}s", name, rig, **options), "config", None)


def _range(config: Any, name: str, annotation: Any, text: str) -> str:
    """What a field accepts, as the class itself checks it."""
    accepts = partial(_accepts, config, name)
    kinds, default = get_args(annotation) or (annotation,), getattr(config, name)
    if isinstance(default, tuple):
        return f"{len(default)} {'whole ' if int in kinds else ''}numbers"
    also = " or null" if type(None) in kinds else ""
    if kinds == (type(None),):
        return "null"
    if bool in kinds:
        return "true or false"
    if str in kinds:
        words = re.findall(r'"(\w+)"', text)
        return ", ".join(words) if default in words else "text"
    if int in kinds or float in kinds:
        return _range_of_numbers(accepts, default, int in kinds) + also
    return "list" + also


def _range_of_numbers(accepts: Callable[[float], bool], default: float | None, whole: bool) -> str:
    """Which numbers are accepted: a list such as ``"16, 64"``, or an interval such as ``"(0, 1]"``."""
    tried = [n for n in range(_TRIED) if accepts(n)] if whole else []
    if tried and tried[-1] < _TRIED - 1 and tried != list(range(tried[0], tried[-1] + 1)):
        return ", ".join(map(str, tried))
    inside = default if default is not None else next(iter(tried), None)
    if inside is None:
        return "numbers"
    low, high = (_last(accepts, max(-_LARGE, min(inside, _LARGE)), sign * _LARGE, whole) for sign in (-1, 1))
    first = "(-∞" if low == -inf else f"{'[' if accepts(low) else '('}{low:.10g}"
    return f"{first}, " + ("∞)" if high == inf else f"{high:.10g}{']' if accepts(high) else ')'}")


def _last(accepts: Callable[[float], bool], inside: float, outside: float, whole: bool) -> float:
    """The last accepted number on the way from one inside to one outside; infinite where all are accepted."""
    if accepts(int(outside) if whole else outside):
        return inf if outside > 0 else -inf
    for _ in range(_STEPS):
        middle = (inside + outside) / 2
        if whole:
            middle = int(inside + outside) // 2 if outside > inside else -(int(-inside - outside) // 2)
        if middle in (inside, outside):
            break
        inside, outside = (middle, outside) if accepts(middle) else (inside, middle)
    if abs(inside) < 2 * LEAST and accepts(0):  # nothing between zero and `LEAST` is accepted where zero is
        return 0
    end = float(f"{0 if abs(inside) < _SMALL else inside:.9g}")
    return int(end) if end.is_integer() else end


def _accepts(config: Any, name: str, value: Any) -> bool:
    """Whether a configuration can be made with this value."""
    try:
        replace(config, **{name: value})
    except (ConfigurationError, TypeError, ValueError, OverflowError):
        return False
    return True


def in_force(part: object) -> dict[str, Any] | None:
    """All options of a front end or back end that it runs with; None where it has no configuration to tell."""
    config = getattr(part, "config", None)
    return asdict(config) if is_dataclass(config) and not isinstance(config, type) else None
