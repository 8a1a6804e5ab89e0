"""Who belongs to whom: the images of two cameras listed, paired by stamp or number, given times, and decoded."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import SequenceError
from slam.files import expanded, note_input, reason
from slam.geometry.se3 import Array
from slam.geometry.stamps import IntArray, increasing, pair
from slam.naming import count
from slam.sequences.base import Decoder, FaultLog, Images, attempt
from slam.sequences.images import IMAGE_SUFFIXES, Size, both, read_image, require_same_size
from slam.sequences.names import Keys, keys_of, natural, odd_ones, stem
from slam.sequences.options import WIDEST_TOLERANCE, Options
from slam.sequences.tables import Times, read_times

#: Frames per second of images that say nothing of time.
RATE = 10.0

_TOLERANCE = 5_000_000  # [ns] between the stamps of a pair: hardware-triggered cameras agree far better


@dataclass(frozen=True, eq=False)
class Listing:
    """The images of one camera, in order of their keys: sort the rows first, `open_images` refuses others."""

    folder: Path
    keys: IntArray  # what pairs them with the other camera's (N,), increasing: stamps [ns] or frame numbers
    names: list[str]  # their file names, N of them
    stamped: bool  # the keys are stamps

    def __len__(self) -> int:
        return len(self.names)

    def select(self, rows: IntArray) -> Listing:
        """The listing of these rows."""
        return replace(self, keys=self.keys[rows], names=[self.names[i] for i in rows])


class Pairs(NamedTuple):
    """Which images make a frame, and when."""

    keys: IntArray  # the left images' (N,)
    rows: IntArray  # of each listing (N, 1 or 2), -1 where there is no right image
    stamps: Array  # times (N,) [s], strictly increasing


def open_images(
    sides: list[Listing], options: Options, faults: FaultLog, times: Times | None = None, by_number: bool = False
) -> tuple[Pairs, Decoder, Size]:
    """Pair image files, see `pair_up`: which make a frame, what decodes them, and the size of a camera's images.

    SequenceError, too, where no pair can be read.
    """
    pairs = pair_up(sides, options, faults, times, by_number)
    frames = [
        [None if row < 0 else side.folder / side.names[row] for side, row in zip(sides, rows)]
        for rows in pairs.rows.tolist()
    ]
    fault = "no frame has two images"
    for paths in frames:
        images = [attempt(read_image, path) for path in paths if path is not None]
        if unreadable := [image for image in images if isinstance(image, SequenceError)]:
            fault = str(unreadable[0])
        elif len(images) == len(sides):
            shape, (left, right) = images[0].shape, both(images, paths[0])  # type: ignore[union-attr]
            size = require_same_size(left, right, *paths)
            return pairs, partial(_decoded, frames, (shape[1], shape[0])), size
    raise SequenceError(f"{sides[0].folder}: no pair of images can be read: {fault}")


def _decoded(frames: list[list[Path | None]], size: Size, start: int, stop: int, faults: FaultLog) -> Images:
    for paths in frames[start:stop]:
        yield tuple(None if path is None else attempt(read_image, path, size) for path in paths)


def image_names(folder: Path) -> list[str]:
    """Names of the image files in a folder, sorted as people count; SequenceError where it is none."""
    try:
        with os.scandir(folder) as entries:
            names = [e.name for e in entries if not e.name.startswith(".")]
    except OSError as error:
        what = "a file where a folder of images should be" if isinstance(error, NotADirectoryError) else reason(error)
        raise SequenceError(f"{folder}: {what}") from error
    note_input(folder)
    return sorted((n for n in names if os.path.splitext(n)[1].lower() in IMAGE_SUFFIXES), key=natural)  # noqa: PTH122


def listed(folders: list[Path], names: list[list[str]], faults: FaultLog) -> list[Listing]:
    """The images of one camera or two by what their names say: stamps, else numbers, else their order."""
    names = [_alike(folder, own, faults) for folder, own in zip(folders, names)]
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
        listing = Listing(folder, keys, own, found.stamped).select(np.argsort(keys, kind="stable"))
        steps = np.diff(listing.keys)
        gaps = int(steps.sum()) - len(steps)
        if not found.stamped and gaps > 0 and np.median(steps) == 1:
            after = listing.names[int(np.argmax(steps > 1))]
            line = f"{folder}: {count(gaps, 'image')} missing between the first and the last (after {after})"
            faults.report("images", line)
        listings.append(in_order(listing, str(folder), faults))
    return listings


def _alike(folder: Path, names: list[str], faults: FaultLog) -> list[str]:
    """The names without thumbnails and the like, and without copies in another format."""
    once = list({stem(name): name for name in names}.values())
    odd = odd_ones(once)
    taken = [name for name in once if name not in odd]
    if not taken:
        raise SequenceError(f"{folder}: no images")
    if left_out := sorted(set(names) - set(taken), key=natural):
        what = f"{len(left_out)} of {len(names)} images are named unlike the others, or there in another format, too"
        faults.report("images", f"{folder}: {what} (first: {left_out[0]}); left out")
    return taken


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


def told_times(folder: Path, options: Options, faults: FaultLog, *usual: Path) -> Times | None:
    """The file of times, by option or by convention; None where there is none, or ``fps`` is given in its place."""
    if "times" in options:
        usual = (folder / expanded(options["times"]),)
    elif "fps" in options:
        usual = ()
    path = next((path for path in usual if path.is_file() or "times" in options), None)
    return None if path is None else read_times(path, faults)


def pair_up(
    sides: list[Listing], options: Options, faults: FaultLog, times: Times | None = None, by_number: bool = False
) -> Pairs:
    """The images of two cameras that belong together by their keys, the option ``tolerance`` apart at most.

    Left images before the first pair and after the last are left out, and so are right images without a partner; with
    the option ``swap`` also left ones, which are the right camera's. What is left out or stands alone is reported. Of a
    single listing each image holds both cameras', side by side.

    Time is by the file of `times`, else by ``fps``, else by stamps, else by numbers at `RATE`. Rows of the file belong
    to the left images that they name, else to those in order; with `by_number`, or where there are more rows than
    images, a row's number is a frame's. SequenceError where a listing has no rows or its keys do not increase, nothing
    pairs, or hardly a frame has a time.
    """
    for side in sides:
        if not len(side):
            raise SequenceError(f"{side.folder}: no images")
        if len(back := np.flatnonzero(np.diff(side.keys) <= 0)):
            one, other = side.names[back[0]], side.names[back[0] + 1]
            what = "stamps" if side.stamped else "numbers"
            raise SequenceError(f"{side.folder}: the images are not in order of their {what}: {other} follows {one}")
    left, rows = sides[0], np.arange(len(sides[0]))[:, None]
    if len(sides) == 2:
        rows = _partners(left, sides[1], options, times is not None or "fps" in options, faults)
    source = left.folder if times is None else times.path
    stamps = _seconds(left, rows[:, 0], options, faults, times, by_number)
    timed = np.flatnonzero(np.isfinite(stamps))
    good = timed[increasing(stamps[timed])]
    untimed, unordered = len(rows) - len(timed), len(timed) - len(good)
    if 2 * len(good) < len(rows):
        what = f"{untimed} have no time and {unordered} one that does not increase"
        raise SequenceError(f"{source}: of {len(rows)} images {what}")
    if untimed:
        faults.report("stamps", f"{source}: {untimed} images have no time; left out")
    if unordered:
        faults.report("stamps", f"{source}: {unordered} times stand twice or run backwards; images left out")
    return Pairs(left.keys[rows[good, 0]], rows[good], stamps[good])


def _partners(left: Listing, right: Listing, options: Options, told: bool, faults: FaultLog) -> IntArray:
    """Rows (N, 2) of the images that make a frame, see `pair_up`; `told` where a file or a rate tells the time."""
    tolerance = 0
    if left.stamped:
        half = float(np.median(np.diff(left.keys))) / 2 if len(left) > 1 else _TOLERANCE
        default = 0.98 * half if told and len(left) > 1 else min(_TOLERANCE, half)
        tolerance = round(1e9 * options.get("tolerance", 1e-9 * default))
    partner = pair(left.keys, right.keys, tolerance)
    paired = np.flatnonzero(partner >= 0)
    if not len(paired):
        gap = int(np.abs(right.keys[pair(left.keys, right.keys, np.inf)] - left.keys).min())
        apart = f"{gap} frames apart"
        if left.stamped:
            hint = "see tolerance=… [s]" if gap <= WIDEST_TOLERANCE * 1e9 else "the clocks of the cameras differ"
            apart = f"{1e-6 * gap:.6g} ms apart, {1e-6 * tolerance:.6g} ms are allowed; {hint}"
        raise SequenceError(f"no image of {left.folder} has a partner in {right.folder}: the nearest two are {apart}")
    kept, swap = np.arange(paired[0], paired[-1] + 1), options.get("swap", False)
    alone = kept[partner[kept] < 0]
    first = f" (first: {left.names[alone[0]]})" if len(alone) else ""
    for side, other, number, where, then in (
        (left, right, kept[0], "before the first pair", " left out"),
        (left, right, len(left) - 1 - kept[-1], "after the last pair", " left out"),
        (left, right, len(alone), "", f"{first}; {'left out' if swap else 'given without a right image'}"),
        (right, left, len(right) - (partner >= 0).sum(), "", "; left out"),
    ):
        if number:
            where = where or f"without a partner in {other.folder}"
            faults.report("pairs", f"{side.folder}: {count(int(number), 'image')} {where}{then}")
    kept = np.setdiff1d(kept, alone) if swap else kept
    return np.stack([kept, partner[kept]], axis=1)


def _seconds(
    left: Listing, kept: IntArray, options: Options, faults: FaultLog, times: Times | None, by_number: bool
) -> Array:
    """Times of the `kept` left images [s], see `pair_up`; NaN for none."""
    if times is not None:
        rows = _rows_of(left, times, by_number, faults)[kept]
        if rows[-1] + 1 < len(times.rows):
            faults.report("stamps", f"{times.path}: the last {len(times.rows) - rows[-1] - 1} rows have no image")
        return np.append(times.rows, np.nan)[np.minimum(rows, len(times.rows))]
    rate = options.get("fps")
    if left.stamped and rate is None:
        return 1e-9 * left.keys[kept]
    if rate is None:
        faults.report("times", f"{left.folder}: no times, {RATE:g} frames per second assumed (see fps=…)")
    numbers = kept if left.stamped else left.keys[kept] - (0 if by_number else left.keys[kept[0]])
    return np.asarray(numbers / (rate or RATE))


def _rows_of(left: Listing, times: Times, by_number: bool, faults: FaultLog) -> IntArray:
    """The row of each left image in a file of times, see `pair_up`; one beyond its end for none."""
    count = len(times.rows)
    named = {stem(name): row for row, name in enumerate(times.names)}
    rows = np.array([named.get(stem(name), count) for name in left.names])
    if (rows < count).any():
        return rows
    numbers = left.keys - int(not by_number and left.keys[-1] == count)  # perhaps from 1 on
    if not left.stamped and (by_number or (len(left) < count and numbers[0] >= 0 and numbers[-1] < count)):
        return numbers
    if not by_number and count != len(left):
        faults.report("stamps", f"{times.path} has {count} rows, {left.folder} has {len(left)} images")
    return np.arange(len(left))
