"""How the online errors of two poses vary together, from what a back end says of its last few poses.

An online pose keeps the error that it had in its own time. A back end tells how the newest pose's error varies with
those of a few before it (`slam.interfaces.RecentBackend`). For an optimal estimate that is also the covariance with the
errors that these had in their own time, since what was learnt later is independent of the newest error. Over more
frames the errors are continued as an autoregressive process: given those few poses, older ones say nothing more of the
newest. Of all processes with the same covariances it has the largest entropy (Burg, PhD thesis, Stanford 1975).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import RecentPoses
from slam.geometry.arrays import Array

_DOF = 6
_NOTHING = 1e-6  # numerics: eigenvalue of correlations up to which what it stands for tells nothing


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Covariances of online errors.

    Attributes:
        by_lag: covariances (F, K, 6, 6) of the errors of F frames with those of the K last ones, their own first; NaN
            where not known.
        gains: by which each frame's error (F, 6, 6 (K - 1)) is expected from those before it; NaN of the first ones.
        frames: numbers of the frames (N,) whose poses are the rows that are asked for.
    """

    by_lag: Array
    gains: Array
    frames: NDArray[np.intp]

    @classmethod
    def of(cls, blocks: Sequence[Array], frames: NDArray[np.intp]) -> JointErrors | None:
        """By covariances (K, 6, 6), for each frame, of the last K poses' errors with its own, which comes last."""
        if not any(map(len, blocks)):  # a back end that tells none, or a path without poses
            return None
        by_lag = np.full((len(blocks), max(2, *map(len, blocks)), _DOF, _DOF), np.nan)
        for k, its in enumerate(blocks):
            by_lag[k, : len(its)] = np.swapaxes(its[::-1], 1, 2)
        return cls(by_lag, np.array([_gains(by_lag, k, len(its) - 1) for k, its in enumerate(blocks)]), frames)

    def select(self, rows: NDArray[np.intp]) -> JointErrors:
        """Of some of the rows (M,)."""
        return replace(self, frames=self.frames[rows])

    def between(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
        """Covariances (M, 6, 6) of the errors of rows `last` (M,) with those of `first`, which are not later.

        NaN where the back end had no pose before some frame between them, as after it has begun anew.
        """
        begun, column = np.unique(self.frames[first], return_inverse=True)
        last, (F, K) = self.frames[last], self.by_lag.shape[:2]
        ended = np.zeros(len(begun), np.intp)
        np.maximum.at(ended, column, last)
        out = np.full((len(last), _DOF, _DOF), np.nan)
        carried = np.full((len(begun), K, _DOF, _DOF), np.nan)  # of the last K frames' errors with those of `begun`
        for k in range(F):
            on = np.flatnonzero((begun <= k) & (k <= ended))
            lag = k - begun[on]
            now = self.gains[k] @ carried[on, :-1].reshape(len(on), (K - 1) * _DOF, _DOF)
            near = lag < K
            now[near] = self.by_lag[k, lag[near]]
            carried[on, 1:], carried[on, 0] = carried[on, :-1], now
            ends = np.flatnonzero(last == k)
            out[ends] = carried[column[ends], 0]
        return out


def _gains(by_lag: Array, k: int, n: int) -> Array:
    """Of frame k's error by those of the n frames before it (6, 6 (K - 1)), 0 by others; NaN of no frame."""
    K, size = by_lag.shape[1], n * _DOF
    unknown = np.full((_DOF, (K - 1) * _DOF), np.nan)
    if n < 1:
        return unknown
    gains = np.zeros((_DOF, K - 1, _DOF))
    P = np.empty((n, _DOF, n, _DOF))
    for i in range(n):
        for j in range(i, n):
            P[i, :, j] = by_lag[k - 1 - i, j - i]
            P[j, :, i] = P[i, :, j].T
    with_it = by_lag[k, 1 : n + 1].transpose(1, 0, 2).reshape(_DOF, size)
    sigma = np.sqrt(np.diag(P.reshape(size, size)))
    if not np.isfinite(P).all() or not sigma.all():  # not known, or certain, as a first pose may be
        return unknown
    correlations = P.reshape(size, size) / np.outer(sigma, sigma)
    values, axes = np.linalg.eigh(correlations)  # some are negative where an estimate forgot what it had known
    inverse = np.divide(1.0, values, out=np.zeros(size), where=values > _NOTHING)
    gains[:, :n] = ((with_it / sigma) @ (axes * inverse) @ axes.T / sigma).reshape(_DOF, n, _DOF)
    return gains.reshape(_DOF, -1)


def with_newest(recent: RecentPoses | None, stamps: Sequence[float]) -> Array:
    """Covariances (K, 6, 6) of the errors of the last K frames' poses with the newest one's; of none where not told.

    `stamps` are those of all frames so far, of which some may be no poses of the back end.
    """
    if recent is None:
        return np.zeros((0, _DOF, _DOF))
    n = min(len(recent), len(stamps))
    apart = np.flatnonzero(recent.stamps[len(recent) - n :] != stamps[len(stamps) - n :])
    first = len(recent) - n + (apart[-1] + 1 if len(apart) else 0)
    return recent.covariance[_DOF * first :, -_DOF:].reshape(-1, _DOF, _DOF)
