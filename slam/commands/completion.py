"""What the shell offers when a word of the command line is completed."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def sequences(incomplete: str) -> list[str]:
    """A camera, built-in worlds, and folders."""
    from slam import worlds

    names = ["camera:0", *(f"synthetic:{name}" for name in worlds.names())]
    return [*_starting(names, incomplete), *_folders(incomplete)]


def backends(incomplete: str) -> list[str]:
    """Back ends; after a comma the next one."""
    return _names("backends", incomplete)


def frontends(incomplete: str) -> list[str]:
    """Front ends; after a comma the next one."""
    return _names("frontends", incomplete)


def formats(incomplete: str) -> list[str]:
    """Formats of sequences."""
    from slam.sequences import formats as known

    return _starting(known(), incomplete)


def kinds(incomplete: str) -> list[str]:
    """Kinds of motion."""
    from slam.models import KINDS

    return _starting(KINDS, incomplete)


def settings(incomplete: str) -> list[str]:
    """Settings that all runs have, up to the equals sign."""
    from slam.config import SystemConfig
    from slam.settings import leaves

    return _starting([f"{key}=" for key in leaves(SystemConfig().to_json())], incomplete)


def figures(incomplete: str) -> list[str]:
    """Figures of `slam plot`."""
    from slam.run.plots import KINDS

    return _starting(KINDS, incomplete)


def _names(role: str, incomplete: str) -> list[str]:
    from slam import registry

    before, comma, last = incomplete.rpartition(",")
    return [before + comma + name for name in _starting(registry.names(role), last)]


def _folders(incomplete: str) -> list[str]:
    """Folders whose path begins so."""
    parent, _, last = incomplete.rpartition("/")
    try:
        below = sorted(path.name for path in Path(f"{parent}/" if parent or incomplete[:1] == "/" else ".").iterdir()
                       if path.is_dir())  # fmt: skip
    except OSError:
        return []
    return [f"{incomplete[: len(incomplete) - len(last)]}{name}" for name in _starting(below, last)]


def _starting(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
