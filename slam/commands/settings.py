"""``slam settings``: every setting with its default, unit and meaning."""

from __future__ import annotations

import json
from collections.abc import Iterator
from shutil import get_terminal_size
from textwrap import wrap
from typing import Any

from slam.config import SystemConfig
from slam.errors import UnknownNameError
from slam.naming import unknown
from slam.run.settings_reference import Setting, documented, settings

_WIDEST = 100  # columns


def print_settings(wanted: str | None) -> None:
    """Print all settings, or those of a section, of a front end or back end, or one.

    Raises:
        UnknownNameError: there is no such section or setting.
    """
    print(listing(wanted, min(get_terminal_size().columns, _WIDEST)))


def listing(wanted: str | None, width: int) -> str:
    """The text of `print_settings` in lines of at most `width` characters."""
    every = list(settings())
    chosen = [s for s in every if wanted is None or wanted in (s.key, s.owner) or s.key.startswith(f"{wanted}.")]
    if not chosen:
        names = dict.fromkeys(name for s in every for name in (s.key.partition(".")[0], s.owner) if name)
        keys = {s.key for s in every} | {s.key.rpartition(".")[2] for s in every}
        line = unknown("section or setting", wanted or "", names)
        same = [s.key for s in every if wanted in keys and s.key.rpartition(".")[2] == wanted]
        raise UnknownNameError(f"{line}; there is {', '.join(dict.fromkeys(same))}" if same else line)
    lines: list[str] = []
    title = ""
    for setting in chosen:
        if _title(setting) != title:
            title = _title(setting)
            lines += ["", *wrap(title, width)]
        lines += [*_entry(setting, width)]
    note = "Change one with --set KEY=VALUE."
    return "\n".join([*lines[1:], "", *wrap(note, width)])


def _title(setting: Setting) -> str:
    """What a section is for; of a front end's or back end's, whose it is."""
    section = setting.key.partition(".")[0]
    if setting.owner:
        return f"{section}: options of {setting.owner}"
    return f"{section}: {documented(SystemConfig)[section][1]}"


def _entry(setting: Setting, width: int) -> Iterator[str]:
    """The lines of one setting."""
    unit = f" {setting.unit}" if setting.unit else ""
    first, *others = setting.defaults.items()
    line = f"  {setting.key} = {_typed(first[1])}{unit}"
    line += "".join(f"; {kind}: {_typed(value)}" for kind, value in others if value != first[1])
    yield line
    yield from wrap(setting.text, width, initial_indent="      ", subsequent_indent="      ")


def _typed(value: Any) -> str:
    """A value as it can be typed."""
    return (value or '""') if isinstance(value, str) else json.dumps(value)
