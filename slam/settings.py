"""``section.key=value`` settings, put into a tree of frozen dataclasses."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from typing import Any, get_args, get_type_hints

from slam.bounds import MOST
from slam.errors import ConfigurationError
from slam.naming import suggestion, unknown

_FREE = ("frontend", "backend")  # their options are checked by the front end or back end itself

#: Settings that a user can set, by section, and by name of a front end. The others are the program's own: they are in
#: ``config.json``, and change from version to version. All options of back ends, and of
#: front ends from elsewhere, can be set.
SETTABLE: dict[str, tuple[str, ...]] = {
    "models": ("motion.acceleration", "motion.angular_acceleration", "pixel_sigma"),
    "association": ("align",),
    "map": ("target_in_view", "max_landmarks", "max_depth_error", "monocular", "restart_after"),
    "atlas": ("enabled",),
    "self_calibration": ("enabled", "systematic"),
    "objects": ("mode", "max_speed", "min_speed", "database"),
    "surf": ("features", "descriptor", "upright", "min_depth", "max_depth", "threads"),
}


def with_changes(config: Any, settings: Sequence[str] | Mapping[str, Any]) -> Any:
    """A configuration, a tree of dataclasses, with other values of some settings, converted and checked by its classes.

    Settings are texts such as ``"map.max_landmarks=300"``, whose values are JSON or plain words; or values by key, or
    by section and key.
    Raises ConfigurationError where a text is not of that form, a section or key is unknown, or a value is refused.
    """
    given: list[tuple[str, Any, str]] = []  # keys, values, and both as they were given
    if isinstance(settings, Mapping):
        given = [(key, value, f"{key}={value}") for key, value in leaves(settings)]
    elif not isinstance(settings, (list, tuple)) or not all(isinstance(setting, str) for setting in settings):
        raise ConfigurationError("settings must be a list of texts section.key=value, or a dict of values by key")
    else:
        for setting in settings:
            key, equals, text = setting.partition("=")
            if not equals:
                raise ConfigurationError(f"setting {setting!r} is not of the form section.key=value")
            given.append((key.strip(), _value(text.strip()), setting))
    known, changes = [key for key, _ in leaves(asdict(config)) if key not in _FREE], dict[str, Any]()
    for key, value, setting in given:
        if value == {} and (key in _FREE or any(other.startswith(f"{key}.") for other in known)):
            continue  # a section of which nothing is set
        section, dot, option = key.partition(".")
        if section in _FREE and dot:
            changes.setdefault(section, {})[option] = value
            continue
        if key not in known:
            raise ConfigurationError(f"setting {setting!r}: {_unknown(key, known)}")
        node, (*sections, name) = changes, key.split(".")
        for section in sections:
            node = node.setdefault(section, {})
        node[name] = value
    return _replaced(config, changes)


def _replaced(part: Any, changes: Mapping[str, Any], where: str = "") -> Any:
    """A dataclass of settings, and those in it, with other values; `where` is its place in the whole."""
    values, hints = dict(changes), get_type_hints(type(part))
    for name, value in changes.items():
        before = getattr(part, name)
        if is_dataclass(before):
            values[name] = _replaced(before, value, f"{where}{name}.")
        else:
            values[name] = before | value if isinstance(before, dict) else _as_hinted(value, hints[name])
    try:
        return replace(part, **values)
    except ConfigurationError as error:
        said = str(error).removeprefix(f"{where[:-1].rpartition('.')[2]}: ")  # the section names itself
        raise ConfigurationError(f"setting {where}{said}") from None


def _as_hinted(value: Any, hint: Any) -> Any:
    """A value of a text as the field has it: ``3`` is 3.0 where numbers need not be whole, a list is a tuple."""
    if isinstance(value, list):
        inner = next(iter(get_args(hint)), None)
        return tuple(_as_hinted(one, inner) for one in value)
    return float(value) if hint is float and type(value) is int and abs(value) <= MOST else value


def can_be_set(key: str, owner: str = "") -> bool:
    """Whether a user can set this key, such as ``"map.grid"``; `owner` is the front end or back end that has it."""
    section, _, name = key.partition(".")
    names = SETTABLE.get(owner or section)
    return names is None or name in names


def require_settable(settings: Iterable[str], tree: Mapping[str, Any], frontend: str) -> None:
    """Refuse texts ``section.key=value`` of settings that are the program's own; other faults `with_changes` finds.

    `tree` is the configuration that they are for, `frontend` the name of the front end. Raises ConfigurationError.
    """
    known = dict(leaves(tree))
    for key in (text.partition("=")[0].strip() for text in settings):
        own = key.startswith("frontend.") and frontend in SETTABLE
        if (key in known or own) and not can_be_set(key, frontend if own else ""):
            near = suggestion(key.rpartition(".")[2], SETTABLE[frontend]) if own else ""
            raise ConfigurationError(f"setting {key}: cannot be set{near}; `slam settings` lists those that can")


def _value(text: str) -> Any:
    """The parsed value if the text is JSON, else the text; too deep nesting or too many digits count as no JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _unknown(key: str, known: Sequence[str]) -> str:
    """The line for a key that is none of those `known`; one that another section has is suggested with it.

    Only what users can set is named.
    """
    if key in _FREE or any(other.startswith(f"{key}.") for other in known):
        return f"{key.rpartition('.')[2]!r} is a section; set {key}.KEY=VALUE"
    settable = [other for other in known if can_be_set(other)]
    above, (name, *rest) = "", key.split(".")
    while rest and any(other.startswith(f"{above}{name}.") for other in known):
        above, name, rest = f"{above}{name}.", rest[0], rest[1:]
    what = "section" if rest else "key"
    below = (other.removeprefix(above).partition(".")[0] for other in settable if other.startswith(above))
    names = list(dict.fromkeys([*below, *([] if above else _FREE)]))
    elsewhere = [other for other in settable if other.rpartition(".")[2] == key.rpartition(".")[2]]
    if not elsewhere:
        return unknown(what, name, names)
    return f"unknown {what} {name!r} (did you mean {' or '.join(map(repr, elsewhere))}?); known: {', '.join(names)}"


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names of all settings in a configuration's tree, such as ``"map.grid"``, and their values.

    Options of front end and back end may be dicts themselves, and an empty section is a value.
    """
    for key, value in tree.items():
        section, dot, _ = f"{prefix}{key}".partition(".")
        if isinstance(value, dict) and value and not (dot and section in _FREE):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
