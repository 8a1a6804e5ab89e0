"""Pairs of image files: listing the two cameras' folders, pairing them, and decoding them one by one."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.files import expanded, note_input
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray, increasing, pair, trim
from slam.sequences.base import Images
from slam.sequences.faults import FaultLog
from slam.sequences.given import WIDEST_TOLERANCE, Given
from slam.sequences.images import IMAGE_SUFFIXES, Size, halves, read_image, require_same_size
from slam.sequences.names import MOST_FRAMES, keys_of, natural, odd_ones, same_order, stem
from slam.sequences.tables import read_rows, seconds

#: Frames per second of images that say nothing of time.
RATE = 10.0

_TOLERANCE = 5_000_000  # [ns] between the stamps of a pair: hardware-triggered cameras agree far better


@dataclass(frozen=True, eq=False)
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
class Pairs:
    """Left images, and what belongs to each."""

    left: Listing
    partners: list[str | None]  # the right images' names (N), None where there is none
    stamps: Array  # times (N,) [s], strictly increasing; without times those of the keys

    def select(self, rows: IntArray, stamps: Array) -> Pairs:
        """These rows with these stamps."""
        return Pairs(self.left.select(rows), [self.partners[i] for i in rows], stamps)


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """A frame source: two folders of image files, already paired."""

    stamps: Array  # times (N,) [s], strictly increasing
    left: list[Path]  # (N)
    right: list[Path | None]  # None where there is no right image
    size: Size  # width and height that every image must have
    halves: bool = False  # both images are in the left file, side by side; there are no others

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; an error in place of one that is unreadable."""
        size = (2 * self.size[0], self.size[1]) if self.halves else self.size
        for name, partner in zip(self.left[start:stop], self.right[start:stop]):
            left = _image(name, size)
            if self.halves:
                yield (left, None) if isinstance(left, SequenceError) else halves(left, name)
            else:
                yield left, None if partner is None else _image(partner, size)


def _image(path: Path, size: Size) -> np.ndarray | SequenceError:
    try:
        return read_image(path, size)
    except SequenceError as error:
        return error


def image_pairs(pairs: Pairs, right: Path | None) -> ImagePairs:
    """The source of pairs of image files, those of the right camera in the folder `right`; None for side by side.

    SequenceError where no pair can be read, or the two images of the first one that can differ in size.
    """
    left = [pairs.left.folder / name for name in pairs.left.names]
    partners = [None if right is None or name is None else right / name for name in pairs.partners]
    fault = "no frame has two images"
    for left_path, right_path in zip(left, partners):
        if right is None or right_path is not None:
            try:
                image = read_image(left_path)
                a, b = halves(image, left_path) if right_path is None else (image, read_image(right_path))
            except SequenceError as error:
                fault = str(error)
                continue
            require_same_size(a.shape[::-1], b.shape[::-1], left_path, right_path)
            return ImagePairs(pairs.stamps, left, partners, (a.shape[1], a.shape[0]), right is None)
    raise SequenceError(f"{pairs.left.folder}: no pair of images can be read: {fault}")


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


def number_of(name: str) -> int | None:
    """The number that is the name of a file without its ending, in 64 bits; None where it is none."""
    text = stem(name)
    return int(text) if text.isascii() and text.isdecimal() and int(text) < 2**63 else None


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


def by_names(folders: list[Path], names: list[list[str]], faults: FaultLog) -> list[Listing]:
    """The images of one camera or two by what their names say: stamps, else numbers, else their order.

    SequenceError where only their order is left, and the cameras have unequally many.
    """
    for at, own in enumerate(names):
        if odd := odd_ones(own):
            line = f"{folders[at]}: {len(odd)} of {len(own)} images are named unlike the others (first: {odd[0]})"
            faults.report("images", f"{line}; left out")
            names[at] = [name for name in own if name not in odd]
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
    there = image_names(listing.folder)
    known = {stem(name): name for name in there} | {name: name for name in there}
    names = [known.get(n) or known.get(stem(n), "") for n in listing.names]
    missing = [wanted for wanted, found in zip(listing.names, names) if not found]
    if len(missing) == len(names):
        raise SequenceError(f"{listing.folder}: none of the {len(names)} images listed in {what} is there")
    if missing:
        line = f"{what}: {len(missing)} of {len(names)} listed images are missing (first: {missing[0]})"
        faults.report("listed images", line)
    return replace(listing, names=names).select(np.flatnonzero([bool(n) for n in names]))


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


def pair_up(left: Listing, right: Listing | None, options: Given, faults: FaultLog, told: bool = False) -> Pairs:
    """Pair the images of two cameras by their keys, the option ``tolerance`` apart at most.

    Left images before the first pair and after the last are left out, and so are right images without a partner;
    what is left out or stands alone is reported. Without a right camera both images are in one file, side by side.
    Where time is `told` by a file or a rate, half a frame, not `_TOLERANCE`, is the default. SequenceError where
    nothing pairs.
    """
    if right is None:
        return Pairs(left, list(left.names), 1e-9 * left.keys)
    tolerance: float = 0
    if left.stamped:
        half = np.median(np.diff(left.keys)) / 2 if len(left) > 1 else _TOLERANCE
        tolerance = int(0.98 * half if told and len(left) > 1 else min(_TOLERANCE, half))
        given = options.tolerance()
        tolerance = tolerance if given is None else given
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
    names = [right.names[i] if i >= 0 else None for i in partner[rows]]
    kept = left.select(rows)
    return Pairs(kept, names, 1e-9 * kept.keys)


def timed(
    left: Listing, right: Listing | None, options: Given, faults: FaultLog, times: tuple[Path, Array] | None,
    by_number: bool = False,
) -> Pairs:  # fmt: skip
    """The pairs of two cameras, see `pair_up`, each with its time.

    Time is by the file of times, else by ``fps``, else by stamps, else by numbers at `RATE`. Rows of the file `times`
    belong to the left images in order; with `by_number` a row's number is a frame's. SequenceError where nothing pairs,
    or hardly a frame has a time.
    """
    rate = None if times else options.rate()
    pairs = pair_up(left, right, options, faults, bool(times or rate))
    position = np.searchsorted(left.keys, pairs.left.keys)
    if times is not None:
        path, rows = times
        if not by_number and len(rows) != len(left):
            faults.report("stamps", f"{path} has {len(rows)} rows, {left.folder} has {len(left)} images")
        return pairs.select(*_stamped(pairs.left.keys if by_number else position, rows, path, faults))
    if left.stamped and rate is None:
        return distinct(pairs, faults)
    numbers = position if left.stamped else pairs.left.keys - (0 if by_number else pairs.left.keys[0])
    if rate is None:
        faults.assume(f"{left.folder}: no times, {RATE:g} frames per second assumed (see fps=…)")
    return replace(pairs, stamps=numbers / (rate or RATE))


def distinct(pairs: Pairs, faults: FaultLog) -> Pairs:
    """The pairs whose stamps [s] increase; others are the same as the one before in floating point."""
    rows = increasing(pairs.stamps)
    if len(rows) < len(pairs.stamps):
        line = f"{pairs.left.folder}: {len(pairs.stamps) - len(rows)} stamps are nearer than a microsecond to the"
        faults.report("stamps", f"{line} one before; images left out")
    return pairs.select(rows, pairs.stamps[rows])


def _stamped(numbers: np.ndarray, times: Array, path: Path, faults: FaultLog) -> tuple[np.ndarray, Array]:
    """Rows and stamps of the frames that have a time, as most must; `times` (T,) is by frame number, NaN for none."""
    inside = numbers < len(times)
    stamps = np.where(inside, times[np.minimum(numbers, len(times) - 1)], np.nan)
    good = np.flatnonzero(np.isfinite(stamps))
    keep = good[increasing(stamps[good])]
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


def _no_pair(left: Listing, right: Listing, tolerance: float) -> str:
    """Why nothing pairs, with how far the nearest two images are apart."""
    gap = int(np.abs(right.keys[pair(left.keys, right.keys, np.inf)] - left.keys).min())
    line = f"no image of {left.folder} has a partner in {right.folder}: the nearest two are "
    if not left.stamped:
        return f"{line}{gap} frames apart"
    line += f"{1e-6 * gap:.6g} ms apart, {1e-6 * tolerance:.6g} ms are allowed"
    enough = gap <= WIDEST_TOLERANCE * 1e9
    return f"{line}; see tolerance=… [s]" if enough else f"{line}: the clocks of the cameras differ"
