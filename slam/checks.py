"""Checks of a back end's input, the same for all back ends: times, poses, pixels, and landmarks known beforehand."""

from __future__ import annotations

import numpy as np

from slam.errors import MeasurementError
from slam.geometry.arrays import Array, BoolArray, IdArray, LandmarkRows
from slam.geometry.se3 import LEAST_VARIANCE, is_rotation

#: Limits of a measurement: farthest pixel from the origin [px], latest stamp from zero [s].
FARTHEST_PIXEL, LATEST_STAMP = 1e5, 1e12

#: Likely times since 1970 [s], 1973 to 2286, and the units [1/s] that they are given in by mistake.
SINCE_1970 = (1e8, 1e10)
UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))

#: Largest coordinate of a position [m]: beyond it, a double has too few digits for what a camera sees.
FARTHEST_POSITION = 1e8

#: Largest id of a landmark, and largest count, in files: doubles hold them exactly, and there is room for later ones.
MOST_ID = 2**53

_NEAREST = 1e-3  # guard: least depth [m] of a landmark that a camera sees
_LARGEST = 1e18  # guard: variance [m²], far above that of any landmark worth having
_ROUNDING = 1e-14  # numerics: share of a covariance's largest eigenvalue below which the smallest is rounding
_SYMMETRIC = 1e-6  # guard: largest share by which a covariance may differ from its transpose


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
    """Whether T (..., 4, 4) are rotations and translations, as far as a double can tell what a camera sees there."""
    near = bool((np.abs(T) <= FARTHEST_POSITION).all())  # false for NaN, too
    return near and bool(is_rotation(T[..., :3, :3], tolerance).all())


def require_guess(owner: str, guess: Array | None) -> None:
    """Raise MeasurementError where a guess of the camera's pose is no rigid motion (4, 4)."""
    fine = guess is None or (isinstance(guess, np.ndarray) and guess.shape == (4, 4) and is_rigid(guess, 1e-3))
    if not fine or (guess is not None and (guess[3] != (0, 0, 0, 1)).any()):
        raise MeasurementError(f"{owner}: the guess must be an array (4, 4): a rotation and a translation")


def require_recent(owner: str, n: int) -> int:
    """How many of the last poses are asked for; raises MeasurementError where fewer than one."""
    if n < 1:
        raise MeasurementError(f"{owner}: recent({n}): one pose at least must be asked for")
    return int(n)


def require_known(backend: str, ids: IdArray, positions: Array, covariances: Array) -> None:
    """Check landmarks (N) at positions (N, 3) [m] with covariances (N, 3, 3) [m²], as given to a back end of this name.

    Raises MeasurementError where shapes differ, an id occurs twice, a position is not finite or absurdly far, or a
    covariance is not symmetric and positive definite.
    """
    n = len(ids)
    if positions.shape != (n, 3) or covariances.shape != (n, 3, 3):
        shapes = f"positions {positions.shape} and covariances {covariances.shape}"
        raise MeasurementError(f"{backend}: {n} landmark ids, but {shapes}")
    if len(np.unique(ids)) != n:
        raise MeasurementError(f"{backend}: a landmark id stands twice")
    far = f"landmark {{}} lies more than {FARTHEST_POSITION:g} m off"
    for bad, what in (
        (~np.isfinite(positions).all(axis=1), "the position of landmark {} is not finite"),
        ((np.abs(positions) > FARTHEST_POSITION).any(axis=1), far),
        (~_positive_definite(covariances), "the covariance of landmark {} is not symmetric and positive definite"),
    ):
        if bad.any():
            raise MeasurementError(f"{backend}: {what.format(ids[bad][0])}")


def definite(covariances: Array) -> Array:
    """Covariances (N, 3, 3) [m²] symmetric and positive definite: what rounding took from the least variance is added.

    A landmark that is hardly known in one direction may have lost its variance in another one.
    """
    P = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    values = np.linalg.eigvalsh(P)
    short = np.maximum(np.maximum(LEAST_VARIANCE, _ROUNDING * values[:, 2]) - values[:, 0], 0)
    return np.asarray(P + short[:, None, None] * np.eye(3))


def known_landmarks(
    backend: str, table: LandmarkRows, ids: IdArray, positions: Array, covariances: Array, seen: bool
) -> tuple[IdArray, Array, Array]:
    """Copies of landmarks (N,) handed to `slam.interfaces.MapBackend`, checked; they may not be in the table yet.

    Where they are seen, their positions (N, 3) are in the camera's coordinates, in front of it. Raises
    MeasurementError.
    """
    require_known(backend, ids, positions, covariances)
    if seen and (behind := ~in_front(positions)).any():
        raise MeasurementError(f"{backend}: landmark {ids[behind][0]} does not lie in front of the camera")
    table.require_new(ids)
    return np.array(ids, np.int64), np.array(positions, float), np.array(covariances, float)


def in_front(local: Array) -> BoolArray:
    """Which points (N, 3) [m] in a camera's coordinates lie in front of it (N,)."""
    return np.asarray(local[:, 2] >= _NEAREST)


def _positive_definite(covariances: Array) -> BoolArray:
    """Which matrices (N,) are finite, symmetric and positive definite."""
    good = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    C = np.where(good[:, None, None], covariances, np.eye(3))
    scale = np.abs(C).max(axis=(1, 2))
    good &= (np.abs(C - np.swapaxes(C, 1, 2)).max(axis=(1, 2)) <= _SYMMETRIC * scale) & (scale < _LARGEST)
    return np.asarray(good & (np.linalg.eigvalsh(np.where(good[:, None, None], C, np.eye(3)))[:, 0] > 0))
