"""Two folders of images, or two videos, with an OpenCV or Kalibr calibration file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.se3 import Array
from slam.sequences import rigs
from slam.sequences.base import RecordedSequence
from slam.sequences.faults import FaultLog
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.source import (
    MOST_FRAMES,
    ImagePairs,
    Listing,
    hardware_tolerance,
    image_names,
    in_order,
    in_seconds,
    pair_listings,
    stamped,
)
from slam.sequences.tables import MOST_NANOSECONDS, read_rows, seconds
from slam.sequences.videos import FASTEST, SLOWEST, VIDEO_SUFFIXES, VideoPairs, open_videos

#: Options of this format besides ``kind``.
OPTIONS = frozenset({"left", "right", "times", "fps"}) | rigs.OPTIONS

#: Frames per second of image folders that say nothing of time.
RATE = 10.0

_SHORTEST = 10**6  # [ns] between frames: no camera is faster, and no count of frames has such steps

_NAMES = (("left", "right"), ("image_left", "image_right"), ("cam0", "cam1"))
_TIMES = ("times.txt", "timestamps.txt")


def matches(folder: Path) -> bool:
    """Whether a folder holds a left or a right camera by one of the usual names."""
    return any(_by_convention(folder, side) is not None for side in (0, 1))


def open_folder(folder: Path, options: dict[str, str]) -> RecordedSequence:
    """Open two folders or two videos.

    Raises:
        SequenceError: a side is missing, empty or unreadable, or the two cannot be paired.
        CalibrationError: the calibration is missing, unreadable or impossible.
        ConfigurationError: an option has an impossible value.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        left, right = (_side(folder, side, options) for side in (0, 1))
        rate = _rate(options)
        source: ImagePairs | VideoPairs
        if _is_video(left) != _is_video(right):
            raise SequenceError(f"{left} and {right}: one is a video and the other is not")
        if _is_video(left):
            if "times" in options:
                raise ConfigurationError("option 'times' goes with folders of images: a video has fps=…")
            source = open_videos(left, right, rate, faults)
            size = source.size
        else:
            source = _image_pairs(folder, left, right, options, rate, faults)
            size = source.first_size()
            source = replace(source, size=size)
        paths = calibration_files(folder, options)
        rig = read_rig(paths, size, options)
    return RecordedSequence(folder.name, "folders", options.get("kind", "handheld"), rig, source, warnings=warnings)


# ------------------------------------------------------------------------------------------------ which files


def _side(folder: Path, side: int, options: dict[str, str]) -> Path:
    """Folder, video or pattern of files of one side (0 left, 1 right), by option or by convention."""
    name = ("left", "right")[side]
    if name in options:
        path = folder / expanded(options[name])
        if "*" not in path.name and not path.exists():
            raise SequenceError(f"{path}: there is no such folder or video")
        return path
    found = _by_convention(folder, side)
    if found is None:
        raise SequenceError(f"{folder}: two cameras are needed, but there is no {name} one: add {name}=…")
    return found


def _by_convention(folder: Path, side: int) -> Path | None:
    """A folder or a video by one of the usual names."""
    for names in _NAMES:
        if (folder / names[side]).is_dir():
            return folder / names[side]
    for names in _NAMES:
        for suffix in sorted(VIDEO_SUFFIXES):
            if (folder / f"{names[side]}{suffix}").is_file():
                return folder / f"{names[side]}{suffix}"
    return None


def _is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def _names(path: Path) -> tuple[Path, list[str]]:
    """The folder and the names of the images that a path (a folder, or a pattern with ``*``) stands for."""
    if "*" in path.name:
        folder, names = path.parent, [n for n in image_names(path.parent) if Path(n).match(path.name)]
    else:
        folder, names = path, image_names(path)
    if not names:
        raise SequenceError(f"{path}: no images")
    return folder, names


# ------------------------------------------------------------------------------------------------ images


def _image_pairs(
    folder: Path, left: Path, right: Path, options: dict[str, str], rate: float | None, faults: FaultLog
) -> ImagePairs:
    """Pair by stamps in the names, else by numbers in them, else by order."""
    (left_folder, left_names), (right_folder, right_names) = _names(left), _names(right)
    times = _times_file(folder, options)
    stamps = None if times or rate else _stamps_in(left_names, right_names)
    if stamps is not None:
        keys, unit, by_stamp = stamps, "ns", True
    else:
        keys, unit, by_stamp = _numbers_in(left_names, right_names, left_folder, right_folder), "frames", False
    listings = []
    for where, names, own in ((left_folder, left_names, keys[0]), (right_folder, right_names, keys[1])):
        order = np.argsort(own, kind="stable")
        listing = Listing(where, own[order], [names[i] for i in order])
        listings.append(in_order(listing, str(where), faults))
    tolerance = hardware_tolerance(listings[0]) if by_stamp else 0
    paired, partners = pair_listings(listings[0], listings[1], tolerance, unit, faults)
    if by_stamp:
        paired, partners, stamps_ = in_seconds(paired, partners, faults)
        return ImagePairs(stamps_, left_folder, paired.names, right_folder, partners)
    keep, seconds_ = _times(times, paired, listings[0], rate, faults)
    paired, partners = paired.select(keep), [partners[i] for i in keep]
    return ImagePairs(seconds_, left_folder, paired.names, right_folder, partners)


def _stamps_in(left: list[str], right: list[str]) -> tuple[np.ndarray, np.ndarray] | None:
    """Stamps [ns] where every name is one.

    19 digits are nanoseconds, 16 microseconds, 13 milliseconds, 10 and a fraction seconds. Other numbers are
    nanoseconds where they are so far apart that they cannot count frames.
    """
    stamps = [[_stamp(name.rpartition(".")[0]) for name in names] for names in (left, right)]
    if all(stamp is not None for own in stamps for stamp in own):
        return np.array(stamps[0], np.int64), np.array(stamps[1], np.int64)
    a, b = (_whole_numbers(names) for names in (left, right))
    if a is None or b is None:
        return None
    if min(_median_step(a), _median_step(b)) >= _SHORTEST:
        return a, b
    milliseconds = all(10**12 <= number < 10**13 for number in (*a, *b))
    return (a * 10**6, b * 10**6) if milliseconds else None


def _whole_numbers(names: list[str]) -> np.ndarray | None:
    """The names as numbers; None where one is something else."""
    stems = [name.rpartition(".")[0] for name in names]
    if not all(re.fullmatch(r"\d{1,19}", stem, re.ASCII) and int(stem) <= MOST_NANOSECONDS for stem in stems):
        return None
    return np.array(stems, np.int64)


def _median_step(numbers: np.ndarray) -> float:
    """How far numbers are apart; zero for a single one."""
    return float(np.median(np.diff(np.sort(numbers)))) if len(numbers) > 1 else 0.0


def _stamp(stem: str) -> int | None:
    """Nanoseconds of a name that is a stamp; None where it is none."""
    stamp = None
    if re.fullmatch(r"\d{18,19}", stem, re.ASCII):
        stamp = int(stem)
    elif re.fullmatch(r"\d{16}", stem, re.ASCII):
        stamp = int(stem) * 1000
    elif match := re.fullmatch(r"(\d{9,10})\.(\d{1,9})", stem, re.ASCII):
        stamp = int(match[1]) * 10**9 + int(match[2].ljust(9, "0"))
    return stamp if stamp is not None and stamp <= MOST_NANOSECONDS else None


def _numbers_in(
    left: list[str], right: list[str], left_folder: Path, right_folder: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Frame numbers: the last number in each name where that tells the images apart, else their order."""
    keys = []
    for names in (left, right):
        found = [re.findall(r"\d+", name.rpartition(".")[0], re.ASCII) for name in names]
        numbers = [int(f[-1]) for f in found if f and int(f[-1]) <= MOST_FRAMES]
        if len(set(numbers)) != len(names):
            break
        keys.append(np.array(numbers, np.int64))
    if len(keys) == 2:
        return keys[0], keys[1]
    if len(left) != len(right):
        raise SequenceError(
            f"{left_folder} has {len(left)} images and {right_folder} has {len(right)}, and neither stamps nor "
            "numbers in their names say which go together"
        )
    return np.arange(len(left)), np.arange(len(right))


# ------------------------------------------------------------------------------------------------ time


def _times_file(folder: Path, options: dict[str, str]) -> Path | None:
    """The file of times, by option or by convention."""
    if "times" in options:
        return folder / expanded(options["times"])
    return next((folder / n for n in _TIMES if (folder / n).is_file()), None)


def _times(
    path: Path | None, paired: Listing, left: Listing, rate: float | None, faults: FaultLog
) -> tuple[np.ndarray, Array]:
    """Rows of the pairs that have a time, and the times [s].

    The rows of a file of times belong to the left images in order; without a file, time goes by frame numbers.
    """
    if path is None:
        if rate is None:
            faults.assume(f"{left.folder}: no times, {RATE:g} frames per second assumed (see fps=…)")
        return np.arange(len(paired)), (paired.keys - paired.keys[0]) / (rate or RATE)
    rows = read_rows(path, seconds, faults)
    if len(rows) != len(left):
        faults.report("stamps", f"{path} has {len(rows)} rows, {left.folder} has {len(left)} images")
    times = np.array([np.nan if row is None else row for row in rows])
    return stamped(np.searchsorted(left.keys, paired.keys), times, path, faults)


def _rate(options: dict[str, str]) -> float | None:
    """The option fps [1/s]."""
    if "fps" not in options:
        return None
    try:
        rate = float(options["fps"])
    except ValueError:
        rate = float("nan")
    if not SLOWEST <= rate <= FASTEST:
        raise ConfigurationError(f"fps must be a positive number ({SLOWEST:g} to {FASTEST:g}), got {options['fps']!r}")
    return rate
