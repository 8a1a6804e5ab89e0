"""All settings with meaning, unit and default, from the configuration classes and their docstrings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass
from inspect import cleandoc
from typing import Any

from slam import registry
from slam.config import SystemConfig
from slam.geometry.rig import StereoRig
from slam.models import KINDS
from slam.settings import can_be_set

_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.M)
_UNIT = re.compile(r"\[((?:px|m|rad|s|degrees|grey levels)(?:[²³]|/s²?|/√s)*(?: / √s)?)\]")
_PARTS = ("frontend", "backend")  # sections whose settings are those of a class chosen by name


@dataclass(frozen=True)
class Setting:
    """One setting."""

    key: str  # as ``--set`` takes it, such as ``"map.max_landmarks"``
    owner: str  # the front end or back end that has it; empty for settings that all runs have
    defaults: dict[str, Any]  # by kind of motion
    unit: str  # empty for words, counts and ratios
    text: str  # what it means


def settings() -> Iterator[Setting]:
    """All that a user can set: in every run, and of each front end and back end that can be loaded."""
    configs = {kind: SystemConfig.for_kind(kind) for kind in KINDS}
    for f in fields(SystemConfig):
        if f.name not in _PARTS:
            parts = {kind: getattr(config, f.name) for kind, config in configs.items()}
            yield from (s for s in _of_class(parts, f.name, "") if can_be_set(s.key, ""))
    rig = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)
    for section in _PARTS:
        for name in registry.names(f"{section}s"):
            parts, frontend = {}, name if section == "frontend" else None
            for kind in KINDS:
                options = getattr(SystemConfig.for_kind(kind, frontend), section)
                parts[kind] = getattr(registry.create(f"{section}s", name, rig, **options), "config", None)
            if all(map(is_dataclass, parts.values())):
                yield from (s for s in _of_class(parts, section, name) if can_be_set(s.key, name))


def _of_class(configs: dict[str, Any], section: str, owner: str) -> Iterator[Setting]:
    """Settings of one configuration class, given its instances by kind of motion."""
    first = next(iter(configs.values()))
    texts = documented(type(first))
    for f in fields(first):
        values, key = {kind: getattr(config, f.name) for kind, config in configs.items()}, f"{section}.{f.name}"
        if is_dataclass(getattr(first, f.name)):
            yield from _of_class(values, key, owner)
        else:
            yield Setting(key.lstrip("."), owner, values, *texts.get(f.name, ("", "")))


def descriptions(config: object, section: str) -> dict[str, dict[str, str]]:
    """Unit and meaning of each setting of a configuration below `section`, by key; nothing of another object."""
    if not is_dataclass(config) or isinstance(config, type):
        return {}
    return {s.key: {"unit": s.unit, "meaning": s.text} for s in _of_class({"": config}, section, "") if "." in s.key}


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


def in_force(part: object) -> dict[str, Any] | None:
    """All options of a front end or back end that it runs with; None where it has no configuration to tell."""
    config = getattr(part, "config", None)
    return asdict(config) if is_dataclass(config) and not isinstance(config, type) else None
