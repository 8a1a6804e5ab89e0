"""Checks of a back end's input, the same for all back ends: times, poses, pixels."""

from __future__ import annotations

import numpy as np

from slam.errors import MeasurementError
from slam.geometry.arrays import Array

#: Limits of a measurement: farthest pixel from the origin [px], latest stamp from zero [s].
FARTHEST_PIXEL, LATEST_STAMP = 1e5, 1e12

#: Likely times since 1970 [s], 1973 to 2286, and the units [1/s] that they are given in by mistake.
SINCE_1970 = (1e8, 1e10)
UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))

#: Largest coordinate of a position [m]: beyond it, a double has too few digits for what a camera sees.
FARTHEST_POSITION = 1e8

#: Largest id of a landmark, and largest count, in files: doubles hold them exactly, and there is room for later ones.
MOST_ID = 2**53


def unit_doubt(stamp: float) -> str:
    """What is likely wrong with a time [s] too large for one, as `` (is it in nanoseconds?)``; empty for no guess."""
    low, high = SINCE_1970
    return next((f" (is it in {unit}?): give it in seconds" for unit, n in UNITS if low <= abs(stamp) / n <= high), "")


def require_stamp(owner: str, stamp: float, last: float | None) -> None:
    """Raise MeasurementError where a back end, `owner`, cannot be advanced from `last` [s] (None: none) to `stamp`."""
    if not np.isfinite(stamp) or abs(stamp) > LATEST_STAMP or (last is not None and stamp <= last):
        after = "" if last is None else f" after {last}"
        raise MeasurementError(
            f"{owner}: stamp {stamp}{after}: time must be finite, increase, and lie within {LATEST_STAMP:g} s"
        )


def require_not_measured(owner: str, measured: bool) -> None:
    """Raise MeasurementError where the present stamp has had its update, or something was added at its pose."""
    if measured:
        raise MeasurementError(f"{owner}: a stamp has one update, right after its predict")


def is_rigid(T: Array, tolerance: float) -> bool:
    """Whether T (4, 4) is a rotation and a translation, as far as a double can tell what a camera sees there."""
    if T.shape != (4, 4) or not (np.abs(T) <= FARTHEST_POSITION).all() or np.abs(T[:3, :3]).max() >= 1.1:
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= tolerance and np.linalg.det(R) > 0)


def require_guess(owner: str, guess: Array | None) -> None:
    """Raise MeasurementError where a guess of the camera's pose is no rigid motion (4, 4)."""
    if guess is None:
        return
    if not isinstance(guess, np.ndarray) or guess.shape != (4, 4) or not np.isfinite(guess).all():
        raise MeasurementError(f"{owner}: the guess must be a finite pose, an array (4, 4)")
    if not is_rigid(guess, 1e-3) or (guess[3] != (0, 0, 0, 1)).any():
        raise MeasurementError(f"{owner}: the guess must be a rigid motion: a rotation and a translation")


def require_recent(owner: str, n: int) -> int:
    """How many of the last poses are asked for; raises MeasurementError where fewer than one."""
    if n < 1:
        raise MeasurementError(f"{owner}: recent({n}): one pose at least must be asked for")
    return int(n)
