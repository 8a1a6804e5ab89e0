"""Which code made a result: a comparison can be continued with the same code alone."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from slam.run.repeat import versions

_PACKAGES = ("slam", "frontends", "backends")


def source_digest(folders: Iterable[Path] = ()) -> str:
    """Twelve hex digits for the Python sources of this distribution as they stand now.

    Args:
        folders: further ones, whose ``*.py`` count as well.
    """
    specs = [find_spec(name) for name in _PACKAGES]
    own = [Path(place) for spec in specs if spec is not None for place in spec.submodule_search_locations or ()]
    digest = hashlib.sha256()
    for root in [*own, *folders]:
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


@cache
def _running() -> dict[str, str]:
    return made_with()


def running_code() -> dict[str, str]:
    """`made_with`, looked up once: what a process runs does not change when its files do."""
    return dict(_running())


def made_with(folders: Iterable[Path] = ()) -> dict[str, str]:
    """Versions of the packages that matter, and the digest of the sources as ``code``."""
    return {**versions(), "code": source_digest(folders)}
