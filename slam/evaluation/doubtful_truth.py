"""Stretches over which the truth itself cannot be right, found from the truth alone.

An estimate is not at fault where it contradicts these. Two signs are looked for in truth that was measured:

- It turns at a constant rate from pose to pose, far more evenly than elsewhere: it was interpolated over a gap.
- A vehicle on wheels slips sideways by more than the truth's noise allows: a drift of the satellite receiver.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.arrays import Array, BoolArray
from slam.geometry.se3 import inverse, so3_exp, so3_log
from slam.geometry.trajectory import Trajectory, TruthNoise

RowArray = NDArray[np.intp]

_EVEN = 0.01  # of the large changes of the turn from step to step: chance makes this in one of some 100,000
_LARGE = 0.9  # quantile of the changes: even where most of a short path was interpolated, some tenth was not
_LEVER, _LEVER_SIGMA = 1.5, 1.0  # from the axle that does not steer forward to the camera [m]
_SIGMAS = 3.0  # of what may seem to be a slip


def doubtful(true: Trajectory, noise: TruthNoise, first: RowArray, last: RowArray) -> BoolArray:
    """Whether the truth is doubtful between rows `first` and `last` (M,); never where it has no noise.

    Args:
        true: true poses of the left camera (N), x to the right and z forward.
        noise: of the truth.
        first: rows at which stretches begin.
        last: rows at which they end.
    """
    if len(true) < 3 or not noise.covariance.any():
        return np.zeros(len(first), bool)
    motion = inverse(true.poses[:-1]) @ true.poses[1:]
    turn = so3_log(motion[:, :3, :3])
    bad = _within(_interpolated(turn), first, last - 1)
    return bad | _slips(motion, turn, noise, first, last) if noise.wheels else bad


def _interpolated(turn: Array) -> BoolArray:
    """Whether a step's turn (N, 3) [rad] and the next one's are the same to rounding (N − 1,)."""
    change = np.linalg.norm(np.diff(turn, axis=0), axis=1)
    return np.asarray(change < _EVEN * np.quantile(change, _LARGE))


def _slips(motion: Array, turn: Array, noise: TruthNoise, first: RowArray, last: RowArray) -> BoolArray:
    """Whether a vehicle slips sideways between rows (M,); `motion` and `turn` are its steps (N, 4, 4), (N, 3).

    A camera ahead of the axle moves sideways by its lever times the turn. Its constant part is how the camera stands in
    the vehicle: the median.
    """
    middle = (np.swapaxes(so3_exp(0.5 * turn), 1, 2) @ motion[:, :3, 3:])[:, :, 0]
    forward = np.where(middle[:, 2] > 0, middle[:, 2], np.nan)
    sideways = middle[:, 0] - _LEVER * turn[:, 1]
    if not np.isfinite(forward).any():
        return np.zeros(len(first), bool)
    slip = sideways - np.nanmedian(sideways / forward) * middle[:, 2]
    total, turned, way = (_between(x, first, last) for x in (slip, turn[:, 1], np.linalg.norm(middle, axis=1)))
    variance = 2 * noise.translation**2 + (noise.rotation * way) ** 2 + (_LEVER_SIGMA * turned) ** 2
    return np.asarray(np.abs(total) > _SIGMAS * np.sqrt(variance))


def _between(steps: Array, first: RowArray, last: RowArray) -> Array:
    """Sums (M,) of steps (N,) between rows."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(total[last] - total[first])


def _within(flags: BoolArray, first: RowArray, last: RowArray) -> BoolArray:
    """Whether any of the flags (N,) from `first` to before `last` (M,) is set."""
    total = np.concatenate([[0], np.cumsum(flags)])
    return np.asarray(total[np.maximum(last, first)] > total[first])
