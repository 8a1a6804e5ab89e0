"""What the names of image files say: which camera, which moment, which frame."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from statistics import median

import numpy as np

from slam.geometry.stamps import IntArray
from slam.sequences.tables import MOST_NANOSECONDS

#: Numbers of frames go up to this: as floating-point numbers they are still told apart.
MOST_FRAMES = 10**12

_SHORTEST = 10**6  # [ns] between frames: no camera is faster, and no count of frames has such steps
_LONGEST = 10**11  # [ns] between frames: a hundred seconds
_SHORTEST_MICRO = 10**4  # [µs] between frames: a hundred a second; no count of frames has such steps, either
_FIRST = 10**8  # [s] since 1970 of a stamp with a fraction in a longer name: the year 1973

#: Words for the left and the right camera, in names of folders, videos and topics.
SIDES = (("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("infra1", "infra2"))

_DATE = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[-_T ]?([0-2]\d)[-_:.h]?([0-5]\d)[-_:.m]?([0-5]\d)"
    r"(?:[-_.s]?(\d{1,9}))?(?!\d)",
    re.ASCII,
)
_STAMP = re.compile(r"(?<!\d)(?:(\d{9,10})[._](\d{1,9})|(\d{18,19})|(\d{16})|(\d{13})|([12]\d{9}))(?!\d)", re.ASCII)
_SECONDS = re.compile(r"\d{1,10}\.\d{1,9}", re.ASCII)  # a whole name, perhaps since a start
_NUMBER = re.compile(r"\d+", re.ASCII)


def stem(name: str) -> str:
    """A file's name without its ending."""
    return name.rpartition(".")[0]


def natural(name: str) -> list[tuple[str, int]]:
    """What sorts names as people count: their numbers as numbers."""
    return [(text, int(digits or -1)) for text, digits in re.findall(r"([^0-9]*)([0-9]*)", name)]


def same_order(sides: Sequence[Sequence[str]]) -> bool:
    """Whether images in order have the same names in both folders, but for words such as left and right."""
    plain = [[re.sub(r"left|right|cam[01]|(?<![a-z])[lr](?![a-z])", "", n.lower()) for n in names] for names in sides]
    return all(own == plain[0] for own in plain)


def of_sides(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """The left and the right images of one folder by words such as left and right in their names; None for neither."""
    for words in (*SIDES, ("l", "r")):
        ends = (rf"(?<![a-z]){word}(?![{'0-9' if word[-1].isdigit() else 'a-z'}])" for word in words)
        left, right = ([n for n in names if re.search(end, stem(n), re.IGNORECASE)] for end in ends)
        if left and right and not set(left) & set(right):
            return left, right
    return None


def keys_of(sides: Sequence[Sequence[str]]) -> tuple[list[IntArray], bool, str] | None:
    """What pairs the images of cameras: stamps [ns], or else numbers of frames.

    A stamp is 19 digits (nanoseconds), 16 (microseconds), 13 (milliseconds), 10 (seconds), seconds with a fraction, or
    a date with the time, anywhere in the names; or numbers so far apart that they cannot count frames. A frame's number
    is the one that differs from name to name; of several, those that both cameras share, and that count best.

    Returns:
        For each camera its keys (N,), whether these are stamps, and what was guessed, empty where nothing was. None
        where neither stamps nor numbers tell the images apart.
    """
    for read in (_dates, _stamps):
        found = [read(names) for names in sides]
        if all(keys is not None for keys in found):
            inside = [n for names in sides for n in names if not _is_stamp(stem(n))]
            moment = f"{1e-9 * found[0][0]:.6f} s" if inside else ""  # type: ignore[index]
            guess = f"the stamp in {sides[0][0]} is taken as {moment} since 1970" if inside else ""
            return [keys for keys in found if keys is not None], True, guess
    return _numbers(sides)


def _is_stamp(text: str) -> bool:
    """Whether a whole name is a stamp: nothing is guessed then."""
    return (_STAMP.fullmatch(text) or _SECONDS.fullmatch(text)) is not None


def _stamps(names: Sequence[str]) -> IntArray | None:
    """A stamp [ns] that every name has and that tells the names apart."""
    whole = all(_is_stamp(stem(name)) for name in names)
    since_start = all(_SECONDS.fullmatch(stem(name)) for name in names)
    rows = [[(*stem(n).split("."), "", "", "", "")] if since_start else _STAMP.findall(stem(n)) for n in names]
    for parts in zip(*rows):
        # Fractions of unequal length have lost zeros at their ends, or those in front: then steps are uneven.
        lengths = {len(part[1]) for part in parts}
        widths = (0, 6 if max(lengths) <= 6 else 9) if len(lengths) > 1 else (0,)
        keys = min(([_nanoseconds(part, width) for part in parts] for width in widths), key=_unevenness)
        far = len(keys) > 1 and median(_steps(keys)) > _LONGEST
        possible = all(k <= MOST_NANOSECONDS and (whole or k >= _FIRST * 10**9) for k in keys)
        if possible and not far and len(set(keys)) == len(keys):  # far apart: a clock from its start, in a finer unit
            return np.array(keys, np.int64)
    return None


def _nanoseconds(part: tuple[str, ...], width: int) -> int:
    """Of the digits of a stamp; its fraction filled up in front to `width`, if not zero."""
    seconds, fraction, nano, micro, milli, whole = part
    if seconds or whole:
        return int(seconds or whole) * 10**9 + int(fraction.rjust(width, "0").ljust(9, "0"))
    return int(nano) if nano else int(micro) * 10**3 if micro else int(milli) * 10**6


def _dates(names: Sequence[str]) -> IntArray | None:
    """Dates with the time [ns since 1970] that every name has and that tell the names apart."""
    found = {name: match for name in sorted(names, key=natural) if (match := _DATE.search(stem(name)))}
    if len(found) < len(set(names)):
        return None
    rest = [int(match[7] or 0) for match in found.values()]
    if len(rest) > 1 and set(np.diff(rest).tolist()) == {1}:
        return None  # it counts frames, also beyond the end of a second: no fraction
    moments, fractions = [], []
    for year, month, day, hour, minute, second, fraction in (found[name].groups() for name in names):
        moments.append(f"{year}-{month}-{day}T{hour}:{minute}:{second}")
        fractions.append(int((fraction or "0").ljust(9, "0")))
    try:
        keys = np.array(moments, "datetime64[ns]").astype(np.int64) + np.array(fractions)
    except ValueError:  # no date
        return None
    return keys if len(np.unique(keys)) == len(names) else None


def _numbers(sides: Sequence[Sequence[str]]) -> tuple[list[IntArray], bool, str] | None:
    """Numbers of frames in the names, see `keys_of`."""
    tables = [_columns(names) or [] for names in sides]
    if not all(tables):
        return None
    told = [[c for c in table if len(set(c)) == len(c) and max(c) <= MOST_NANOSECONDS] for table in tables]
    if not all(told):
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
        first, *order = np.argsort(column, kind="stable").tolist()
        if any(np.argsort(c, kind="stable").tolist() != [first, *order] for c in columns):
            guess = f"numbers in the names disagree; of {names[first]} the {column[first]} is taken as frame number"
    keys = [np.array(column, np.int64) for column in chosen]
    step = min(median(_steps(k.tolist()) or [0]) for k in keys)
    if step >= _SHORTEST or max(k.max() for k in keys) > MOST_FRAMES:
        return (keys, True, guess) if step >= _SHORTEST else None
    if step >= _SHORTEST_MICRO:
        return [1000 * k for k in keys], True, f"numbers in the names, {step:g} apart, are taken as microseconds"
    if step > 1 and not guess:
        guess = f"numbers in the names are {step:g} apart and taken as frame numbers; if they are times, see times=…"
    return keys, False, guess


def _columns(names: Sequence[str]) -> list[list[int]] | None:
    """The numbers at each place of the names that are not the same in all of them; None for names unlike each other."""
    rows = [[int(digits) for digits in _NUMBER.findall(stem(name))] for name in names]
    if len({len(row) for row in rows}) != 1:
        return None
    columns = [list(column) for column in zip(*rows)]
    return columns if len(names) == 1 else [c for c in columns if len(set(c)) > 1]


def _ranks(rows: Sequence[Sequence[tuple[int, ...]]]) -> tuple[list[IntArray], bool, str] | None:
    """Places of names that only several numbers together tell apart, in the order of all of them."""
    if any(len(set(own)) < len(own) for own in rows) or not set(rows[0]).intersection(*rows[1:]):
        return None
    rank = {row: number for number, row in enumerate(sorted(set().union(*rows)))}
    guess = "no single number in the names tells the images apart; frames are counted in the order of all of them"
    return [np.array([rank[row] for row in own], np.int64) for own in rows], False, guess


def _steps(numbers: Sequence[int]) -> list[int]:
    return [b - a for a, b in pairwise(sorted(numbers))]


def _unevenness(numbers: Sequence[int]) -> float:
    """The largest step of sorted numbers over the usual one: near 1 for the times of a camera."""
    steps = _steps(numbers)
    return max(steps) / max(median(steps), 1e-9) if steps else 0.0


def odd_ones(names: Sequence[str]) -> list[str]:
    """Names unlike those of the others but for numbers, where these are few: thumbnails and the like."""
    forms = [re.sub(r"\d+(\.\d+)?", "0", stem(name)) for name in names]
    usual, count = Counter(forms).most_common(1)[0] if forms else ("", 0)
    return [name for name, form in zip(names, forms) if form != usual] if 4 * count >= 3 * len(forms) else []
