"""Who belongs to whom: the images of two cameras listed, paired by stamp or number, given times, and decoded."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import SequenceError
from slam.files import expanded, note_input
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray, increasing, pair, trim
from slam.naming import count
from slam.sequences.base import Images
from slam.sequences.faults import FaultLog
from slam.sequences.images import IMAGE_SUFFIXES, Size, halves, read_image, require_same_size
from slam.sequences.names import Keys, keys_of, natural, odd_ones, stem
from slam.sequences.options import WIDEST_TOLERANCE, Options
from slam.sequences.tables import read_times

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

    def select(self, rows: IntArray) -> Listing:
        """The listing of these rows."""
        return replace(self, keys=self.keys[rows], names=[self.names[i] for i in rows])


@dataclass(frozen=True, eq=False)
class Pairs:
    """Which images make a frame, and when."""

    keys: IntArray  # the left images' (N,)
    rows: IntArray  # of the left and the right listing (N, 2), -1 where there is no right image
    stamps: Array  # times (N,) [s], strictly increasing

    def select(self, rows: IntArray, stamps: Array) -> Pairs:
        """These frames at these times."""
        return Pairs(self.keys[rows], self.rows[rows], stamps)


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """A frame source: two folders of image files, already paired."""

    stamps: Array  # times (N,) [s], strictly increasing
    left: list[Path]  # (N)
    right: list[Path | None]  # None where there is no right image
    size: Size  # width and height that every image must have
    single: bool  # both images are in the left file, side by side; there are no others

    def images(self, start: int, stop: int, faults: FaultLog) -> Images:
        """Decode the images of frames `start` to `stop`; an error in place of one that is unreadable."""
        for left, right in zip(self.left[start:stop], self.right[start:stop]):
            image = _image(left, self.size)
            yield (image,) if self.single else (image, None if right is None else _image(right, self.size))


def _image(path: Path, size: Size) -> np.ndarray | SequenceError:
    try:
        return read_image(path, size)
    except SequenceError as error:
        return error


def image_pairs(pairs: Pairs, left: Listing, right: Listing | None) -> tuple[ImagePairs, Size]:
    """The source of pairs of image files, and the size of a camera's images.

    Without a right listing both images are in the left files, side by side.

    SequenceError where no pair can be read, or the two images of the first one that can differ in size.
    """
    lefts = [left.folder / left.names[row] for row in pairs.rows[:, 0]]
    rights = [right.folder / right.names[row] if right and row >= 0 else None for row in pairs.rows[:, 1]]
    fault = "no frame has two images"
    for left_path, right_path in zip(lefts, rights):
        if right is None or right_path is not None:
            try:
                image = read_image(left_path)
                a, b = halves(image, left_path) if right_path is None else (image, read_image(right_path))
            except SequenceError as error:
                fault = str(error)
                continue
            require_same_size(a, b, left_path, right_path)
            whole = image.shape[1], image.shape[0]
            return ImagePairs(pairs.stamps, lefts, rights, whole, right is None), (a.shape[1], a.shape[0])
    raise SequenceError(f"{left.folder}: no pair of images can be read: {fault}")


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


def listed(folders: list[Path], names: list[list[str]], faults: FaultLog) -> list[Listing]:
    """The images of one camera or two by what their names say: stamps, else numbers, else their order.

    SequenceError where a camera has no images, or where only their order is left and the cameras have unequally many.
    """
    for at, (folder, own) in enumerate(zip(folders, names)):
        if not own:
            raise SequenceError(f"{folder}: no images")
        endings = Counter(name.rpartition(".")[2] for name in own)
        once = {stem(name): name for name in sorted(own, key=lambda name: endings[name.rpartition(".")[2]])}
        odd = odd_ones(list(once.values()))
        for kind, left_out in (("images are there in another format, too", set(own) - set(once.values())),
                               ("images are named unlike the others", odd)):  # fmt: skip
            if left_out:
                first = min(left_out, key=natural)
                faults.report("images", f"{folder}: {len(left_out)} of {len(own)} {kind} (first: {first}); left out")
        taken = set(once.values()) - odd
        names[at] = [name for name in own if name in taken]
    found = keys_of(names)
    if found is None:
        if len({len(own) for own in names}) > 1:
            counts = " and ".join(f"{folder} has {len(own)} images" for folder, own in zip(folders, names))
            raise SequenceError(f"{counts}: neither stamps nor numbers in their names say which go together")
        guess = "neither stamps nor numbers in the names say which images go together: their order does"
        found = Keys([np.arange(len(own)) for own in names], False, guess)  # they are sorted
    if found.guess:
        faults.report("names", f"{folders[0]}: {found.guess}")
    listings = []
    for folder, keys, own in zip(folders, found.sides, names):
        rows = np.argsort(keys, kind="stable")
        listing = Listing(folder, keys, own, found.stamped).select(rows)
        steps = np.diff(listing.keys)
        gaps = int(steps.sum()) - len(steps)
        if not found.stamped and gaps > 0 and np.median(steps) == 1:
            after = listing.names[int(np.argmax(steps > 1))]
            line = f"{folder}: {count(gaps, 'image')} missing between the first and the last (after {after})"
            faults.report("images", line)
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


class Times(NamedTuple):
    """A file of times."""

    path: Path
    rows: Array  # times by row [s], NaN for unreadable ones
    names: list[str]  # of the images by row, where the file has them


def told_times(folder: Path, options: Options, faults: FaultLog, *usual: Path) -> Times | None:
    """The file of times, by option or by convention; None where there is none, or ``fps`` is given in its place."""
    if "times" in options:
        path: Path | None = folder / expanded(options["times"])
    else:
        path = None if "fps" in options else next((path for path in usual if path.is_file()), None)
    return None if path is None else Times(path, *read_times(path, faults))


def pair_up(
    left: Listing, right: Listing | None, options: Options, faults: FaultLog,
    times: Times | None = None, by_number: bool = False,
) -> Pairs:  # fmt: skip
    """The images of two cameras that belong together by their keys, the option ``tolerance`` apart at most.

    Left images before the first pair and after the last are left out, and so are right images without a partner; with
    the option ``swap`` also left ones, which are the right camera's. What is left out or stands alone is reported.
    Without a right listing both images are in one file, side by side.

    Time is by the file of `times`, else by ``fps``, else by stamps, else by numbers at `RATE`. Rows of the file belong
    to the left images that they name, else to those in order; with `by_number`, or where there are more rows than
    images, a row's number is a frame's. SequenceError where nothing pairs, or hardly a frame has a time.
    """
    rate = None if times else options.get("fps")
    partner = np.full(len(left), -1)
    kept = np.arange(len(left))
    if right is not None:
        tolerance = _tolerance(left, options, bool(times or rate))
        partner = pair(left.keys, right.keys, tolerance)
        kept = kept[trim(partner)]
        if not len(kept):
            raise SequenceError(_no_pair(left, right, tolerance))
        swap = options.get("swap", False)
        _report_alone(left, right, partner, kept, swap, faults)
        kept = kept[partner[kept] >= 0] if swap else kept
    pairs = Pairs(left.keys[kept], np.stack([kept, partner[kept]], axis=1), 1e-9 * left.keys[kept])
    if times is not None:
        return pairs.select(*_stamped(_rows_of(left, times, by_number, faults)[kept], times.rows, times.path, faults))
    if left.stamped and rate is None:
        good = increasing(pairs.stamps)
        if len(good) < len(pairs.stamps):
            line = f"{left.folder}: {len(pairs.stamps) - len(good)} stamps are nearer than a microsecond to the"
            faults.report("stamps", f"{line} one before; images left out")
        return pairs.select(good, pairs.stamps[good])
    if rate is None:
        faults.report("times", f"{left.folder}: no times, {RATE:g} frames per second assumed (see fps=…)")
    numbers = kept if left.stamped else pairs.keys - (0 if by_number else pairs.keys[0])
    return replace(pairs, stamps=numbers / (rate or RATE))


def _rows_of(left: Listing, times: Times, by_number: bool, faults: FaultLog) -> IntArray:
    """The row of each left image in a file of times, see `pair_up`; one beyond its end for none."""
    count = len(times.rows)
    named = {stem(name): row for row, name in enumerate(times.names)}
    rows = np.array([named.get(stem(name), count) for name in left.names])
    if (rows < count).any():
        return rows
    if not left.stamped and (by_number or len(left) < count):
        first = int(not by_number and left.keys[-1] == count)  # numbers from 1 on
        if by_number or left.keys[0] - first >= 0 <= count - 1 - (left.keys[-1] - first):
            return left.keys - first
    if not by_number and count != len(left):
        faults.report("stamps", f"{times.path} has {count} rows, {left.folder} has {len(left)} images")
    return np.arange(len(left))


def _tolerance(left: Listing, options: Options, told: bool) -> float:
    """How far the keys of a pair may be apart: of numbers not at all, of stamps [ns] as the option says.

    Where time is `told` by a file or a rate, half a frame, not `_TOLERANCE`, is the default.
    """
    if not left.stamped:
        return 0
    half = float(np.median(np.diff(left.keys))) / 2 if len(left) > 1 else _TOLERANCE
    default = 0.98 * half if told and len(left) > 1 else min(_TOLERANCE, half)
    return round(1e9 * options.get("tolerance", 1e-9 * default))


def _report_alone(
    left: Listing, right: Listing, partner: IntArray, kept: IntArray, swap: bool, faults: FaultLog
) -> None:
    """Report the images that have no partner."""
    head, tail = int(kept[0]), len(left) - 1 - int(kept[-1])
    alone = kept[partner[kept] < 0]
    unused = len(right) - int((partner >= 0).sum())
    for ends, where in ((head, "before the first pair"), (tail, "after the last pair")):
        if ends:
            faults.report("pairs", f"{left.folder}: {count(ends, 'image')} {where} left out")
    if len(alone):
        line = f"{left.folder}: {count(len(alone), 'image')} without a partner in {right.folder}"
        what = "left out" if swap else "given without a right image"
        faults.report("pairs", f"{line} (first: {left.names[alone[0]]}); {what}")
    if unused:
        faults.report("pairs", f"{right.folder}: {count(unused, 'image')} without a partner in {left.folder}; left out")


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
    for rows, what in (
        (len(times) - int(numbers[-1]) - 1, "the last {} rows have no image"),
        (untimed, "{} images have no time; left out"),
        (unordered, "{} times stand twice or run backwards; images left out"),
    ):
        if rows > 0:
            faults.report("stamps", f"{path}: {what.format(rows)}")
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
