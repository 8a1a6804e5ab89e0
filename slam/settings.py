"""``section.key=value`` settings from a command line, applied to the configuration tree and checked by pydantic."""

from __future__ import annotations

import json
from typing import Any

from pydantic import TypeAdapter, ValidationError

from slam.config import SystemConfig
from slam.errors import ConfigurationError

_FREE = ("frontend", "backend")  # their options are checked by the front end or back end itself


def apply_settings(config: SystemConfig, settings: list[str]) -> SystemConfig:
    """A copy of `config` with settings applied; see `SystemConfig.with_settings`."""
    tree = config.to_json()
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"setting {setting!r} is not of the form section.key=value")
        _set(tree, path.strip().split("."), _value(text.strip()), setting)
    return from_json(tree)


def from_json(tree: dict[str, Any]) -> SystemConfig:
    """The configuration of a tree of plain types, as `SystemConfig.to_json` writes it.

    Raises:
        ConfigurationError: a key is unknown or a value of the wrong type or out of range.
    """
    try:
        return TypeAdapter(SystemConfig).validate_python(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigurationError(f"setting {where}: {first['msg']}") from None


def _value(text: str) -> Any:
    """JSON where it is JSON, else the text itself."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _set(tree: dict[str, Any], path: list[str], value: Any, setting: str) -> None:
    """Set one leaf of the tree; every key on the way must exist, but for options of front end and back end."""
    node = tree
    for key in path[:-1]:
        if not isinstance(node.get(key), dict):
            raise ConfigurationError(f"setting {setting!r}: unknown section {key!r}; known: {', '.join(node)}")
        node = node[key]
    leaf = path[-1]
    if isinstance(node.get(leaf), dict):
        raise ConfigurationError(f"setting {setting!r}: {leaf!r} is a section; set {'.'.join(path)}.KEY=VALUE")
    if len(path) < 2 or (path[0] not in _FREE and leaf not in node):
        raise ConfigurationError(f"setting {setting!r}: unknown key {leaf!r}; known: {', '.join(node)}")
    node[leaf] = value
