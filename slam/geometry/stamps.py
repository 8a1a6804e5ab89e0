"""Stamps of two lists paired, rows put in order of time, and checked ranges of frames."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from slam.errors import SequenceError

IntArray = NDArray[np.int64]


def increasing(stamps: Sequence[int] | Sequence[float] | np.ndarray) -> IntArray:
    """Rows of a longest strictly increasing subsequence: the fewest rows are dropped that make time increase.

    Doubles and rows out of order go; one stamp far in the future costs that one row, not all that follow.
    """
    values = np.asarray(stamps)
    if len(values) < 2 or (values[1:] > values[:-1]).all():
        return np.arange(len(values))
    tails: list[float] = []  # smallest last value of an increasing run of each length
    rows: list[int] = []
    before = np.full(len(values), -1)
    for row, value in enumerate(values.tolist()):
        length = bisect_left(tails, value)
        if length == len(tails):
            tails.append(value)
            rows.append(row)
        else:
            tails[length], rows[length] = value, row
        before[row] = rows[length - 1] if length else -1
    chain = [rows[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def pair(left: np.ndarray, right: np.ndarray, tolerance: float) -> IntArray:
    """For each left key (N,) the row of the nearest right key, or -1 where none lies within `tolerance`.

    Keys are stamps or frame numbers and increase. A right row serves one left row only: the nearest to it.
    """
    if not len(right) or not len(left):
        return np.full(len(left), -1)
    after = np.searchsorted(right, left).clip(1, len(right) - 1) if len(right) > 1 else np.zeros(len(left), int)
    before = (after - 1).clip(0)
    partner = np.where(left - right[before] <= right[after] - left, before, after)
    distance = np.abs(right[partner] - left)
    partner[distance > tolerance] = -1
    order = np.argsort(distance, kind="stable")  # nearest first, so that a right row goes to the nearest left
    order = order[partner[order] >= 0]
    _, first = np.unique(partner[order], return_index=True)
    out = np.full(len(left), -1)
    out[order[first]] = partner[order[first]]
    return out


def require_frame(name: str, k: int, length: int) -> int:
    """The number of a frame of the sequence `name` of so many frames; SequenceError where there is no frame k."""
    if not isinstance(k, Integral) or not 0 <= k < length:
        raise SequenceError(f"{name}: there is no frame {k}; it has {length}, from 0 on")
    return int(k)


def frame_range(start: int, stop: int | None, length: int) -> tuple[int, int]:
    """A checked range of frames: `stop` None or beyond the end means the end; SequenceError where it holds none."""
    if not all(isinstance(number, Integral) for number in (start, length if stop is None else stop)):
        raise SequenceError(f"frames are asked for by whole numbers, not {start!r} to {stop!r}")
    end = length if stop is None else min(stop, length)
    asked = f"{start}:{'' if stop is None else stop}"
    if stop is not None and stop <= start:
        raise SequenceError(f"frames {asked} asked for, but the end is not after the start")
    if start < 0 or start >= length or end <= start:
        raise SequenceError(f"frames {asked} asked for, but the sequence has frames 0:{length}")
    return start, end
