"""How objects show themselves: one line of text."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray


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


def widest(positions: NDArray) -> tuple[int, int]:
    """The two coordinates of positions (N, 3) with the largest range, for a plane picture."""
    if not len(positions):
        return 0, 2
    first, second = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2].tolist())
    return first, second


def sequence_line(sequence: Any) -> str:
    """A sequence in one line: its name, its length, and further facts."""
    stamps, rig, truth = sequence.stamps, sequence.rig, sequence.ground_truth
    seconds = float(stamps[-1] - stamps[0]) if len(stamps) else 0.0
    known = "no ground truth" if truth is None else "with ground truth"
    what = f"{sequence.format}, {sequence.kind}, {count(len(sequence), 'frame')}, {seconds:.2f} s"
    return f"{type(sequence).__name__}({sequence.name!r}, {what}, {rig.width}x{rig.height}, {known})"
