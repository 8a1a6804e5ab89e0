"""``section.key=value`` settings, as a command line gives them, put into a tree of plain types."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from slam.errors import ConfigurationError
from slam.naming import unknown

_FREE = ("frontend", "backend")  # their options are checked by the front end or back end itself

_LONGEST = 10_000  # characters of a setting
_BRACKETS = 100  # in its value


def apply_settings(tree: dict[str, Any], settings: Sequence[str]) -> None:
    """Change leaves of a configuration's tree in place; types and ranges are checked when it is read back.

    Args:
        tree: as `slam.config.SystemConfig.to_json` writes it.
        settings: texts such as ``"map.max_landmarks=300"``; values are JSON or plain words.

    Raises:
        ConfigurationError: a text is not of that form, or its section or key is unknown.
    """
    if isinstance(settings, str) or not all(isinstance(setting, str) for setting in _listed(settings)):
        raise ConfigurationError("settings must be a list of texts section.key=value")
    for setting in settings:
        if len(setting) > _LONGEST:
            raise ConfigurationError(f"setting {setting!r} is longer than {_LONGEST} characters")
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"setting {setting!r} is not of the form section.key=value")
        _set(tree, path.strip().split("."), _value(text.strip()), setting)


def _listed(settings: Any) -> list[Any]:
    """An iterable as a list; for anything else, a list with an element that is no text."""
    return list(settings) if isinstance(settings, Iterable) else [None]


def _value(text: str) -> Any:
    """The parsed value if the text is JSON, else the text; too deep nesting or too many digits count as no JSON."""
    if text.count("[") + text.count("{") > _BRACKETS:
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _set(tree: dict[str, Any], path: list[str], value: Any, setting: str) -> None:
    """Set one leaf of the tree; every key on the way must exist, except options of front end and back end."""
    node = tree
    for key in path[:-1]:
        if not isinstance(node.get(key), dict):
            raise ConfigurationError(f"setting {setting!r}: {_unknown('section', key, node, tree, path)}")
        node = node[key]
    leaf = path[-1]
    if isinstance(node.get(leaf), dict):
        raise ConfigurationError(f"setting {setting!r}: {leaf!r} is a section; set {'.'.join(path)}.KEY=VALUE")
    if len(path) < 2 or (path[0] not in _FREE and leaf not in node):
        raise ConfigurationError(f"setting {setting!r}: {_unknown('key', leaf, node, tree, path)}")
    node[leaf] = value


def _unknown(what: str, name: str, known: dict[str, Any], tree: dict[str, Any], path: list[str]) -> str:
    """The line for an unknown name; a key that another section has is suggested with its section."""
    elsewhere = [dotted for dotted in leaves(tree) if dotted.rpartition(".")[2] == path[-1]]
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
