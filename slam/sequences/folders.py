"""Two folders of images or two videos, or one with both images in it, with a calibration file of any form."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError
from slam.files import expanded, require_content
from slam.geometry.se3 import Array
from slam.sequences.base import Decoder, FaultLog, Images, RecordedSequence
from slam.sequences.images import (
    IMAGE_SUFFIXES,
    MOST_PIXELS,
    Size,
    both,
    grabbed_image,
    quiet_libraries,
    require_same_size,
)
from slam.sequences.names import SIDES, natural, of_sides
from slam.sequences.options import FASTEST, SLOWEST, Options
from slam.sequences.pairs import image_names, listed, open_images, told_times
from slam.sequences.rigs import calibration_files, read_rig

#: Endings of video files, in lower case.
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg"})

_MOST_FRAMES = 10_000_000  # of a video, four days of it: what a header says may be anything

Side = tuple[Path, list[str] | None]  # of a camera: a folder and the images in it, or a video


def matches_folder(folder: Path) -> bool:
    """Whether a folder holds two cameras by one of the usual names, as folders, videos or images; or one of them."""
    return folder.is_dir() and (_two_cameras(folder) is not None or any(_called(folder, side) for side in (0, 1)))


def open_folder(folder: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open two folders or two videos, or one of either that holds both cameras."""
    home = folder.parent if folder.is_file() else folder
    sides = _sides(folder, options)
    paths, names = [path for path, _ in sides], [own for _, own in sides]
    if len(sides) == 2 and names[0] == names[1] and paths[0].samefile(paths[1]):
        raise SequenceError(f"{paths[0]} and {paths[1]} are the same: the left and the right camera's are needed")
    if len({own is None for own in names}) > 1:
        raise SequenceError(f"{paths[0]} and {paths[1]}: one is a video and the other is not")
    if names[0] is None:
        stamps, decode, size = _open_videos(paths, options.get("fps"), faults)
    else:
        times = told_times(home, options, faults, home / "times.txt", home / "timestamps.txt")
        pairs, decode, size = open_images(listed(paths, [own or [] for own in names], faults), options, faults, times)
        stamps = pairs.stamps
    files = calibration_files(home, options)
    if files[0].suffix == ".txt" and "calibration" not in options:  # KITTI's, of four cameras
        faults.report("calibration", f"{files[0]}: the images are taken as its cameras' 0 and 1 (see calibration=…)")
    rig = read_rig(files, size, options)
    return RecordedSequence(folder.stem, "folders", options.get("kind", "handheld"), rig, stamps, decode)


def _sides(folder: Path, options: Options) -> list[Side]:
    """Both cameras, or the one place where both are side by side."""
    if options.get("layout") is None:
        if not options.keys() & {"left", "right"} and (two := _two_cameras(folder)):
            return two
        sides = []
        for at, name in enumerate(("left", "right")):
            path = folder / expanded(options[name]) if name in options else _called(folder, at)
            if path is None:
                raise SequenceError(f"{folder}: two cameras are needed, but there is no {name} one: add {name}=…")
            sides.append(_found(path))
        return sides
    if folder.is_file():
        return [(folder, None)]
    if "left" in options:
        return [_found(folder / expanded(options["left"]))]
    if any(path.suffix.lower() in IMAGE_SUFFIXES for path in _inside(folder)):
        return [_found(folder)]
    places = [path for path in _inside(folder) if _is_place(path)]
    if len(places) != 1:
        raise SequenceError(f"{folder}: {len(places)} folders and videos, where layout=sbs needs one: add left=…")
    return [_found(places[0])]


def _found(path: Path) -> Side:
    """What a path stands for: a folder, a video, or a pattern with ``*``."""
    if "*" in path.name:
        names = [name for name in image_names(path.parent) if Path(name).match(path.name)]
        if not names:
            raise SequenceError(f"{path}: no images have such a name")
        return path.parent, names
    if not path.exists():
        raise SequenceError(f"{path}: there is no such folder or video")
    return path, None if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES else image_names(path)


def _two_cameras(folder: Path) -> list[Side] | None:
    """Two folders or videos, or the images of one folder, by words such as left and right in their names."""
    inside = _inside(folder)
    places = [path.name for path in inside if _is_place(path)]
    for words in SIDES:  # these alone, before names that hold them
        exact = [[name for name in places if _word(name) == word] for word in words]
        if all(exact):
            return [_found(folder / min(names)) for names in exact]
    found = of_sides(places)
    if found and len(found[0]) == len(found[1]) == 1:
        return [_found(folder / name) for (name,) in found]
    names = [path.name for path in inside if path.suffix.lower() in IMAGE_SUFFIXES]
    images = of_sides(names)
    few = images is not None and 2 * sum(map(len, images)) < len(names)  # cam0.png and cam1.png of cam0.png … cam99.png
    return None if images is None or few else [(folder, sorted(names, key=natural)) for names in images]


def _called(folder: Path, side: int) -> Path | None:
    """What is called as the cameras of one side usually are, though the other side is missing."""
    names = {words[side] for words in SIDES} - {words[1 - side] for words in SIDES}
    return next((path for path in sorted(_inside(folder)) if _word(path.name) in names and _is_place(path)), None)


def _word(name: str) -> str:
    """A name without its ending as `SIDES` has it: ``Camera_0`` is ``camera0``."""
    return name.lower().partition(".")[0].replace("_", "").replace("-", "").replace(" ", "")


def _is_place(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def _inside(folder: Path) -> list[Path]:
    """What is in a folder, without hidden files; nothing where it may not be looked into."""
    try:
        return [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError:
        return []


def _open_videos(paths: list[Path], rate: float | None, faults: FaultLog) -> tuple[Array, Decoder, Size]:
    """Times of the frames of two videos, or of one side by side, what decodes them, and an image's size."""
    counts, images, rates = zip(*(_beginning(path) for path in paths))
    size = require_same_size(*both(images, paths[0]), *paths)
    if rate is None and abs(rates[0] - rates[-1]) * min(counts) > 0.5 * rates[0]:  # more than half a frame in the end
        said = f"{paths[0]} has {rates[0]:.6g} frames per second, {paths[1]} has {rates[1]:.6g}"
        raise SequenceError(f"{said}: frames of one number are not of one moment; where they are, add fps=…")
    if counts[0] != counts[-1]:
        line = f"{paths[0]} has {counts[0]} frames, {paths[1]} has {counts[1]}: the surplus is left out"
        faults.report("videos", line)
    rate = rate or rates[0]
    if not SLOWEST <= rate <= FASTEST:
        raise SequenceError(f"{paths[0]}: the frame rate is not known, add fps=…")
    return np.arange(min(counts)) / rate, partial(_decode_videos, paths, min(counts)), size


def _decode_videos(paths: list[Path], count: int, start: int, stop: int, faults: FaultLog) -> Images:
    """The frames of videos, which cannot be entered in the middle; one that ends too early ends the sequence."""
    with ExitStack() as stack:
        videos = [stack.enter_context(_open_video(path)) for path in paths]
        with quiet_libraries():
            for _ in range(start):
                for video in videos:
                    video.grab()
        for index in range(start, stop):
            images = [grabbed_image(video) if video.grab() else None for video in videos]
            for path, image in zip(paths, images):
                if image is None:
                    faults.report("videos", f"{path}: ends or is damaged at frame {index} of {count}")
            if any(image is None for image in images):
                return
            yield tuple(images)


def _beginning(path: Path) -> tuple[int, np.ndarray, float]:
    """A video's number of frames, its first image, and its frame rate [1/s]."""
    import cv2

    with _open_video(path) as video, quiet_libraries():
        claimed, rate = video.get(cv2.CAP_PROP_FRAME_COUNT), float(video.get(cv2.CAP_PROP_FPS))
        first = grabbed_image(video) if video.grab() else None
        if first is None:
            raise SequenceError(f"{path}: no frame of the video can be decoded")
        count = int(min(claimed, _MOST_FRAMES)) if claimed > 0 else 1
        while claimed <= 0 and count < _MOST_FRAMES and video.grab():  # it does not say
            count += 1
        return count, first, rate


@contextmanager
def _open_video(path: Path) -> Iterator[Any]:
    """A ``cv2.VideoCapture``, released in the end; SequenceError where the file is no readable video."""
    import cv2

    require_content(path)  # a pipe would be waited for
    with quiet_libraries():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)  # others take a name for a pattern
    try:
        if not capture.isOpened():
            raise SequenceError(f"{path}: not a readable video")
        if capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT) > MOST_PIXELS:
            raise SequenceError(f"{path}: frames of more than {MOST_PIXELS} pixels are not read")
        yield capture
    finally:
        with quiet_libraries():
            capture.release()
