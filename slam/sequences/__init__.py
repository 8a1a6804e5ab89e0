"""Stereo sequences: EuRoC, KITTI, ROS recordings, two folders or videos, live cameras, and the synthetic worlds.

`open_sequence` finds the format out by itself. Layouts, options and faults are described in
``docs/sequences.md``. May import `slam.worlds`, `slam.geometry` and the data.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from itertools import chain, islice
from pathlib import Path
from urllib.parse import parse_qsl, quote

from slam.errors import ConfigurationError, SequenceError, UnknownNameError
from slam.files import expanded, note_input, reason
from slam.naming import nearest, suggestion, unknown
from slam.sequences.base import RecordedSequence, Sequence, is_live
from slam.sequences.door import read_masks
from slam.sequences.given import OPTIONS, Given

__all__ = ["RecordedSequence", "Sequence", "formats", "is_live", "open_sequence", "with_mask"]

_SYNTHETIC = "synthetic:"
_CAMERA = "camera:"
_KINDS = ("driving", "handheld")

#: Formats on disk, in the order in which they are tried: module, the end of its functions' names, and description.
_FORMATS = {
    "euroc": ("slam.sequences.euroc", "folder", "EuRoC and other ASL folders: mav0/cam0, mav0/cam1"),
    "kitti-raw": ("slam.sequences.kitti", "drive", "KITTI raw drives: image_00/data, image_01/data"),
    "kitti": ("slam.sequences.kitti", "folder", "KITTI odometry sequences: image_0, image_1, calib.txt"),
    "ros": ("slam.sequences.ros", "folder", "ROS 1 and 2: .bag, .mcap and .db3 files, and the folders of ROS 2"),
    "folders": (
        "slam.sequences.folders",
        "folder",
        "two folders or videos (left, right), or one with both (layout=sbs), and a calibration",
    ),
}
_MOST_OPTIONS = 100
_LOOKED_AT = 1000  # files and folders below one that is no sequence
_LEVELS_ABOVE = 3  # folders above one that is no sequence: mav0/cam0/data
_CAMERA_OPTIONS = frozenset({"kind", "mask"})


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
    if text.startswith(_SYNTHETIC) and format not in (None, "synthetic"):
        raise ConfigurationError(f"{text}: format {format!r} does not go with a synthetic world")
    if format == "synthetic" or text.startswith(_SYNTHETIC):
        return _open_world(text)
    if text.startswith(_CAMERA) and format not in (None, "camera"):
        raise ConfigurationError(f"{text}: format {format!r} does not go with a camera")
    if format == "camera" or text.startswith(_CAMERA):
        return _open_camera(text.removeprefix(_CAMERA))
    try:
        return _open_folder(text, format)
    except OSError as error:  # no permission, too long a name, a folder that is not what it seems (/proc)
        raise SequenceError(f"{error.filename or text}: {reason(error)}") from error


def _open_folder(text: str, format: str | None) -> RecordedSequence:
    """A sequence on disk."""
    folder, options = _split(text)
    if not (folder.is_file() and "layout" in options):
        _require_recording(folder, text)
    name = _detect(folder, options) if format is None else _known(format)
    module = import_module(_FORMATS[name][0])
    _check_options(name, options, OPTIONS | getattr(module, "OPTIONS", frozenset()))
    note_input(folder)
    given = Given(options)
    opened: RecordedSequence = getattr(module, f"open_{_FORMATS[name][1]}")(folder, given)
    masks = read_masks(given.get("mask"), folder if folder.is_dir() else folder.parent, opened.rig)
    given.require_read(f"{folder} is read as {name}")
    return replace(opened, masks=masks)


def _open_world(text: str) -> Sequence:
    """A synthetic world by its text, ``synthetic:`` in front."""
    from slam.worlds import open_world

    name, mark, query = text.partition("?")
    masks = [part for part in query.split("&") if part.startswith("mask=")]
    opened = open_world(name + mark + "&".join(part for part in query.split("&") if part not in masks))
    if masks:
        opened.masks = read_masks(_options(masks[-1])["mask"], Path.cwd(), opened.rig)
        opened.name = text.removeprefix(_SYNTHETIC)
    return opened


def with_mask(text: str, mask: str | None) -> str:
    """A sequence's text with the option ``mask`` added, names relative to the working folder; as it is for None."""
    if mask is None:
        return text
    names = ",".join(str(expanded(name).absolute()) if name else "" for name in mask.split(","))
    mark = "&" if "?" in text and not _exists(text) else "?"
    return f"{text}{mark}mask={quote(names, safe='/,')}"


def _open_camera(text: str) -> Sequence:
    """A camera by its text, ``camera:`` left out; a question mark may be part of an address in a network."""
    from slam.sequences import camera

    name, mark, query = text.rpartition("?")
    known = camera.OPTIONS | _CAMERA_OPTIONS
    options = _options(query) if mark else {}
    if not mark or ("://" in name and not set(options) <= known):
        name, options = text, {}
    _check_options("camera", options, known)
    return camera.open_camera(name, options)


def _split(text: str) -> tuple[Path, dict[str, str]]:
    """The path, ``~`` expanded, and the options behind the question mark."""
    name, mark, query = text.rpartition("?")
    if not mark or _exists(text):
        return expanded(text).absolute(), {}
    return expanded(name).absolute(), _options(query)


def _options(query: str) -> dict[str, str]:
    """The options ``key=value&key=value`` behind a question mark."""
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, max_num_fields=_MOST_OPTIONS))
    except ValueError:
        raise ConfigurationError(f"more than {_MOST_OPTIONS} options") from None
    for key, value in options.items():
        if "\0" in value:
            raise ConfigurationError(f"option {key!r} holds a NUL")
    return options


def _exists(text: str) -> bool:
    """Whether a whole text, question mark and all, is a folder's name; options may make it too long for one."""
    try:
        return expanded(text).exists()
    except OSError:
        return False


def _require_recording(folder: Path, text: str) -> None:
    """Refuse what is neither a folder with something in it nor a ROS recording; `text` is what was asked for."""
    if _is_ros(folder):
        return
    if not folder.exists():
        raise SequenceError(f"{folder}: there is no such {_kind(folder)}{_world_meant(text) or _folder_meant(folder)}")
    if not folder.is_dir():
        raise SequenceError(f"{folder}: a file where the sequence's folder should be{_video_meant(folder)}")
    if not any(folder.iterdir()):
        raise SequenceError(f"{folder}: the folder is empty")


def _kind(path: Path) -> str:
    """What a name that does not exist would be."""
    return "file or folder" if path.suffix else "folder"


def _video_meant(file: Path) -> str:
    """How to run a video; empty where the file is none."""
    from slam.sequences.videos import VIDEO_SUFFIXES

    if file.suffix.lower() not in VIDEO_SUFFIXES:
        return ""
    return f"; a video with both images side by side is {file}?layout=sbs, two videos are {file.parent}?left=…&right=…"


def _world_meant(text: str) -> str:
    """A suggestion where the text is much like a synthetic world's, ``synthetic:`` left out; else empty."""
    from slam import worlds

    name, mark, query = text.partition("?")
    near = None if Path(name).name != name else nearest(name, worlds.names())
    return f" (did you mean '{_SYNTHETIC}{near}{mark}{query}'?)" if near else ""


def _folder_meant(folder: Path) -> str:
    """A folder with a similar name, or the part of the path that is missing first; empty where neither helps."""
    there = next((parent for parent in folder.parents if parent.is_dir()), None)
    if there is None:
        return ""
    missing = folder.relative_to(there).parts[0]
    with suppress(OSError):
        near = nearest(missing, (path.name for path in islice(there.iterdir(), _LOOKED_AT)))
        if near is not None:
            return f" (did you mean '{there / near}'?)"
    return "" if there == folder.parent else f": {there} has no {missing!r}"


def _sequence_above(folder: Path) -> str:
    """A hint where the folder lies in a sequence; else empty."""
    for parent in islice(folder.parents, _LEVELS_ABOVE):
        with suppress(OSError):
            name = _format_of(parent)
            if name is not None:
                return f"; it is a part of one: give {parent} (format {name})"
    return ""


def _detect(folder: Path, options: dict[str, str]) -> str:
    """The first format that the folder looks like; told where left and right are, it needs not look."""
    if _is_ros(folder):
        return "ros"
    if options.keys() & {"left", "right", "layout"}:
        return "folders"
    name = _format_of(folder)
    if name is None:
        below = _sequences_below(folder)
        names = ", ".join(str(p.relative_to(folder)) for p in below[:3]) + (", …" if len(below) > 3 else "")
        hint = _two_cameras(folder) + (f"; below it are {names}" if below else "") or _sequence_above(folder)
        raise SequenceError(f"{folder}: no sequence of a known format ({', '.join(_FORMATS)}){hint}")
    return name


def _two_cameras(folder: Path) -> str:
    """How to name the cameras where the folder has two folders of images, or two videos, by other names; else empty."""
    from slam.sequences.images import IMAGE_SUFFIXES
    from slam.sequences.videos import VIDEO_SUFFIXES

    names: list[str] = []
    with suppress(OSError):
        for path in sorted(islice(folder.iterdir(), _LOOKED_AT)):
            inside = islice(path.iterdir(), _LOOKED_AT) if path.is_dir() else ()
            images = sum(p.suffix.lower() in IMAGE_SUFFIXES for p in inside)
            if path.suffix.lower() in VIDEO_SUFFIXES or images > 1:
                names.append(path.name)
    two = names if len(names) == 2 else [name for name in names if not Path(name).suffix]
    return f"; say which is which: '{folder.name}?left={two[0]}&right={two[1]}'" if len(two) == 2 else ""


def _is_ros(path: Path) -> bool:
    """Whether a path is a ROS recording, which may be a file."""
    return _matches("ros", path)


def _sequences_below(folder: Path) -> list[Path]:
    """Sequences one or two folders further down, for a hint; what cannot be looked at is passed over."""
    found: list[Path] = []
    with suppress(OSError):
        for path in islice(chain(folder.glob("*"), folder.glob("*/*")), _LOOKED_AT):
            with suppress(OSError):
                if (path.is_dir() or _is_ros(path)) and _format_of(path):
                    found.append(path)
    return sorted(found)


def _format_of(folder: Path) -> str | None:
    """The first format that a folder looks like; None for no sequence."""
    return next((name for name in _FORMATS if _matches(name, folder)), None)


def _matches(name: str, folder: Path) -> bool:
    """Whether a folder, or a file, looks like a format."""
    module, end, _ = _FORMATS[name]
    return bool(getattr(import_module(module), f"matches_{end}")(folder))


def _known(format: str) -> str:
    if format not in _FORMATS:
        raise UnknownNameError(unknown("format", format, formats()))
    return format


def _check_options(name: str, options: dict[str, str], known: frozenset[str]) -> None:
    """Refuse unknown options, and kinds of motion that do not exist."""
    strange = sorted(set(options) - known)
    if strange:
        hint = f"{suggestion(strange[0], known)}; known: {', '.join(sorted(known))}"
        raise ConfigurationError(f"unknown option {strange[0]!r} of format {name}{hint}")
    if options.get("kind", _KINDS[0]) not in _KINDS:
        raise ConfigurationError(unknown("kind of motion", options["kind"], _KINDS))
