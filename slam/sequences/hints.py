"""What may be meant where a path is no sequence: ends of error messages, empty where nothing helps."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path

from slam.errors import SequenceError, SlamError
from slam.files import read_object
from slam.naming import nearest
from slam.sequences.images import IMAGE_SUFFIXES

_LOOKED_AT = 500  # entries of a folder, and folders below one that is no sequence
_LEVELS = 3  # folders above and below one that is no sequence: mav0/cam0/data, data_2d_raw/drive
_LISTED = 6  # sequences below a folder

Format = Callable[[Path], str | None]  # of a path


def near_name(folder: Path, text: str) -> str:
    """A world with a similar name, or the part of the path that is missing first; `text` was asked for."""
    from slam import worlds

    name, mark, query = text.partition("?")
    near = None if Path(name).name != name else nearest(name, worlds.names())
    if near:
        return f" (did you mean 'synthetic:{near}{mark}{query}'?)"
    there = next((parent for parent in folder.parents if parent.is_dir()), folder.parent)
    return "" if there == folder.parent else f": {there} has no {folder.relative_to(there).parts[0]!r}"


def of_run(folder: Path) -> str:
    """What a folder that a run left was a run of, and what shows it."""
    files = folder / "config.json", folder / "frames.csv"
    if not all(file.is_file() for file in files):
        return ""
    with suppress(SlamError):
        source = read_object(files[0]).get("source") or "something"
        return f"; it is what a run of {source} left: give that, or look at the run with `slam view {folder.name}`"
    return ""


def sequences_near(folder: Path, format_of: Format) -> str:
    """Which sequences lie below a folder, or it is a part of; else how to name the two cameras in it."""
    from slam.sequences.folders import is_side

    if run := of_run(folder):
        return run
    below = sorted(str(path.relative_to(folder)) for path in _below(folder, format_of))
    if below:
        more = f", … ({len(below)})" if len(below) > _LISTED else ""
        there = (
            f"are {', '.join(below[:_LISTED])}{more}: give one of them"
            if len(below) > 1
            else f"is {below[0]}: give that"
        )
        return f"; below it {there}"
    for part in islice((folder, *folder.parents), _LEVELS):
        parent, name = part.parent, _format(part.parent, format_of)
        if name is not None and (name != "folders" or is_side(part)):
            return f"; it is a part of one: give {parent} (format {name})"
    if any(path.suffix.lower() in IMAGE_SUFFIXES for path in _inside(folder)):
        return f"; where each image holds both cameras: '{folder.name}?layout=sbs'; else name both: ?left=…&right=…"
    return f"; where two cameras are in it by other names: '{folder.name}?left=…&right=…'"


def _below(folder: Path, format_of: Format) -> list[Path]:
    """Sequences below a folder, the nearest first; below a sequence none is looked for."""
    found: list[Path] = []
    level, looked_at = [folder], 0
    for _ in range(_LEVELS):
        inside = [path for parent in level for path in sorted(_inside(parent))][: _LOOKED_AT - looked_at]
        looked_at += len(inside)
        here = [path for path in inside if _format(path, format_of)]
        level = [path for path in inside if path not in here and path.is_dir()]
        found += here
    return found


def _format(path: Path, format_of: Format) -> str | None:
    with suppress(OSError, SequenceError):
        return format_of(path)
    return None


def _inside(folder: Path) -> list[Path]:
    """Some of what is in a folder; nothing where it may not be looked into."""
    with suppress(OSError):
        return list(islice(folder.iterdir(), _LOOKED_AT))
    return []
