"""Two folders of images or two videos, or one with both images in it, with a calibration file of any form."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from slam.errors import SequenceError
from slam.files import expanded
from slam.sequences.base import FrameSource, RecordedSequence
from slam.sequences.captures import VIDEO_SUFFIXES, open_videos
from slam.sequences.faults import FaultLog
from slam.sequences.images import IMAGE_SUFFIXES, Size
from slam.sequences.names import SIDES, natural, of_sides
from slam.sequences.options import Options
from slam.sequences.pairs import image_names, image_pairs, listed, pair_up, told_times
from slam.sequences.rigs import calibration_files, read_rig


class Side(NamedTuple):
    """The images of a camera: a video, or a folder and the names in it."""

    path: Path
    names: list[str] | None = None


def matches_folder(folder: Path) -> bool:
    """Whether a folder holds two cameras by one of the usual names, as folders, videos or images; or one of them."""
    return folder.is_dir() and (_two_cameras(folder) is not None or any(_called(folder, side) for side in (0, 1)))


def open_folder(folder: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open two folders or two videos, or one of either that holds both cameras."""
    home = folder.parent if folder.is_file() else folder
    source, size = _source(_sides(folder, options), home, options, faults)
    files = calibration_files(home, options)
    if files[0].suffix == ".txt" and "calibration" not in options:  # KITTI's, of four cameras
        faults.report("calibration", f"{files[0]}: the images are taken as its cameras' 0 and 1 (see calibration=…)")
    rig = read_rig(files, size, options)
    return RecordedSequence(folder.stem, "folders", options.get("kind", "handheld"), rig, source)


def _source(sides: list[Side], home: Path, options: Options, faults: FaultLog) -> tuple[FrameSource, Size]:
    """Where the images come from, and their size; `home` has the file of times."""
    paths, names = [side.path for side in sides], [side.names for side in sides]
    if len(sides) == 2 and names[0] == names[1] and paths[0].samefile(paths[1]):
        raise SequenceError(f"{paths[0]} and {paths[1]} are the same: the left and the right camera's are needed")
    if len({own is None for own in names}) > 1:
        raise SequenceError(f"{paths[0]} and {paths[1]}: one is a video and the other is not")
    if names[0] is None:
        return open_videos(paths, options.get("fps"), faults)
    left, *right = listed(paths, [own or [] for own in names], faults)
    times = told_times(home, options, faults, home / "times.txt", home / "timestamps.txt")
    pairs = pair_up(left, right[0] if right else None, options, faults, times)
    return image_pairs(pairs, left, right[0] if right else None)


def _sides(folder: Path, options: Options) -> list[Side]:
    """Both cameras, or the one place where both are side by side."""
    if options.get("layout") is None:
        if not options.keys() & {"left", "right"} and (both := _two_cameras(folder)):
            return [side if side.names else _found(side.path) for side in both]
        sides = []
        for at, name in enumerate(("left", "right")):
            path = folder / expanded(options[name]) if name in options else _called(folder, at)
            if path is None:
                raise SequenceError(f"{folder}: two cameras are needed, but there is no {name} one: add {name}=…")
            sides.append(_found(path))
        return sides
    if folder.is_file():
        return [Side(folder)]
    if "left" in options:
        return [_found(folder / expanded(options["left"]))]
    inside = _inside(folder)
    if any(path.suffix.lower() in IMAGE_SUFFIXES for path in inside):
        return [_found(folder)]
    places = [path for path in inside if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES]
    if len(places) != 1:
        raise SequenceError(f"{folder}: {len(places)} folders and videos, where layout=sbs needs one: add left=…")
    return [_found(places[0])]


def _found(path: Path) -> Side:
    """What a path stands for: a folder, a video, or a pattern with ``*``."""
    if "*" in path.name:
        names = [name for name in image_names(path.parent) if Path(name).match(path.name)]
        if not names:
            raise SequenceError(f"{path}: no images")
        return Side(path.parent, names)
    if not path.exists():
        raise SequenceError(f"{path}: there is no such folder or video")
    return Side(path) if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES else Side(path, image_names(path))


def _two_cameras(folder: Path) -> list[Side] | None:
    """Two folders or videos, or the images of one folder, by words such as left and right in their names."""
    inside = _inside(folder)
    places = [p.name for p in inside if p.is_dir() or p.suffix.lower() in VIDEO_SUFFIXES]
    for words in SIDES:  # these alone, before names that hold them
        exact = [[name for name in places if _word(name) == word] for word in words]
        if all(exact):
            return [Side(folder / min(names)) for names in exact]
    found = of_sides(places)
    if found and len(found[0]) == len(found[1]) == 1:
        return [Side(folder / names[0]) for names in found]
    names = [p.name for p in inside if p.suffix.lower() in IMAGE_SUFFIXES]
    images = of_sides(names)
    few = images is not None and 2 * sum(map(len, images)) < len(names)  # cam0.png and cam1.png of cam0.png … cam99.png
    return None if images is None or few else [Side(folder, sorted(names, key=natural)) for names in images]


def _word(name: str) -> str:
    """A name without its ending as `SIDES` has it: ``Camera_0`` is ``camera0``."""
    return name.lower().partition(".")[0].replace("_", "").replace("-", "").replace(" ", "")


def is_side(path: Path) -> bool:
    """Whether a folder is one of the two cameras of the folder that it is in."""
    both = _two_cameras(path.parent)
    return both is not None and path in [side.path for side in both]


def _called(folder: Path, side: int) -> Path | None:
    """What is called as the cameras of one side usually are, though the other side is missing."""
    names = {words[side] for words in SIDES} - {words[1 - side] for words in SIDES}
    usual = (path for path in sorted(_inside(folder)) if _word(path.name) in names)
    return next((path for path in usual if path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES), None)


def _inside(folder: Path) -> list[Path]:
    """What is in a folder, without hidden files; nothing where it may not be looked into."""
    try:
        return [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError:
        return []
