"""Stereo sequences: EuRoC, KITTI, ROS recordings, two folders or videos, live cameras, and the synthetic worlds.

`open_sequence` finds the format out by itself. Layouts, options and faults are described in
``docs/sequences.md``. May import `slam.worlds`, `slam.geometry` and the data.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from urllib.parse import quote

import numpy as np

from slam import registry
from slam.errors import ConfigurationError, PartError, SequenceError, SlamError, UnknownNameError, cause
from slam.files import expanded, note_input, reason
from slam.geometry.rig import quarter_turn
from slam.geometry.se3 import Array, pose
from slam.geometry.stamps import pair
from slam.geometry.trajectory import Trajectory
from slam.naming import nearest, unknown
from slam.query import read_query
from slam.sequences import euroc, folders, kitti, ros
from slam.sequences.base import FaultLog, RecordedSequence, Sequence, is_live, logger, read_masks
from slam.sequences.folders import VIDEO_SUFFIXES
from slam.sequences.images import IMAGE_SUFFIXES
from slam.sequences.options import RECORDED, Options, truth_noise
from slam.sequences.tables import require_truth

__all__ = ["RecordedSequence", "Sequence", "format_of", "formats", "is_live", "open_sequence", "with_mask"]

_LOOKED_AT = 500  # entries below a folder that is no sequence, at each of so many levels
_LEVELS = 4
_LISTED = 6  # sequences below a folder
_SPARSE = 0.5  # [s] between true poses, from which on their unit is asked for
_MOST = 0.95  # share of images with a true pose, below which a line says how many
_NEAR = 0.02  # [s] of a true pose's stamp to an image's, as `slam.evaluation.metrics.associate` has it


Matches = Callable[[Path], bool]  # whether a folder or file looks like a format
Opener = Callable[[Path, Options, FaultLog], RecordedSequence]

#: How each format is known and opened, in the order in which they are tried.
_FORMATS: dict[str, tuple[Matches, Opener]] = {
    "ros": (ros.matches_folder, ros.open_folder),
    "euroc": (euroc.matches_folder, euroc.open_folder),
    "kitti-raw": (kitti.matches_drive, kitti.open_folder),
    "kitti": (kitti.matches_folder, kitti.open_folder),
    "folders": (folders.matches_folder, folders.open_folder),
}


def formats() -> tuple[str, ...]:
    """Names of the formats."""
    return (*_FORMATS, "camera", "synthetic")


def open_sequence(path: str | Path, format: str | None = None, quiet: bool = False) -> Sequence:
    """Open a stereo sequence; nothing but the first pair of images is decoded yet.

    Args:
        path: a folder or a ROS recording, with options behind it as ``PATH?key=value&key=value``;
            ``synthetic:NAME?key=value``; or ``camera:0?calibration=FILE``, see `slam.sequences.camera`.
            ``kind=driving`` or ``kind=handheld`` goes with all of them but the synthetic worlds.
        format: one of `formats`; found out from the folder where it is None. Or one of your own,
            ``"my_module:open_folder"``, a function of folder, options and faults that returns a `RecordedSequence`.
        quiet: what is wrong with its files is kept in its `warnings` alone, and not logged.

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
        from slam.worlds import open_world

        return open_world(text.removeprefix("synthetic:"), lambda names, rig: read_masks(names, Path.cwd(), rig))
    if "camera" in (scheme, format):
        from slam.sequences.camera import open_camera

        return open_camera(text.removeprefix("camera:"))
    try:
        return _open_folder(text, format, quiet)
    except OSError as error:  # no permission, too long a name, a folder that is not what it seems (/proc)
        raise SequenceError(f"{error.filename or text}: {reason(error)}") from error


def _open_folder(text: str, format: str | None, quiet: bool) -> RecordedSequence:
    """A sequence on disk; what is wrong with its options is said before what is wrong with its files."""
    name, mark, query = text.rpartition("?")
    if not mark or _exists(text):
        name, query = text, ""
    folder = expanded(name).absolute()
    like = _format_asked(folder, query, text)
    name = format or like or ""
    if not name:
        raise SequenceError(f"{folder}: no sequence of a known format ({', '.join(_FORMATS)}){_hint_near(folder)}")
    if name not in _FORMATS and ":" not in name:
        raise UnknownNameError(unknown("format", name, formats()))
    options = Options(query, name, RECORDED)
    note_input(folder)
    lines: list[str] = []
    with FaultLog(lines, quiet=True) as faults:  # above an error nothing is said
        _, opener = _FORMATS.get(name, (None, partial(_own, name)))
        found = opener(folder, options, faults)
        home = folder if folder.is_dir() else folder.parent
        masks = read_masks(options.get("mask"), home, found.rig)
        if "truth" in options:
            given = _truth(home / expanded(options["truth"]), found.stamps, lines)
            found = replace(found, ground_truth=given, truth_noise=truth_noise(options.get("truth_sigma", "0")))
        swap = options.get("swap", False)
        options.require_read(f"{folder} is read as {name}")
    for line in () if quiet else lines:
        logger.warning("%s", line)
    truth, turns = found.ground_truth, found.rig.turns
    if truth is not None and turns:  # of the camera that is turned as the rig is
        truth = Trajectory(truth.stamps, truth.poses @ pose(quarter_turn(-turns), np.zeros(3)))
    return replace(found, ground_truth=truth, masks=masks, swap=swap, warnings=lines)


def _truth(path: Path, stamps: Array, lines: list[str]) -> Trajectory:
    """The left camera's true path in TUM's form; SlamError where it is none, or of other times than the images.

    A line is added where some images have none.
    """
    truth = require_truth(Trajectory.read_tum(path), path)
    near = int((pair(stamps, truth.stamps, _NEAR) >= 0).sum())
    step = float(np.median(np.diff(truth.stamps))) if len(truth) > 1 else 0.0
    sparse = f"; true poses are {step:.3g} s apart: are their times in seconds?" if step > _SPARSE else ""
    if not near:
        ends = (f"{times[0]:.3f} to {times[-1]:.3f} s" for times in (truth.stamps, stamps))
        raise SequenceError(
            f"{path}: no pose is within {_NEAR:g} s of an image: {', images are from '.join(ends)}{sparse}"
        )
    if near < _MOST * len(stamps):
        lines.append(f"{path}: {near} of {len(stamps)} images have a true pose, the others are not judged{sparse}")
    return truth


def _own(name: str, folder: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """A sequence of a format of somebody's own, ``module:function``."""
    opener = registry.resolve("formats", name)
    try:
        found = opener(folder, options, faults)
    except SlamError:
        raise
    except Exception as error:  # whatever a foreign function does
        raise PartError(f"format {name!r}: {cause(error)}") from error
    if not isinstance(found, RecordedSequence):
        raise SequenceError(
            f"format {name!r}: must return a slam.sequences.RecordedSequence, got {type(found).__name__}"
        )
    return found


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


def format_of(folder: Path) -> str | None:
    """The format of the recording that a folder, or file, looks like; None where it is none."""
    return next((name for name, (matches, _) in _FORMATS.items() if matches(folder)), None)


def _format_asked(folder: Path, query: str, text: str) -> str | None:
    """The first format that a folder looks like; what is neither a recording nor a folder of something is refused."""
    named = read_query(query).keys()
    if ros.matches_folder(folder):
        return "ros"
    if not folder.exists():
        from slam import worlds

        name, mark, options = text.partition("?")
        near = nearest(name, worlds.names())
        hint = f" (did you mean 'synthetic:{near}{mark}{options}'?)" if near else ""
        raise SequenceError(f"{folder}: there is no such {'file or folder' if folder.suffix else 'folder'}{hint}")
    if not folder.is_dir() and "layout" not in named:
        hint = "; give the folder that holds both cameras' images, unpacked"
        if folder.suffix.lower() in VIDEO_SUFFIXES:
            two = f"two are {folder.parent}?left=…&right=…"
            hint = f"; a video with both images side by side is {folder}?layout=sbs, {two}"
        elif folder.suffix == ".npz":
            hint = "; recorded features are run by `slam replay`"
        raise SequenceError(f"{folder}: a file where the sequence's folder should be{hint}")
    if folder.is_dir() and not any(folder.iterdir()):
        raise SequenceError(f"{folder}: the folder is empty")
    return "folders" if named & {"left", "right", "layout"} else format_of(folder)


def _hint_near(folder: Path) -> str:
    """Which sequences lie below a folder, or it is a part of; else how to name the two cameras in it."""
    if (folder / "config.json").is_file() and (folder / "frames.csv").is_file():
        return "; it holds a run: `slam plot` draws several in one picture, `slam view` shows one"
    with suppress(OSError, SequenceError):
        for level in range(1, _LEVELS + 1):  # 2011_09_26/…_sync, dataset/sequences/03
            inside = islice(folder.glob("/".join("*" * level)), _LOOKED_AT)
            below = sorted(str(path.relative_to(folder)) for path in inside if format_of(path))
            if len(below) == 1:
                return f"; below it is {below[0]}: give that"
            if below:
                more = f", … ({len(below)})" if len(below) > _LISTED else ""
                return f"; below it are {', '.join(below[:_LISTED])}{more}: give one of them"
    images = any(path.suffix.lower() in IMAGE_SUFFIXES for path in islice(folder.iterdir(), _LOOKED_AT))
    for parent in islice(folder.parents, _LEVELS):  # mav0/cam0/data
        if (name := format_of(parent)) is not None and (images or name != "folders"):
            return f"; it is a part of one: give {parent} (format {name})"
    if images:
        return f"; where each image holds both cameras: '{folder.name}?layout=sbs'; else name both: ?left=…&right=…"
    names = sorted(path.name for path in islice(folder.iterdir(), _LOOKED_AT) if path.is_dir())
    left, right = names if len(names) == 2 else ("…", "…")
    return f"; where two cameras are in it by other names: '{folder.name}?left={left}&right={right}'"
