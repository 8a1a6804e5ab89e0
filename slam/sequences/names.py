"""What the names of image files say: which camera, which moment, which frame."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

from slam.geometry.stamps import IntArray
from slam.sequences.tables import MOST_NANOSECONDS

#: Words for the left and the right camera, in names of folders, videos, images and topics.
SIDES = (
    ("left", "right"), ("lcam", "rcam"), ("cam0", "cam1"), ("camera0", "camera1"), ("infra1", "infra2"),
    ("infrared1", "infrared2"), ("ir1", "ir2"), ("cam1", "cam2"),
)  # fmt: skip

_MOST_FRAMES = 10**12  # numbers of frames go up to this: as floating-point numbers they are still told apart
_SHORTEST = 10**6  # [ns] between frames: no camera is faster, and no count of frames has such steps
_LONGEST = 10**11  # [ns] between frames: a hundred seconds
_SHORTEST_MICRO = 10**4  # [µs] between frames: a hundred a second; no count of frames has such steps, either

# Since 1973: seconds with a fraction, nano-, micro-, milliseconds, these with a fraction, too, or whole seconds; or
# seconds since a start.
_STAMP = re.compile(
    r"(?<!\d)(?<!\d[.,])(?:[1-9]\d{8,9}(?:[.,]|[_-](?=(?:\d{6}|\d{9})(?!\d)))\d{1,9}|[1-9]\d{17,18}|[1-9]\d{15}"
    r"|[1-9]\d{12}(?:[.,]\d{1,6})?|[12]\d{9}|\d{1,10}[.,]\d{1,9})(?!\d|[.,]\d)",
    re.ASCII,
)
_SECONDS = re.compile(r"-?\d{1,10}[.,]\d{1,9}", re.ASCII)  # a whole name
_DECIMALS = {19: 0, 18: 0, 16: 3, 13: 6}  # from a stamp's unit to nanoseconds, by its digits; of seconds there are nine
_DATE = re.compile(r"(?<!\d)20\d\d[-_.]?[01]\d[-_.]?[0-3]\d(?!\d)", re.ASCII)  # what follows is a time of day
# A date and time, down to milli-, micro- or nanoseconds.
_MOMENT = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[-_T ]?([0-2]\d)[-_:.h]?([0-5]\d)[-_:.m]?([0-5]\d)"
    r"(?:[-_.s]?(\d{9}|\d{6}|\d{3}))?(?![.,]?\d)",
    re.ASCII,
)
_NUMBER = re.compile(r"\d+", re.ASCII)


@dataclass(frozen=True)
class Keys:
    """What pairs the images of two cameras, or orders those of one."""

    sides: list[IntArray]  # of each camera (N,): stamps [ns] or numbers of frames
    stamped: bool  # they are stamps
    guess: str = ""  # what was guessed; empty where nothing was


def stem(name: str) -> str:
    """A file's name without its ending."""
    return name.rpartition(".")[0]


def natural(name: str) -> list[tuple[str, int]]:
    """What sorts names as people count: their numbers as numbers."""
    return [(text, int(digits or -1)) for text, digits in re.findall(r"([^0-9]*)([0-9]*)", name)]


def _skeleton(name: str) -> str:
    return re.sub(r"-?\d+([.,]\d+)?", "0", stem(name))


def odd_ones(names: Sequence[str]) -> set[str]:
    """Names unlike those of the others but for numbers, where these are few: thumbnails and the like."""
    forms = {name: _skeleton(name) for name in names}
    usual, count = Counter(forms.values()).most_common(1)[0] if names else ("", 0)
    return {name for name, form in forms.items() if form != usual} if 4 * count >= 3 * len(names) else set()


def of_sides(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """The left and the right ones of some names by words such as left and right in them; None for neither."""
    for words in (*SIDES, ("l", "r")):
        around = "A-Za-z" if words == ("l", "r") else "a-z"
        ends = (
            rf"(?<![{around}])(?i:{re.sub('(?=[0-9])', '[-_ ]?', word)})(?![{'0-9' if word[-1].isdigit() else around}])"
            for word in words
        )
        left, right = ([n for n in names if re.search(end, n)] for end in ends)
        if left and right and not set(left) & set(right):
            return left, right
    return None


def keys_of(sides: Sequence[Sequence[str]]) -> Keys | None:
    """What the names of each camera's images say; None where neither stamps nor numbers tell the images apart.

    A stamp is 19 digits (nanoseconds), 16 (microseconds), 13 (milliseconds), 10 (seconds), the last two also with a
    fraction, or a date and time, of whole seconds over several minutes, anywhere in the names; or numbers so far apart
    that they cannot count frames. A frame's number is the one that differs from name to name; of several, those that
    both cameras share, and that count best.
    """
    stems = [[stem(name) for name in names] for names in sides]
    for read in (_moments, _stamps):
        keys = [found for own in stems if (found := read(own)) is not None]
        if len(keys) < len(sides):
            continue
        every = [name for own in stems for name in own]
        plain = all(_SECONDS.fullmatch(name) or (name.isdecimal() and _STAMP.fullmatch(name)) for name in every)
        moment = f"{1e-9 * keys[0][0]:.6f} s" + " since 1970" * bool(keys[0][0] >= 10**17)
        return Keys(keys, True, f"the stamp in {sides[0][0]} is taken as {moment}" if not plain else "")
    return _numbers(sides)


def _stamps(names: Sequence[str]) -> IntArray | None:
    """A stamp [ns] that every name has and that tells the names apart."""
    alone = all(_SECONDS.fullmatch(name) for name in names)
    for texts in zip(*([name] if alone else _STAMP.findall(name) for name in names)):
        parts = [_split(text) for text in texts]
        lengths = {len(fraction) for _, fraction in parts}
        since_start = all(fraction and not re.fullmatch(r"[1-9]\d{8,}", whole) for whole, fraction in parts)
        if (since_start or alone) and any(map(_DATE.search, names)):
            continue
        # Fractions of unequal length have lost zeros at their ends, or those in front: then steps are uneven.
        if since_start and not alone and len(lengths) == 1:
            moments = [_nanoseconds(text, 0) for text in texts]
            if [names[row] for row in np.argsort(moments, kind="stable")] != sorted(names, key=natural):
                continue  # seconds of a time of day, an exposure
        widths = (0, 6 if max(lengths) <= 6 else 9) if len(lengths) > 1 else (0,)
        keys = min(([_nanoseconds(text, width) for text in texts] for width in widths), key=_unevenness)
        step = median(_steps(keys) or [_LONGEST])  # beyond: a clock from its start, in a finer unit; below: a count
        if _SHORTEST < step <= _LONGEST and max(keys) <= MOST_NANOSECONDS and len(set(keys)) == len(keys):
            return np.array(keys, np.int64)
    return None


def _moments(names: Sequence[str]) -> IntArray | None:
    """Dates and times [ns since 1970] that every name has and that tell the names apart."""
    for found in zip(*(_MOMENT.finditer(name) for name in names)):  # the session's may stand before the image's
        if not all(match[7] for match in found) and len({match.groups()[:5] for match in found}) == 1:
            continue  # whole seconds, or a count: within a minute they are in one order
        whole = ["{}-{}-{}T{}:{}:{}".format(*match.groups()) for match in found]
        try:
            keys = np.array(whole, "datetime64[ns]").astype(np.int64)
        except ValueError:  # no date
            continue
        keys += np.array([int((match[7] or "0").ljust(9, "0")) for match in found], np.int64)
        if len(set(keys)) == len(names) and median(_steps(keys.tolist()) or [np.inf]) > _SHORTEST:  # else they count
            return np.asarray(keys)
    return None


def _split(text: str) -> tuple[str, str]:
    """The digits of a stamp before and behind the point."""
    whole, _, fraction = re.sub("[,_-]", ".", text.lstrip("-")).partition(".")
    return whole, fraction


def _nanoseconds(text: str, width: int) -> int:
    """What a stamp says; the fraction of one in seconds is filled up in front to `width`."""
    whole, fraction = _split(text)
    decimals = _DECIMALS.get(len(whole), 9)
    digits = whole + fraction.rjust(width if decimals == 9 else 0, "0").ljust(decimals, "0")
    return -int(digits) if text.startswith("-") else int(digits)


def _numbers(sides: Sequence[Sequence[str]]) -> Keys | None:
    tables = [_columns(names) for names in sides]
    if not all(tables):
        return None
    told = [[c for c in table if len(set(c)) == len(c) and max(c) <= MOST_NANOSECONDS] for table in tables]
    if not all(told):  # only several numbers together tell the names apart
        return _ranks([list(zip(*table)) for table in tables])
    best, chosen = (-1, 0), [columns[-1] for columns in told]
    for column in told[0]:
        others = [max(columns, key=lambda c, column=column: len(set(c) & set(column))) for columns in told[1:]]  # type: ignore[misc]
        common = min((len(set(column) & set(c)) for c in others), default=0)
        found = common, -max(_steps(column), default=0)
        if found >= best:
            best, chosen = found, [column, *others]
    guess = ""
    for names, columns, column in zip(sides, told, chosen):
        order = np.argsort(column, kind="stable").tolist()
        if any(np.argsort(c, kind="stable").tolist() != order for c in columns):
            first = order[0]
            guess = f"numbers in the names disagree; of {names[first]} the {column[first]} is taken as frame number"
    keys = [np.array(column, np.int64) for column in chosen]
    step = min(median(_steps(k.tolist()) or [0]) for k in keys)
    if step >= _SHORTEST:
        return Keys(keys, True, guess)
    if max(k.max() for k in keys) > _MOST_FRAMES:
        return None
    if step >= _SHORTEST_MICRO:
        return Keys([1000 * k for k in keys], True, f"numbers in the names, {step:g} apart, are taken as microseconds")
    if step > 1 and not guess:
        guess = f"numbers in the names are {step:g} apart and taken as frame numbers; if they are times, see times=…"
    return Keys(keys, False, guess)


def _columns(names: Sequence[str]) -> list[tuple[int, ...]]:
    """The numbers at each place of the names that are not the same in all; none of names unlike each other."""
    if len({_skeleton(name) for name in names}) != 1:
        return []
    rows = [[int(digits) for digits in _NUMBER.findall(stem(name))] for name in names]
    columns = list(zip(*rows)) if len({len(row) for row in rows}) == 1 else []
    return columns if len(names) == 1 else [c for c in columns if len(set(c)) > 1]


def _ranks(rows: Sequence[Sequence[tuple[int, ...]]]) -> Keys | None:
    """Places of names in the order of all their numbers."""
    if any(len(set(own)) < len(own) for own in rows) or not set(rows[0]).intersection(*rows[1:]):
        return None
    rank = {row: number for number, row in enumerate(sorted(set().union(*rows)))}
    guess = "no single number in the names tells the images apart; frames are counted in the order of all of them"
    return Keys([np.array([rank[row] for row in own], np.int64) for own in rows], False, guess)


def _steps(numbers: Sequence[int]) -> list[int]:
    return [b - a for a, b in pairwise(sorted(numbers))]


def _unevenness(numbers: Sequence[int]) -> float:
    """The largest step of sorted numbers over the usual one: near 1 for the times of a camera."""
    steps = _steps(numbers)
    return max(steps) / max(median(steps), 1e-9) if steps else 0.0
