"""Stereo sequences: EuRoC, KITTI, ROS recordings, two folders or videos, live cameras, and the synthetic worlds.

`open_sequence` finds the format out by itself. Layouts, options and faults are described in
``docs/sequences.md``. May import `slam.worlds`, `slam.geometry` and the data.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from urllib.parse import quote

from slam.errors import ConfigurationError, SequenceError, UnknownNameError
from slam.files import expanded, note_input, reason
from slam.naming import unknown
from slam.sequences import hints
from slam.sequences.base import RecordedSequence, Sequence, is_live, read_masks, turned
from slam.sequences.captures import VIDEO_SUFFIXES
from slam.sequences.faults import FaultLog
from slam.sequences.options import RECORDED, Options, read_options

__all__ = ["RecordedSequence", "Sequence", "formats", "is_live", "open_sequence", "with_mask"]

_PACKED = (".zip", ".7z", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".lz4")  # files of one or more others

#: Formats on disk, in the order in which they are tried: module, the end of its functions' names, and description.
_FORMATS = {
    "ros": ("ros", "folder", "ROS 1 and 2: .bag, .mcap and .db3 files, and the folders of ROS 2"),
    "euroc": ("euroc", "folder", "EuRoC and other ASL folders: mav0/cam0, mav0/cam1"),
    "kitti-raw": ("kitti", "drive", "KITTI raw drives: image_00/data, image_01/data"),
    "kitti": ("kitti", "folder", "KITTI odometry sequences: image_0, image_1, calib.txt"),
    "folders": (
        "folders", "folder", "two folders or videos (left, right), or one with both (layout=sbs), and a calibration",
    ),
}  # fmt: skip


def formats() -> dict[str, str]:
    """Names of the formats with a line on each."""
    known = {name: description for name, (*_, description) in _FORMATS.items()}
    camera = "live cameras: camera:0 (both images side by side), camera:0,1, or addresses"
    return {**known, "camera": camera, "synthetic": "built-in worlds: synthetic:NAME?key=value&key=value"}


def open_sequence(path: str | Path, format: str | None = None) -> Sequence:
    """Open a stereo sequence; nothing but the first pair of images is decoded yet.

    Args:
        path: a folder or a ROS recording, with options behind it as ``PATH?key=value&key=value``;
            ``synthetic:NAME?key=value``; or ``camera:0?calibration=FILE``, see `slam.sequences.camera`.
            ``kind=driving`` or ``kind=handheld`` goes with all of them but the synthetic worlds.
        format: one of `formats`; found out from the folder where it is None.

    Raises:
        SequenceError: the folder is missing, empty or of no known format, or the sequence cannot be read.
        CalibrationError: its calibration is missing, unreadable or impossible.
        UnknownNameError: the format or the synthetic world is not known.
        ConfigurationError: an option is unknown or its value impossible.
    """
    text = str(path)
    if not text:
        raise SequenceError("no sequence is named: the path is empty")
    scheme = next((name for name in ("synthetic", "camera") if text.startswith(f"{name}:")), None)
    if scheme is not None and format not in (None, scheme):
        raise ConfigurationError(f"{text}: format {format!r} does not go with a {scheme}: path")
    if "synthetic" in (scheme, format):
        return _open_world(text.removeprefix("synthetic:"))
    if "camera" in (scheme, format):
        from slam.sequences.camera import open_camera

        return open_camera(text.removeprefix("camera:"))
    try:
        return _open_folder(text, format)
    except OSError as error:  # no permission, too long a name, a folder that is not what it seems (/proc)
        raise SequenceError(f"{error.filename or text}: {reason(error)}") from error


def _open_folder(text: str, format: str | None) -> RecordedSequence:
    """A sequence on disk; what is wrong with its options is said before what is wrong with its files."""
    name, mark, query = text.rpartition("?")
    if not mark or _exists(text):
        name, query = text, ""
    folder = expanded(name).absolute()
    like = _format(folder, query, text)
    name = format or like or ""
    if not name:
        hint = hints.sequences_near(folder, _format_of)
        raise SequenceError(f"{folder}: no sequence of a known format ({', '.join(_FORMATS)}){hint}")
    if name not in _FORMATS:
        raise UnknownNameError(unknown("format", name, formats()))
    module = _module(name)
    options = Options(query, name, RECORDED | getattr(module, "OPTIONS", frozenset()))
    note_input(folder)
    lines: list[str] = []
    with FaultLog(lines, at_the_end=True) as faults:
        found: RecordedSequence = getattr(module, f"open_{_FORMATS[name][1]}")(folder, options, faults)
        masks = read_masks(options.get("mask"), folder if folder.is_dir() else folder.parent, found.rig)
        swap = options.get("swap", False)
        options.require_read(f"{folder} is read as {name}")
    truth = turned(found.ground_truth, found.rig)
    return replace(found, ground_truth=truth, masks=masks, swap=swap, warnings=lines)


def _open_world(text: str) -> Sequence:
    """A synthetic world by its text, ``synthetic:`` left out."""
    from slam.worlds import open_world

    name, mark, query = text.partition("?")
    parts = query.split("&")
    masks = [part for part in parts if part.startswith("mask=")]
    opened = open_world(name + mark + "&".join(part for part in parts if part not in masks))
    if masks:
        opened.masks = read_masks(read_options(masks[-1])["mask"], Path.cwd(), opened.rig)
        opened.name = text
    return opened


def with_mask(text: str, mask: str | None) -> str:
    """A sequence's text with the option ``mask`` added, names relative to the working folder; as it is for None."""
    if mask is None:
        return text
    names = ",".join(str(expanded(name).absolute()) if name else "" for name in mask.split(","))
    mark = "&" if "?" in text and not _exists(text) else "?"
    return f"{text}{mark}mask={quote(names, safe='/,')}"


def _exists(text: str) -> bool:
    """Whether a whole text, question mark and all, is a folder's name; options may make it too long for one."""
    try:
        return expanded(text).exists()
    except OSError:
        return False


def _format(folder: Path, query: str, text: str) -> str | None:
    """The first format that a folder looks like; told where left and right are, it needs not look.

    What is neither a folder with something in it nor a recording is refused; `text` is what was asked for.
    """
    named = read_options(query).keys()
    if _matches("ros", folder):
        return "ros"
    if not folder.exists():
        what = "file or folder" if folder.suffix else "folder"
        raise SequenceError(f"{folder}: there is no such {what}{hints.near_name(folder, text)}")
    if not folder.is_dir() and "layout" not in named:
        film = folder.suffix.lower() in VIDEO_SUFFIXES
        hint = "; unpack it first" if folder.suffix.lower() in _PACKED else hints.of_run(folder.parent)
        if film:
            hint = f"; a video with both images side by side is {folder}?layout=sbs, two are {folder.parent}"
        raise SequenceError(f"{folder}: a file where the sequence's folder should be{hint}{'?left=…&right=…' * film}")
    if folder.is_dir() and not any(folder.iterdir()):
        raise SequenceError(f"{folder}: the folder is empty")
    return "folders" if named & {"left", "right", "layout"} else _format_of(folder)


def _format_of(folder: Path) -> str | None:
    """The first format that a folder or file looks like; None for no sequence."""
    return next((name for name in _FORMATS if _matches(name, folder)), None)


def _module(name: str) -> object:
    return import_module(f"slam.sequences.{_FORMATS[name][0]}")


def _matches(name: str, folder: Path) -> bool:
    return bool(getattr(_module(name), f"matches_{_FORMATS[name][1]}")(folder))
