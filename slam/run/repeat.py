"""What it takes to repeat a run: written into its ``config.json``, and read from it by ``slam run --config``."""

from __future__ import annotations

import hashlib
import math
import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from slam.config import SystemConfig
from slam.errors import SlamError
from slam.files import read_object
from slam.run.options import RunOptions

CONFIG = "config.json"
_NO_FILES = ("synthetic:", "camera:")
_PACKAGES = ("surf-stereo-slam", "numpy", "scipy", "numba", "gtsam", "opencv-contrib-python-headless")


def origin(options: RunOptions) -> dict[str, Any]:
    """What ``config.json`` says besides names and settings: the command, and files by absolute and by relative path."""
    if not options.source:  # of a recording, or a sequence made in Python
        return {"command": options.command}
    no_file = options.format in ("synthetic", "camera")
    files = {"prior_map": options.prior_map, "calibration": options.calibration}
    return {
        "command": options.command,
        "source": {"format": options.format, **_places(options.source, options.out, no_file)},
        "kind": options.kind,
        "mono": options.mono,
        **{key: file and _places(str(file), options.out) for key, file in files.items()},
    }


def load(
    path: Path, source: str | None = None, prior_map: Path | None = None, calibration: Path | None = None
) -> tuple[RunOptions, dict[str, str]]:
    """Read the ``config.json`` of a run: its options, and the versions that it was made with.

    `path` is the file, or the run's folder; the others are taken in place of the run's own. The sequence is where it
    is found now; empty where it is not known.

    Raises:
        SlamError: it cannot be read, is none of a run of a sequence, or a file of its is not found any more.
        ConfigurationError: its settings are not those of this version.
    """
    file = path / CONFIG if os.path.isdir(path) else path  # noqa: PTH112 unlike Path's, without errors
    try:
        tree = _restored(read_object(file))
        if str(tree.get("command", "")).startswith("slam replay"):
            raise SlamError(f"{file}: that of a replay; repeat it with: {tree['command']}")
        before, (start, stop) = tree.get("source") or {}, tree["frames"]

        def own(key: str) -> Path | None:
            return Path(_found(tree[key], file)) if tree.get(key) else None

        options = RunOptions(
            str(tree["backend"]), str(tree["frontend"]), SystemConfig.from_json(tree["settings"]), Path(), int(start),
            None if stop is None else int(stop), mono=bool(tree.get("mono", False)), format=before.get("format"),
            source=source or (_found(before, file) if before else ""), kind=str(tree.get("kind", "handheld")),
            prior_map=prior_map or own("prior_map"), calibration=calibration or own("calibration"),
        )  # fmt: skip
        return options, dict(tree.get("versions", {}))
    except (OSError, ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise SlamError(f"{file}: not the config.json of a run: {error!r}") from error


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that shape a result."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


@cache
def running_code() -> dict[str, str]:
    """`versions`, and twelve hex digits for the sources of this distribution as ``code``; looked up once."""
    digest = hashlib.sha256()
    for name in ("slam", "frontends", "backends"):
        spec = find_spec(name)
        for root in () if spec is None else map(Path, spec.submodule_search_locations or ()):
            for path in sorted(root.rglob("*.py")):
                place = f"{root.name}/{path.relative_to(root).as_posix()}"
                digest.update(f"{place}\0".encode() + path.read_bytes() + b"\0")
    return {**versions(), "code": digest.hexdigest()[:12]}


def changed_versions(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What differs between two sets of versions, in words."""
    return [f"{name} {old}, now {now.get(name)}" for name, old in then.items() if now.get(name) != old]


def portable(tree: Any) -> Any:
    """The tree with infinite numbers, which JSON does not have, as ``"Infinity"`` and ``"-Infinity"``."""
    if isinstance(tree, Mapping):
        return {key: portable(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [portable(value) for value in tree]
    if isinstance(tree, float) and math.isinf(tree):
        return "Infinity" if tree > 0 else "-Infinity"
    return tree


def _restored(tree: Any) -> Any:
    """The inverse of `portable`."""
    if isinstance(tree, dict):
        return {key: _restored(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_restored(value) for value in tree]
    return float(tree) if tree in ("Infinity", "-Infinity") else tree


def _places(text: str, folder: Path, no_file: bool = False) -> dict[str, str]:
    """Where a file is, options behind it included: as it was given, absolute, and as seen from `folder`."""
    if no_file or text.startswith(_NO_FILES):
        return {"given": text}
    name, mark, query = text.rpartition("?")
    if not mark or Path(text).expanduser().exists():
        name, mark, query = text, "", ""
    absolute = Path(os.path.abspath(Path(name).expanduser()))  # noqa: PTH100 without following links
    found = {"given": text, "absolute": f"{absolute}{mark}{query}"}
    try:
        relative = os.path.relpath(absolute, os.path.abspath(folder))  # noqa: PTH100
    except ValueError:  # another drive
        return found
    return {**found, "relative": f"{Path(relative).as_posix()}{mark}{query}"}


def _found(places: Mapping[str, str], file: Path) -> str:
    """The first place of a file that exists: the absolute one, then the one relative to ``config.json``.

    Raises:
        SlamError: it is at neither.
    """
    if "absolute" not in places:
        return str(places["given"])
    candidates = [places["absolute"]]
    if "relative" in places:
        candidates.append(os.path.normpath(file.parent.absolute() / places["relative"]))
    for text in candidates:
        if Path(text).exists() or ("?" in text and Path(text.rpartition("?")[0]).exists()):
            return text
    where = " nor ".join(dict.fromkeys(candidates))
    raise SlamError(f"{file}: {places['given']} is no longer at {where}: give its new place beside --config")
