"""Pairs of image files: listing the two cameras' folders, pairing them, and decoding them one by one."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.files import expanded, note_input
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray, increasing, pair, trim
from slam.sequences.base import Images
from slam.sequences.faults import FaultLog
from slam.sequences.given import WIDEST_TOLERANCE, Given
from slam.sequences.images import (
    IMAGE_SUFFIXES,
    Size,
    halves,
    read_image,
    recorded_size,
    require_same_size,
    size_text,
)  # fmt: skip
from slam.sequences.names import MOST_FRAMES, keys_of, natural, same_order, stem
from slam.sequences.tables import read_rows, seconds

#: Stamps of one pair may differ by so much: hardware-triggered cameras agree far better [ns].
TOLERANCE = 5_000_000

#: Frames per second of images that say nothing of time.
RATE = 10.0


@dataclass(frozen=True)
class Listing:
    """The images of one camera, in order of time."""

    folder: Path
    keys: IntArray  # what pairs them with the other camera's (N,), increasing: stamps [ns] or frame numbers
    names: list[str]  # their file names, N of them
    stamped: bool = False  # the keys are stamps

    def __len__(self) -> int:
        return len(self.names)

    def select(self, rows: IntArray | slice) -> Listing:
        """The listing of these rows."""
        index = np.arange(len(self))[rows]
        return replace(self, keys=self.keys[index], names=[self.names[i] for i in index])


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """A frame source: two folders of image files, already paired."""

    stamps: Array  # times (N,) [s], strictly increasing
    left_folder: Path
    left: list[str]  # file names (N)
    right_folder: Path
    right: list[str | None]  # None where there is no right image
    size: Size | None = None  # width and height that every image must have; None while it is not known yet
    halves: bool = False  # both images are in the left file, side by side; there are no others

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; an error in place of one that is unreadable."""
        for name, partner in zip(self.left[start:stop], self.right[start:stop]):
            left = self._read_one(self.left_folder / name)
            if self.halves:
                yield (left, None) if isinstance(left, SequenceError) else halves(left, name)
            else:
                yield left, None if partner is None else self._read_one(self.right_folder / partner)

    def _read_one(self, path: Path) -> np.ndarray | SequenceError:
        size = self.size
        try:
            return read_image(path, (2 * size[0], size[1]) if self.halves and size is not None else size)
        except SequenceError as error:
            return error

    def first_size(self) -> Size:
        """Width and height of the first pair that can be read; SequenceError for none, or where the two differ."""
        reason = "no frame has two images"
        for left_name, right_name in zip(self.left, self.right):
            if right_name is None:
                continue
            left_path, right_path = self.left_folder / left_name, self.right_folder / right_name
            try:
                left = read_image(left_path)
                left, right = halves(left, str(left_path)) if self.halves else (left, read_image(right_path))
            except SequenceError as error:
                reason = str(error)
                continue
            require_same_size(left.shape[::-1], right.shape[::-1], left_path, right_path)
            return left.shape[1], left.shape[0]
        raise SequenceError(f"{self.left_folder}: no pair of images can be read: {reason}")


def require_size(size: Size, rig: StereoRig, calibration: Path) -> None:
    """Raise SequenceError where images, as recorded, are not of the calibration's size."""
    expected = recorded_size(rig)
    if size != expected:
        raise SequenceError(f"images are {size_text(size)}, but {calibration} is for {size_text(expected)}")


def image_names(folder: Path) -> list[str]:
    """Names of the image files in a folder, sorted as people count; SequenceError where it is none."""
    try:
        with os.scandir(folder) as entries:
            names = [e.name for e in entries if not e.name.startswith(".")]
    except NotADirectoryError:
        raise SequenceError(f"{folder}: a file where a folder of images should be") from None
    except OSError as error:
        raise SequenceError(f"{folder}: {error.strerror or error}") from error
    note_input(folder)
    return sorted((n for n in names if os.path.splitext(n)[1].lower() in IMAGE_SUFFIXES), key=natural)  # noqa: PTH122


def numbered(folder: Path, faults: FaultLog) -> Listing:
    """The images of a folder whose names are numbers (``000017.png``); gaps are reported, other files ignored."""
    by_number: dict[int, str] = {}
    for name in image_names(folder):
        number = number_of(name)
        if number is not None and number <= MOST_FRAMES:
            by_number.setdefault(number, name)
    if not by_number:
        raise SequenceError(f"{folder}: no images with numbers for names")
    keys = np.array(sorted(by_number), np.int64)
    gaps = int(keys[-1] - keys[0]) + 1 - len(keys)
    if gaps:
        after = by_number[int(keys[int(np.argmax(np.diff(keys) > 1))])]
        faults.report("images", f"{folder}: {gaps} images are missing between the first and the last (after {after})")
    return Listing(folder, keys, [by_number[k] for k in keys.tolist()])


def number_of(name: str) -> int | None:
    """The number that is the name of a file without its ending, in 64 bits; None where it is none."""
    text = stem(name)
    return int(text) if text.isascii() and text.isdecimal() and int(text) < 2**63 else None


def by_names(folders: list[Path], names: list[list[str]], faults: FaultLog) -> list[Listing]:
    """The images of one camera or two by what their names say: stamps, else numbers, else their order.

    Raises:
        SequenceError: only their order is left, and the cameras have unequally many.
    """
    found = keys_of(names)
    if found is None:
        if len({len(own) for own in names}) > 1:
            counts = " and ".join(f"{folder} has {len(own)} images" for folder, own in zip(folders, names))
            raise SequenceError(f"{counts}: neither stamps nor numbers in their names say which go together")
        names = [sorted(own, key=natural) for own in names]
        guess = "neither stamps nor numbers in the names say which images go together: their order does"
        found = [np.arange(len(own)) for own in names], False, "" if same_order(names) else guess
    keys, stamped, guess = found
    if guess:
        faults.assume(f"{folders[0]}: {guess}")
    listings = []
    for folder, own_keys, own in zip(folders, keys, names):
        order = np.argsort(own_keys, kind="stable")
        listing = Listing(folder, own_keys[order], [own[i] for i in order], stamped)
        listings.append(in_order(listing, str(folder), faults))
    return listings


def read_times(folder: Path, options: Given, faults: FaultLog, *usual: Path) -> tuple[Path, Array] | None:
    """The file of times, by option or by convention, and the times in it by row [s], NaN for unreadable ones.

    None where there is no file, or ``fps`` is given in its place.
    """
    if "times" in options:
        path: Path | None = folder / expanded(options["times"])
    else:
        path = None if "fps" in options else next((path for path in usual if path.is_file()), None)
    if path is None:
        return None
    return path, np.array([np.nan if row is None else row for row in read_rows(path, seconds, faults)])


def pair_up(
    left: Listing,
    right: Listing | None,
    options: Given,
    faults: FaultLog,
    times: tuple[Path, Array] | None = None,
    by_number: bool = False,
) -> tuple[Listing, ImagePairs]:
    """Pair the images of two cameras by their keys, and give each pair its time.

    Time is by the file of times, else by ``fps``, else by stamps, else by numbers at `RATE`.

    Args:
        left: of the left camera.
        right: of the right one; None where both images are in one file, side by side.
        options: ``fps`` and ``tolerance`` are read where they mean something.
        faults: told what does not pair.
        times: a file and the times in it by row [s].
        by_number: a row's number is a frame's; else rows belong to the left images in order.

    Returns:
        The left images that are left, and the pairs.

    Raises:
        SequenceError: nothing pairs, hardly a frame has a time, or no pair can be read.
    """
    rate = None if times else options.rate()
    kept, partners = left, list[str | None](left.names)
    if right is not None:
        wanted = options.tolerance() if left.stamped else 0
        tolerance = hardware_tolerance(left, bool(times or rate)) if wanted is None else wanted
        kept, partners = pair_listings(left, right, tolerance, faults)
    position = np.searchsorted(left.keys, kept.keys)
    if times is not None:
        path, rows = times
        if not by_number and len(rows) != len(left):
            faults.report("stamps", f"{path} has {len(rows)} rows, {left.folder} has {len(left)} images")
        keep, stamps = _stamped(kept.keys if by_number else position, rows, path, faults)
        kept, partners = kept.select(keep), [partners[i] for i in keep]
    elif left.stamped and rate is None:
        kept, partners, stamps = in_seconds(kept, partners, faults)
    else:
        numbers = position if left.stamped else kept.keys if by_number else kept.keys - kept.keys[0]
        if rate is None:
            faults.assume(f"{left.folder}: no times, {RATE:g} frames per second assumed (see fps=…)")
        stamps = numbers / (rate or RATE)
    pairs = ImagePairs(stamps, left.folder, kept.names, (right or left).folder, partners, halves=right is None)
    return kept, replace(pairs, size=pairs.first_size())


def in_seconds(
    listing: Listing, partners: list[str | None], faults: FaultLog
) -> tuple[Listing, list[str | None], Array]:
    """A listing by stamps [ns] with its stamps [s]; those that are the same in floating point are left out."""
    stamps = 1e-9 * listing.keys.astype(float)
    rows = increasing(stamps)
    if len(rows) < len(stamps):
        line = f"{listing.folder}: {len(stamps) - len(rows)} stamps are nearer than a microsecond to the one before"
        faults.report("stamps", f"{line}; images left out")
    return listing.select(rows), [partners[i] for i in rows], stamps[rows]


def in_order(listing: Listing, what: str, faults: FaultLog) -> Listing:
    """The rows whose keys increase; others, that stand twice or run backwards, are reported, or an error if most."""
    rows = increasing(listing.keys)
    dropped = np.setdiff1d(np.arange(len(listing)), rows)
    if len(dropped):
        first = f"(first: {listing.names[dropped[0]]})"
        line = f"{what}: {len(dropped)} of {len(listing)} stamps stand twice or run backwards {first}"
        if 2 * len(dropped) > len(listing):
            raise SequenceError(line)
        faults.report("stamps", f"{line}; left out")
    return listing.select(rows)


def present(listing: Listing, what: str, faults: FaultLog) -> Listing:
    """The listed images that exist; another ending (``.jpg`` for ``.png``) is accepted. The rest is reported."""
    known = {name: name for name in image_names(listing.folder)}
    by_stem = {stem(name): name for name in known}
    names = [known.get(n) or by_stem.get(stem(n), "") for n in listing.names]
    missing = [wanted for wanted, found in zip(listing.names, names) if not found]
    if len(missing) == len(names):
        raise SequenceError(f"{listing.folder}: none of the {len(names)} images listed in {what} is there")
    if missing:
        line = f"{what}: {len(missing)} of {len(names)} listed images are missing (first: {missing[0]})"
        faults.report("listed images", line)
    return replace(listing, names=names).select(np.flatnonzero([bool(n) for n in names]))


def hardware_tolerance(listing: Listing, told: bool = False) -> int:
    """How far stamps of a pair may be apart [ns]: half a frame, and `TOLERANCE` at most, unless the rate is told."""
    if len(listing) < 2:
        return TOLERANCE
    half = np.median(np.diff(listing.keys)) / 2
    return int(0.98 * half if told else min(TOLERANCE, half))


def _stamped(numbers: np.ndarray, times: Array, path: Path, faults: FaultLog) -> tuple[np.ndarray, Array]:
    """Rows and stamps of the frames that have a time, as most must; `times` (T,) is by frame number, NaN for none."""
    inside = numbers < len(times)
    stamps = np.where(inside, times[np.minimum(numbers, len(times) - 1)], np.nan)
    good = np.flatnonzero(np.isfinite(stamps))
    keep = good[increasing(stamps[good])] if len(good) else good
    untimed, unordered = len(numbers) - len(good), len(good) - len(keep)
    if 2 * len(keep) < len(numbers):
        what = f"{untimed} have no time and {unordered} one that does not increase"
        raise SequenceError(f"{path}: of {len(numbers)} images {what}")
    for count, what in (
        (len(times) - int(numbers[-1]) - 1, "the last {} rows have no image"),
        (untimed, "{} images have no time; left out"),
        (unordered, "{} times stand twice or run backwards; images left out"),
    ):
        if count > 0:
            faults.report("stamps", f"{path}: {what.format(count)}")
    return keep, stamps[keep]


def pair_listings(left: Listing, right: Listing, tolerance: int, faults: FaultLog) -> tuple[Listing, list[str | None]]:
    """Left images and, for each, the name of the right image nearest in key, None where none is within `tolerance`.

    Left images before the first pair and after the last are left out, and so are right images without a partner;
    what is left out or stands alone is reported.

    Raises:
        SequenceError: no left image has a partner.
    """
    partner = pair(left.keys, right.keys, tolerance)
    rows = trim(partner)
    if rows.stop == 0:
        raise SequenceError(_no_pair(left, right, tolerance))
    head, tail, unused = rows.start, len(left) - rows.stop, len(right) - int((partner >= 0).sum())
    if head or tail:
        line = f"{left.folder}: {head} images before the first pair and {tail} after the last are left out"
        faults.report("pairs", line)
    alone = np.flatnonzero(partner[rows] < 0)
    if len(alone):
        first = left.names[int(alone[0]) + rows.start]
        line = f"{left.folder}: {len(alone)} images have no partner in {right.folder} (first: {first})"
        faults.report("pairs", f"{line}; given without a right image")
    if unused:
        faults.report("pairs", f"{right.folder}: {unused} images have no partner in {left.folder}; left out")
    return left.select(rows), [right.names[i] if i >= 0 else None for i in partner[rows]]


def _no_pair(left: Listing, right: Listing, tolerance: int) -> str:
    """Why nothing pairs, with how far the nearest two images are apart."""
    after = np.searchsorted(right.keys, left.keys).clip(0, len(right) - 1)
    gap = np.minimum(*(np.abs(right.keys[rows] - left.keys) for rows in (after, (after - 1).clip(0)))).min()
    line = f"no image of {left.folder} has a partner in {right.folder}: the nearest two are "
    if not left.stamped:
        return f"{line}{gap} frames apart"
    line += f"{1e-6 * gap:.6g} ms apart, {1e-6 * tolerance:.6g} ms are allowed"
    enough = gap <= WIDEST_TOLERANCE * 1e9
    return f"{line}; see tolerance=… [s]" if enough else f"{line}: the clocks of the cameras differ"
