"""What may be meant where a path is no sequence: ends of error messages, empty where nothing helps."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path

from slam.naming import nearest
from slam.sequences.captures import VIDEO_SUFFIXES
from slam.sequences.images import IMAGE_SUFFIXES

_LOOKED_AT = 1000  # files and folders below one that is no sequence
_LEVELS_ABOVE = 3  # folders above one that is no sequence: mav0/cam0/data


def of_video(file: Path) -> str:
    """How to run a video."""
    if file.suffix.lower() not in VIDEO_SUFFIXES:
        return ""
    return f"; a video with both images side by side is {file}?layout=sbs, two videos are {file.parent}?left=…&right=…"


def near_name(folder: Path, text: str) -> str:
    """A world or a folder with a similar name, or the part of the path that is missing first; `text` was asked for."""
    from slam import worlds

    name, mark, query = text.partition("?")
    near = None if Path(name).name != name else nearest(name, worlds.names())
    if near:
        return f" (did you mean 'synthetic:{near}{mark}{query}'?)"
    there = next((parent for parent in folder.parents if parent.is_dir()), None)
    if there is None:
        return ""
    missing = folder.relative_to(there).parts[0]
    with suppress(OSError):
        near = nearest(missing, (path.name for path in islice(there.iterdir(), _LOOKED_AT)))
        if near is not None:
            return f" (did you mean '{there / near}'?)"
    return "" if there == folder.parent else f": {there} has no {missing!r}"


def of_sequences_near(folder: Path, format_of: Callable[[Path], str | None]) -> str:
    """Which of the folders in a folder may be the cameras, and which sequences lie below it, or it is a part of."""
    below: list[str] = []
    with suppress(OSError):
        for path in islice(chain(folder.glob("*"), folder.glob("*/*")), _LOOKED_AT):
            with suppress(OSError):
                if format_of(path):
                    below.append(str(path.relative_to(folder)))
    cameras = _two_cameras(folder)
    if below:
        return f"{cameras}; below it are {', '.join(sorted(below)[:3])}" + (", …" if len(below) > 3 else "")
    for parent in () if cameras else islice(folder.parents, _LEVELS_ABOVE):
        with suppress(OSError):
            if (name := format_of(parent)) is not None:
                return f"; it is a part of one: give {parent} (format {name})"
    return cameras


def _two_cameras(folder: Path) -> str:
    """How to name the cameras where the folder has two folders of images, or two videos, by other names."""
    names: list[str] = []
    with suppress(OSError):
        for path in sorted(islice(folder.iterdir(), _LOOKED_AT)):
            inside = islice(path.iterdir(), _LOOKED_AT) if path.is_dir() else ()
            images = sum(p.suffix.lower() in IMAGE_SUFFIXES for p in inside)
            if path.suffix.lower() in VIDEO_SUFFIXES or images > 1:
                names.append(path.name)
    two = names if len(names) == 2 else [name for name in names if not Path(name).suffix]
    return f"; say which is which: '{folder.name}?left={two[0]}&right={two[1]}'" if len(two) == 2 else ""
