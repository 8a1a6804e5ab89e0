"""How far off true relative poses may be, and which of them cannot be right: found from the truth alone.

Measured truth has errors, and a sequence says how large (`TruthNoise`). It does not say how fast they change. Over a
short stretch that is what counts, because an offset at both ends is no error of the relative pose. The truth tells it
in two ways:

- It is smooth. Errors that changed quickly would show as jitter, so the jitter of the steadiest axis bounds how quickly
  they change.
- A vehicle on wheels does not slip sideways. Where the true path does, by more the longer the stretch, the satellite
  receiver drifts.

Two signs make a stretch doubtful, so that it is left out:

- One of its ends lies where the path turns at a constant rate from pose to pose, far more evenly than a vehicle can
  move: that pose was not measured but interpolated over a gap, or extrapolated to where the path begins or ends. Which
  of the poses there were measured is not known, so that all of a gap at the begin or the end count as made up.
- A vehicle on wheels slips sideways by more than the truth's errors allow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.arrays import Array, BoolArray
from slam.geometry.se3 import inverse, log, so3_exp, so3_log
from slam.geometry.trajectory import Trajectory, TruthNoise

RowArray = NDArray[np.intp]

_EVEN = 0.01  # of the large changes of the turn from step to step: chance makes this in one of some 100,000
_NEARLY = 0.1  # the same beside such a one, where a gap begins or ends between two poses: one of some 200
_LARGE = 0.9  # quantile of the changes: where most of a path was interpolated, some tenth was not; if all, see below
_LEVER, _LEVER_SIGMA = 1.5, 1.0  # from the axle that does not steer forward to the camera [m]
_SIGMAS = 3.0  # of what may seem to be a slip
_LEAST = 1e-12  # numerics: change of the turn [rad] below which nothing can be told
_MEDIAN = 0.6745  # derived: median of the absolute value of a Gaussian number of unit variance


def truth_covariances(true: Trajectory, noise: TruthNoise, first: RowArray, last: RowArray, A: Array) -> Array:
    """Covariances (M, 6, 6) of the truth's errors in relative poses, ``e_j − A e_i``, of the true path (N), z forward.

    Attitude and position have errors of their own, constant in the world but for their change over time. The error of a
    stamp is one along the motion, independent in each pose. Stretches begin at the rows `first` (M,) and end at `last`;
    `A` (M, 6, 6) are adjoints of the inverse relative poses.
    """
    rotated = np.zeros_like(A)
    rotated[:, :3, :3], rotated[:, 3:, 3:] = A[:, :3, :3], A[:, 3:, 3:]
    shared = np.repeat(_correlations(true, noise, true.stamps[last] - true.stamps[first]), 3, axis=1)
    Q, Z = noise.covariance, _stamp_covariances(true, noise)
    cross = rotated @ (shared[:, :, None] * Q)  # of the error at the end with that at the beginning
    At = np.swapaxes(A, 1, 2)
    out = Q + Z[last] + A @ (Q + Z[first]) @ At - cross @ At - A @ np.swapaxes(cross, 1, 2)
    by_noise = 2 * noise.translation**2 * (1 - shared[:, 3])
    out[:, [3, 4, 5], [3, 4, 5]] += np.maximum(_drift(true, noise, first, last) - by_noise, 0.0)[:, None]
    return np.asarray(out)


def doubtful(true: Trajectory, noise: TruthNoise, first: RowArray, last: RowArray) -> BoolArray:
    """Whether the truth is doubtful between rows `first` and `last` (M,); never where it has no noise."""
    if len(true) < 3 or not noise.covariance.any():
        return np.zeros(len(first), bool)
    made_up = interpolated(true, noise)
    bad = made_up[first] | made_up[last]
    if not noise.wheels:
        return bad
    slip, unknown = _slip(true, noise)
    variance = np.maximum(_drift(true, noise, first, last), 2 * noise.translation**2)
    variance += np.square(unknown[last] - unknown[first]).sum(axis=1)
    return np.asarray(bad | (np.abs(slip[last] - slip[first]) > _SIGMAS * np.sqrt(variance)))


def _correlations(true: Trajectory, noise: TruthNoise, apart: Array) -> Array:
    """Correlations (M, 2) of the errors of two attitudes, and of two positions, that are `apart` (M,) [s].

    The errors are taken for first-order Markov processes that change as quickly as the truth's smoothness allows. Their
    second difference has the variance ``s² (6 − 8 ρ + 2 ρ²)``, with s the noise and ρ the correlation of successive
    poses. That of the true path, by its steadiest axis, is the most that it may be.
    """
    if len(true) < 3:
        return np.zeros((len(apart), 2))
    jitter = np.diff(log(inverse(true.poses[:-1]) @ true.poses[1:]), axis=0)
    q = (np.median(np.abs(jitter), axis=0) / _MEDIAN).reshape(2, 3).min(axis=1)
    s = np.array([noise.rotation, noise.translation])
    ratio = np.divide(q, s, out=np.full(2, np.inf), where=s > 0)
    of_step = np.clip(2 - np.sqrt(1 + np.square(ratio) / 2), 0.0, 1.0)
    return np.asarray(of_step ** (np.abs(apart) / np.median(np.diff(true.stamps)))[:, None])


def _stamp_covariances(true: Trajectory, noise: TruthNoise) -> Array:
    """What errors of the stamps add to the covariances (N, 6, 6) of the true poses."""
    if not noise.time or len(true) < 2:
        return np.zeros((len(true), 6, 6))
    rate = log(inverse(true.poses[:-1]) @ true.poses[1:]) / np.diff(true.stamps)[:, None]
    moved = noise.time * np.concatenate([rate, rate[-1:]])
    return moved[:, :, None] * moved[:, None]


def _drift(true: Trajectory, noise: TruthNoise, first: RowArray, last: RowArray) -> Array:
    """Variances (M,) [m²] of a drift of the truth between rows, by how far all stretches of as many frames slip."""
    out = np.zeros(len(first))
    if not noise.wheels or not noise.translation or len(true) < 3:
        return out
    total, unknown = _slip(true, noise)
    for frames in np.unique(last - first)[np.unique(last - first) > 0].tolist():
        slip = np.median(np.abs(total[frames:] - total[:-frames])) / _MEDIAN
        known = np.median(np.square(unknown[frames:] - unknown[:-frames]).sum(axis=1))
        out[last - first == frames] = max(float(slip**2 - known), 0.0)
    return out


def _slip(true: Trajectory, noise: TruthNoise) -> tuple[Array, Array]:
    """How far a vehicle has slipped sideways up to each pose (N,) [m], and what may seem to be a slip (N, 2).

    A camera ahead of the axle moves sideways by its lever times the turn. Its constant part is how the camera stands in
    the vehicle: the median. What may seem to be a slip: the unknown part of the lever, and an error of the attitude.
    """
    motion = inverse(true.poses[:-1]) @ true.poses[1:]
    turn = so3_log(motion[:, :3, :3])
    middle = (np.swapaxes(so3_exp(0.5 * turn), 1, 2) @ motion[:, :3, 3:])[:, :, 0]
    forward = np.where(middle[:, 2] > 0, middle[:, 2], np.nan)
    unknown = np.column_stack([_LEVER_SIGMA * turn[:, 1], noise.rotation * np.linalg.norm(middle, axis=1)])
    sideways = middle[:, 0] - _LEVER * turn[:, 1]
    known = np.isfinite(forward).any()
    steps = sideways - np.nanmedian(sideways / forward) * middle[:, 2] if known else 0 * sideways
    slip, unknown = (np.concatenate([x[:1] * 0, np.cumsum(x, axis=0)]) for x in (steps, unknown))
    return slip, unknown


def interpolated(true: Trajectory, noise: TruthNoise) -> BoolArray:
    """Which poses (N,) of a moving vehicle or camera were not measured: it turns at the same rate before and after.

    Without motion, by less than the noise of the truth, equal turns are no sign of it. What was measured turns by this
    noise at least, so that a path of which every pose was interpolated is known without one that was not.
    """
    made_up = np.zeros(len(true), bool)
    if len(true) < 3 or not noise.covariance.any():
        return made_up
    motion = inverse(true.poses[:-1]) @ true.poses[1:]
    steps = np.diff(true.stamps)
    turns = so3_log(motion[:, :3, :3]) * (np.median(steps) / steps)[:, None]  # as if no frame were missing
    change = np.linalg.norm(np.diff(turns, axis=0), axis=1)
    moves = np.linalg.norm(motion[:, :3, 3], axis=1) > noise.translation
    large = float(np.quantile(change, _LARGE))
    if large < _LEAST:
        return made_up
    ratio = np.where(moves[:-1] & moves[1:], change / max(large, noise.rotation), np.inf)
    run = np.cumsum(ratio >= _NEARLY)  # the number of each run of nearly even changes
    made_up[1:-1] = (ratio < _NEARLY) & np.isin(run, run[ratio < _EVEN])
    made_up[0], made_up[-1] = made_up[1], made_up[-2]
    return made_up
