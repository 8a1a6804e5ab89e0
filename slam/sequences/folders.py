"""Two folders of images or two videos, or one with both images in it, with a calibration file of any form."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from slam.errors import SequenceError
from slam.files import expanded
from slam.sequences.base import FrameSource, RecordedSequence
from slam.sequences.captures import VIDEO_SUFFIXES, open_videos
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given, layout_of
from slam.sequences.images import IMAGE_SUFFIXES, Size
from slam.sequences.names import SIDES, of_sides
from slam.sequences.pairs import by_names, image_names, image_pairs, read_times, timed
from slam.sequences.rigs import calibration_files, read_rig

_NAMES = (*SIDES, ("image_left", "image_right"))
_TIMES = ("times.txt", "timestamps.txt")


class _Side(NamedTuple):
    """The images of a camera: a video, or a folder and the names in it."""

    path: Path
    names: list[str] | None = None


def matches_folder(folder: Path) -> bool:
    """Whether a folder holds a left or a right camera by one of the usual names, as folders, videos or images."""
    return any(_by_convention(folder, side) is not None for side in (0, 1))


def open_folder(folder: Path, options: Given, faults: FaultLog) -> RecordedSequence:
    """Open two folders or two videos, or one of either that holds both cameras."""
    home = folder.parent if folder.is_file() else folder
    source, size = _source(_sides(folder, options), home, options, faults)
    files = calibration_files(home, options)
    if files[0].suffix == ".txt" and "calibration" not in options:  # KITTI's, of four cameras
        faults.assume(f"{files[0]}: the images are taken as its cameras' 0 and 1 (see calibration=…)")
    rig = read_rig(files, size, options)
    return RecordedSequence(folder.stem, "folders", options.get("kind", "handheld"), rig, source)


def _source(sides: list[_Side], home: Path, options: Given, faults: FaultLog) -> tuple[FrameSource, Size]:
    """Where the images come from, and their size; `home` has the file of times."""
    paths, names = [side.path for side in sides], [side.names for side in sides]
    if len({own is None for own in names}) > 1:
        raise SequenceError(f"{paths[0]} and {paths[1]}: one is a video and the other is not")
    if names[0] is None:
        videos = open_videos(paths, options.rate(), faults)
        return videos, videos.size
    left, *right = by_names(paths, [own or [] for own in names], faults)
    times = read_times(home, options, faults, *(home / name for name in _TIMES))
    pairs = timed(left, right[0] if right else None, options, faults, times)
    images = image_pairs(pairs, right[0].folder if right else None)
    return images, images.size


def _sides(folder: Path, options: Given) -> list[_Side]:
    """Both cameras, or the one place where both are side by side."""
    if layout_of(options) is None:
        return [_side(folder, side, options) for side in (0, 1)]
    if folder.is_file():
        return [_Side(folder)]
    if "left" in options:
        return [_found(folder / expanded(options["left"]))]
    inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
    if any(path.suffix.lower() in IMAGE_SUFFIXES for path in inside):
        return [_found(folder)]
    places = [path for path in inside if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES]
    if len(places) != 1:
        raise SequenceError(f"{folder}: {len(places)} folders and videos, where layout=sbs needs one: add left=…")
    return [_found(places[0])]


def _side(folder: Path, side: int, options: Given) -> _Side:
    """Folder, video or pattern of files of one side (0 left, 1 right), by option or by convention."""
    name = ("left", "right")[side]
    if name in options:
        return _found(folder / expanded(options[name]))
    found = _by_convention(folder, side)
    if found is None:
        raise SequenceError(f"{folder}: two cameras are needed, but there is no {name} one: add {name}=…")
    return _with_images(found)


def _found(path: Path) -> _Side:
    """What a path stands for: a folder, a video, or a pattern with ``*``."""
    if "*" in path.name:
        return _with_images(_Side(path, [n for n in image_names(path.parent) if Path(n).match(path.name)]))
    if not path.exists():
        raise SequenceError(f"{path}: there is no such folder or video")
    is_video = path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
    return _Side(path) if is_video else _with_images(_Side(path, image_names(path)))


def _with_images(side: _Side) -> _Side:
    """A side, which must have images; a pattern's folder in the place of the pattern."""
    if side.names == []:
        raise SequenceError(f"{side.path}: no images")
    return side._replace(path=side.path.parent) if "*" in side.path.name else side


def _by_convention(folder: Path, side: int) -> _Side | None:
    """A folder, a video, or the images of a folder, by one of the usual names."""
    if not folder.is_dir():
        return None
    for names in _NAMES:
        if (folder / names[side]).is_dir():
            return _Side(folder / names[side], image_names(folder / names[side]))
    films = (folder / f"{names[side]}{suffix}" for names in _NAMES for suffix in sorted(VIDEO_SUFFIXES))
    film = next((path for path in films if path.is_file()), None)
    if film is not None:
        return _Side(film)
    with suppress(SequenceError):  # a folder that may not be looked into
        both = of_sides(image_names(folder))
        return None if both is None else _Side(folder, both[side])
    return None
