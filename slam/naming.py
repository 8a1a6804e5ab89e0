"""Words for messages: names that may have been meant, numbers of things, and objects in one line of text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LIKE = 0.6  # least similarity of a suggestion, from 0 to 1


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The most similar known name, upper and lower case alike; None where none is similar."""
    by_case = {other.lower(): other for other in known}
    near = get_close_matches(str(name).lower(), by_case, 1, _LIKE)
    return by_case[near[0]] if near else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """The most similar known name as `` (did you mean 'x'?)``; empty where none is similar.

    >>> suggestion("smother", ["batch", "ekf", "smoother"])
    " (did you mean 'smoother'?)"
    >>> suggestion("kalman", ["batch", "ekf", "smoother"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near!r}?)" if near else ""


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The line for a name that is not known: the nearest known name, and all of them.

    >>> unknown("back end", "efk", ["ekf", "smoother"])
    "unknown back end 'efk' (did you mean 'ekf'?); known: ekf, smoother"
    """
    names = list(known)
    return f"unknown {what} {name!r}{suggestion(name, names)}; known: {', '.join(names)}"


def of_shapes(thing: Any) -> str:
    """A dataclass in one line: its arrays by their shapes, everything else as it shows itself."""
    shown = []
    for f in fields(thing):
        value = getattr(thing, f.name)
        shown.append(f"{f.name}={'x'.join(map(str, value.shape)) if isinstance(value, np.ndarray) else repr(value)}")
    return f"{type(thing).__name__}({', '.join(shown)})"


def count(number: int, what: str) -> str:
    """A number of things, such as ``"1 frame"`` or ``"3 frames"``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def point(values: NDArray) -> str:
    """Coordinates in millimetre steps."""
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def sequence_line(sequence: Any) -> str:
    """A sequence in one line: its name, its length, and further facts."""
    stamps, rig, truth = sequence.stamps, sequence.rig, sequence.ground_truth
    seconds = float(stamps[-1] - stamps[0]) if len(stamps) else 0.0
    known = "no ground truth" if truth is None else "with ground truth"
    what = f"{sequence.format}, {sequence.kind}, {count(len(sequence), 'frame')}, {seconds:.2f} s"
    return f"{type(sequence).__name__}({sequence.name!r}, {what}, {rig.width}x{rig.height}, {known})"
