"""All settings with meaning, unit and default, from the configuration classes and their docstrings."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from inspect import cleandoc
from textwrap import wrap
from typing import Any

from slam import registry
from slam.config import SystemConfig
from slam.errors import UnknownNameError
from slam.geometry.rig import StereoRig
from slam.models import KINDS
from slam.naming import unknown
from slam.settings import can_be_set, leaves

_ENTRY = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.M)
_RIG = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)
_FIRST = next(iter(KINDS))
_PARTS = ("frontend", "backend")  # sections whose settings are those of a class chosen by name


@dataclass(frozen=True)
class Setting:
    """One setting."""

    key: str  # as ``--set`` takes it, such as ``"map.max_landmarks"``
    owner: str  # the front end or back end that has it; empty for settings that all runs have
    defaults: dict[str, Any]  # by kind of motion
    text: str  # what it means, with its unit


def settings() -> Iterator[Setting]:
    """All that a user can set: in every run, and of each front end and back end that can be loaded."""
    configs = {kind: SystemConfig.for_kind(kind) for kind in KINDS}
    for key, _ in leaves(configs[_FIRST].to_json()):
        *path, name = key.split(".")
        if key.partition(".")[0] not in _PARTS and can_be_set(key):
            parts = {kind: reduce(getattr, path, config) for kind, config in configs.items()}
            defaults = {kind: getattr(part, name) for kind, part in parts.items()}
            yield Setting(key, "", defaults, documented(type(parts[_FIRST])).get(name, ""))
    for section in _PARTS:
        for name in registry.names(f"{section}s"):
            yield from _options_of(section, name)


def _options_of(section: str, name: str) -> Iterator[Setting]:
    """Options that a user can set of a front end (`section` is ``"frontend"``) or back end by its name."""
    known = registry.options_of(registry.resolve(f"{section}s", name), _RIG)
    for option, (default, described) in known.items():
        key = f"{section}.{option}"
        if can_be_set(key, name):
            configs = {kind: SystemConfig.for_kind(kind, name if section == "frontend" else None) for kind in KINDS}
            defaults = {kind: getattr(config, section).get(option, default) for kind, config in configs.items()}
            yield Setting(key, name, defaults, documented(described).get(option, ""))


def listing(wanted: str | None, width: int) -> Iterator[str]:
    """Lines of at most `width` characters on all settings, or those of a section, front end or back end, or one.

    Raises UnknownNameError where there is no such section or setting.
    """
    if wanted is not None and ":" in wanted:  # a class of one's own
        part = registry.resolve("backends", wanted)
        chosen = list(_options_of("frontend" if hasattr(part, "extract") else "backend", wanted))
        if not chosen:
            yield f"{wanted} has no options: neither its constructor has any, nor a dataclass in its `config`."
            return
    else:
        every = list(settings())
        chosen = [s for s in every if wanted is None or wanted in (s.key, s.owner) or s.key.startswith(f"{wanted}.")]
        if not chosen:
            if any(wanted in registry.names(f"{section}s") for section in _PARTS):
                yield f"{wanted} has no options."
                return
            names = dict.fromkeys(name for s in every for name in (s.key.partition(".")[0], s.owner) if name)
            same = dict.fromkeys(s.key for s in every if s.key.rpartition(".")[2] == wanted)
            line = unknown("section or setting", wanted or "", names) + "; or a class of your own: module:Class"
            raise UnknownNameError(f"{line}; there is {', '.join(same)}" if same else line)
    before = ""
    for setting in chosen:
        section = setting.key.partition(".")[0]
        what = f"options of {setting.owner}" if setting.owner else documented(SystemConfig)[section]
        if (title := f"{section}: {what}") != before:
            yield from ([""] if before else [])
            yield from wrap(title, width)
            before = title
        (_, first), *rest = setting.defaults.items()
        others = (f"; {kind}: {_typed(value)}" for kind, value in rest if value != first)
        yield f"  {setting.key} = {_typed(first)}{''.join(others)}"
        yield from wrap(setting.text, width, initial_indent="      ", subsequent_indent="      ")
    yield from ("", "Change one with --set KEY=VALUE.")


def _typed(value: Any) -> str:
    return (value or '""') if isinstance(value, str) else json.dumps(value)


def documented(kind: Any) -> dict[str, str]:
    """Meaning of each field of a class, from the ``Attributes:`` of its docstring and of its bases'.

    Of arguments of a constructor or function, from ``Args:``.
    """
    found: dict[str, str] = {}
    for base in reversed(getattr(kind, "__mro__", (kind,))):
        section = re.search(r"^(?:Attributes|Args):\n((?: {4}.*\n?|\n)*)", cleandoc(base.__doc__ or ""), re.M)
        for names, text in _ENTRY.findall(section[1] if section else ""):
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()).replace("``", "").rstrip("."))
    return found
