"""``slam settings``: every setting with its default, unit and meaning."""

from __future__ import annotations

import json
from collections.abc import Iterator
from shutil import get_terminal_size
from textwrap import wrap
from typing import Any

from slam import registry
from slam.config import SystemConfig
from slam.errors import UnknownNameError
from slam.naming import unknown
from slam.run.settings_reference import Setting, documented, options_of, settings

_WIDEST = 100  # columns


def print_settings(wanted: str | None) -> None:
    """Print all settings, or those of a section, of a front end or back end, or one.

    Raises:
        UnknownNameError: there is no such section or setting.
    """
    print("\n".join(listing(wanted, min(get_terminal_size().columns, _WIDEST))))


def listing(wanted: str | None, width: int) -> Iterator[str]:
    """The lines of `print_settings`, of at most `width` characters."""
    if wanted is not None and ":" in wanted:  # a class of one's own
        part = registry.resolve("backends", wanted)
        every = list(options_of("frontend" if hasattr(part, "extract") else "backend", wanted))
        if not every:
            raise UnknownNameError(
                f"{wanted} names no options: neither its constructor has any, nor a dataclass in its `config`"
            )
    else:
        every = list(settings())
    chosen = [s for s in every if wanted is None or wanted in (s.key, s.owner) or s.key.startswith(f"{wanted}.")]
    if not chosen:
        names = dict.fromkeys(name for s in every for name in (s.key.partition(".")[0], s.owner) if name)
        same = dict.fromkeys(s.key for s in every if s.key.rpartition(".")[2] == wanted)
        line = unknown("section or setting", wanted or "", names)
        raise UnknownNameError(f"{line}; there is {', '.join(same)}" if same else line)
    titles = [_title(setting) for setting in chosen]
    for setting, title, before in zip(chosen, titles, [None, *titles]):
        if title != before:
            yield from ([] if before is None else [""])
            yield from wrap(title, width)
        (_, first), *others = setting.defaults.items()
        line = f"  {setting.key} = {_typed(first)}{setting.unit and f' {setting.unit}'}"
        yield line + "".join(f"; {kind}: {_typed(value)}" for kind, value in others if value != first)
        yield from wrap(setting.text, width, initial_indent="      ", subsequent_indent="      ")
    yield from ("", "Change one with --set KEY=VALUE.")


def _title(setting: Setting) -> str:
    """What a section is for; of a front end's or back end's, whose it is."""
    section = setting.key.partition(".")[0]
    return f"{section}: {f'options of {setting.owner}' if setting.owner else documented(SystemConfig)[section][1]}"


def _typed(value: Any) -> str:
    """A value as it can be typed."""
    return (value or '""') if isinstance(value, str) else json.dumps(value)
