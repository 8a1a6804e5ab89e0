"""``section.key=value`` settings, put into a tree of plain types."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

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


def apply_settings(tree: dict[str, Any], settings: Sequence[str] | Mapping[str, Any]) -> None:
    """Change leaves of a configuration's tree in place; types and ranges are checked when it is read back.

    Settings are texts such as ``"map.max_landmarks=300"``, whose values are JSON or plain words; or values by key.
    Raises ConfigurationError where a text is not of that form, or its section or key is unknown.
    """
    if isinstance(settings, Mapping):
        for key, value in settings.items():
            _set(tree, str(key).split("."), value, f"{key}={value}")
        return
    if not isinstance(settings, (list, tuple)) or not all(isinstance(setting, str) for setting in settings):
        raise ConfigurationError("settings must be a list of texts section.key=value, or a dict of values by key")
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"setting {setting!r} is not of the form section.key=value")
        _set(tree, path.strip().split("."), _value(text.strip()), setting)


def can_be_set(key: str, owner: str = "") -> bool:
    """Whether a user can set this key, such as ``"map.grid"``; `owner` is the front end or back end that has it."""
    section, _, name = key.partition(".")
    names = SETTABLE.get(owner or section)
    return names is None or name in names


def require_settable(settings: Iterable[str], tree: Mapping[str, Any], frontend: str) -> None:
    """Refuse texts ``section.key=value`` of settings that are the program's own; other faults `apply_settings` finds.

    `tree` is the configuration that they are for, `frontend` the name of the front end. Raises ConfigurationError.
    """
    known = set(leaves(dict(tree)))
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


def _set(tree: dict[str, Any], path: list[str], value: Any, setting: str) -> None:
    """Set one leaf of the tree; every key on the way must exist, except options of front end and back end."""
    node = tree
    for depth, key in enumerate(path):
        last = depth == len(path) - 1
        free = last and depth > 0 and path[0] in _FREE
        if last and isinstance(node.get(key), dict):
            raise ConfigurationError(f"setting {setting!r}: {key!r} is a section; set {'.'.join(path)}.KEY=VALUE")
        if not free and (key not in node or (last and depth == 0) or not (last or isinstance(node[key], dict))):
            what = "key" if last else "section"
            raise ConfigurationError(f"setting {setting!r}: {_unknown(what, key, path[:depth], tree, path[-1])}")
        if last:
            node[key] = value
        else:
            node = node[key]


def _unknown(what: str, name: str, above: list[str], tree: dict[str, Any], leaf: str) -> str:
    """The line for an unknown name in a section; a key that another one has is suggested with it.

    Only what users can set is named.
    """
    settable = [key for key in leaves(tree) if can_be_set(key) and key.partition(".")[0] not in _FREE]
    prefix = "".join(f"{key}." for key in above)
    below = [key.removeprefix(prefix).partition(".")[0] for key in settable if key.startswith(prefix)]
    known = list(dict.fromkeys([*below, *([] if above else _FREE)]))
    elsewhere = [key for key in settable if key.rpartition(".")[2] == leaf]
    if not elsewhere:
        return unknown(what, name, known)
    return f"unknown {what} {name!r} (did you mean {' or '.join(map(repr, elsewhere))}?); known: {', '.join(known)}"


def leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Dotted names of all settings in a configuration's tree, such as ``"map.grid"``."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"
