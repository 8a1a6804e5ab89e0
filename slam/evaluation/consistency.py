"""Whether pose covariances are as large as the errors: NEES from the start, and over stretches of the path.

With ``T_true = T_estimated exp(e)`` the error of the relative pose from frame i to frame j is, to first order,
``e_j − A e_i`` with ``A = Ad((T_i⁻¹ T_j)⁻¹)``. Noise makes the errors that are in the covariances N; with C the
covariance of the later one with the earlier (`slam.evaluation.joint_errors`), that of the difference is
``N_j + A N_i Aᵀ − C Aᵀ − A Cᵀ``. Where C is not known, errors count as those of dead reckoning, which
grow by increments that do not depend on what was before: ``C = A N_i``. Errors of the rig are the same in all frames:
poses are off by ``J_i δ``, so they add ``(J_j − A J_i) Σ (J_j − A J_i)ᵀ`` with Σ as known in frame j. Where the result
is not positive definite, stretches are left out and counted; where most are, that length has no figure.

Truth has errors of its own, the first pose included: else its turn would count as an error of the whole path. Their
covariance is added, and stretches over which the truth contradicts itself are left out
(`slam.evaluation.truth_error`). What is the same in all poses, how the truth's sensor stands beside the camera and how
far its clock is ahead, is found from all stretches of one length by least squares and taken out, of the rig's errors as
well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.data import CommonError
from slam.evaluation.joint_errors import JointErrors
from slam.evaluation.metrics import chi_square_band, nees, pose_residuals
from slam.evaluation.truth_error import RowArray, doubtful, interpolated, truth_covariances
from slam.geometry.arrays import Array, BoolArray
from slam.geometry.se3 import adjoint, inverse, log
from slam.geometry.trajectory import Trajectory, TruthNoise

#: Lengths of the stretches over which relative poses are compared [m].
STRETCHES = (1.0, 10.0, 100.0)

#: Beside the figures: the cameras are those of the calibration, while the covariances may count errors of one.
EXACT = "exact calibration"

#: Beside the figures: the back end's covariances count no errors of the calibration, as others' do.
PIXELS_ALONE = "pixel noise alone"

#: Beside the figures, where there are any: how many poses come before the first one that has truth.
BEFORE = "poses before the truth"

_DOF = 6
_SMALLEST = 1e-12  # eigenvalue of a covariance [rad², m²] below which it is none
_MOST = 0.5  # share of the stretches without a covariance above which a length has no figure
_ROUNDING = 1e-14  # eigenvalues below this share of the largest are rounding


def consistency_figures(
    own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise,
    common: Sequence[CommonError] | None = None, joint: JointErrors | None = None,
) -> dict[str, float]:  # fmt: skip
    """The figures of a run's summary; those that the path is too short for are left out.

    The first pose defines the world and is left out; the start is the first pose whose truth was measured. The online
    path has covariances (N, 6, 6), of which the poses share `common` (N), and the truth the same stamps; `joint` is of
    the rest of its errors.

    Returns:
        "mean NEES" from the start, "NEES over L m" for each of `STRETCHES`; six is right for all of these, and "band
        low" and "band high" hold 95 % of runs; "doubtful truth over L m" and "no covariance over L m", the shares of
        stretches left out because the truth contradicts itself or an old place was measured again within them, where
        there are any; "share of truth over L m" and "from the start", how much of the errors expected is the truth's.
    """
    start = int(np.argmin(interpolated(true, noise)))  # the first pose that was measured
    later = np.arange(start + 1, len(own))
    from_start, share = stretch_nees(own, true, covariances, noise, np.full(len(later), start), later, common, joint)
    low, high = chi_square_band(_DOF)  # of one value: errors of the rig make all frames of a run as good as one
    figures = {"mean NEES": _mean(from_start), "band low": low, "band high": high, "dof": float(_DOF)}
    figures["share of truth from the start"] = _mean(share)
    closed = _closings(covariances)
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(true.positions, axis=0), axis=1).cumsum()])
    for length in STRETCHES:
        last = np.searchsorted(along, along + length).astype(np.intp)
        starts = np.flatnonzero(last < len(own))
        values, share = stretch_nees(own, true, covariances, noise, starts, last[starts], common, joint)
        values[closed[starts] != closed[last[starts]]] = np.nan
        left_out = doubtful(true, noise, starts, last[starts])
        none = ~np.isfinite(values) & ~left_out
        if np.isfinite(values).any() and none.mean() <= _MOST:
            figures[f"NEES over {length:g} m"] = _mean(values)
            figures[f"share of truth over {length:g} m"] = _mean(share[np.isfinite(values)])
        for what, rows in (("doubtful truth", left_out), ("no covariance", none)):
            if rows.any():
                figures[f"{what} over {length:g} m"] = float(np.mean(rows))
    return figures


def _closings(covariances: Array) -> RowArray:
    """Number of rows (N,) so far in which the position has become surer by half at once, as where a loop is closed.

    A stretch with one inside has no covariance that follows from those of its ends.
    """
    size = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        return np.concatenate([[0], np.cumsum(size[1:] < 0.5 * size[:-1])]).astype(np.intp)


def stretch_nees(
    own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise, first: RowArray, last: RowArray,
    common: Sequence[CommonError] | None = None, joint: JointErrors | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """NEES (M,) of the relative poses between rows `first` and `last` (M,), and the share of the truth's errors in it.

    That is how much of six is expected of them. NaN where the covariance is none, or the truth is doubtful.
    """
    first, last = np.broadcast_arrays(first, last)
    estimated = inverse(own.poses[first]) @ own.poses[last]
    residuals = pose_residuals(estimated, inverse(true.poses[first]) @ true.poses[last])
    A = adjoint(inverse(estimated))
    common = common or [CommonError()] * len(own)
    noises = covariances - np.array([one.covariance for one in common])
    earlier, At = A @ noises[first], np.swapaxes(A, 1, 2)
    given = np.full_like(earlier, np.nan) if joint is None else joint.between(first, last)  # by the back end
    shared = np.where(np.isfinite(given), given, earlier) @ At
    N = noises[last] + earlier @ At - shared - np.swapaxes(shared, 1, 2)
    of_truth = truth_covariances(true, noise, first, last, A)
    N = N + of_truth
    N, G = _shared(A, [(common[i], common[j]) for i, j in zip(first, last)], N)
    N = 0.5 * (N + np.swapaxes(N, 1, 2))
    usable = np.isfinite(residuals).all(axis=1) & ~doubtful(true, noise, first, last)
    usable[usable] = are_covariances(N[usable]) & are_covariances(_with(N[usable], G[usable]))
    values, share = np.full((2, len(first)), np.nan)
    if usable.any():
        N, A, G = N[usable], A[usable], G[usable]
        J = by_mounting(true, noise, first[usable], last[usable], A)
        errors = _remounted(np.concatenate([residuals[usable, :, None], G], axis=2), J, _with(N, G))
        P = _with(N, errors[:, :, 1:])
        values[usable] = nees(errors[:, :, 0], P)
        share[usable] = np.trace(np.linalg.solve(P, of_truth[usable]), axis1=1, axis2=2) / _DOF
    return values, share


def are_covariances(P: Array) -> BoolArray:
    """Which symmetric matrices (M, 6, 6) are finite and positive definite, also after rounding (M,)."""
    good: BoolArray = np.asarray(np.isfinite(P).all(axis=(1, 2)))
    values = np.linalg.eigvalsh(P[good])
    good[good] = values[:, 0] > np.maximum(_SMALLEST, _ROUNDING * values[:, -1])
    return good


def _with(N: Array, G: Array) -> Array:
    """Covariances (M, 6, 6) and what common errors (M, 6, k) of unit variance add to them."""
    return np.asarray(N + G @ np.swapaxes(G, 1, 2))


def by_mounting(true: Trajectory, noise: TruthNoise, first: RowArray, last: RowArray, A: Array) -> Array:
    """Derivatives (M, 6, 7) of relative poses by how the truth's sensor is mounted and by its clock, of unit variance.

    With ``T_true = T exp(w)`` for all poses, w = [mounting, lever], a relative pose is off by ``(1 − A) w``; with a
    clock that is ahead, each pose is off by its rate.
    """
    sigmas = np.repeat([noise.mounting, noise.lever], 3)
    J = (np.eye(_DOF) - A) * sigmas
    rates = np.zeros((len(true), _DOF))
    if noise.clock and len(true) > 1:
        steps = log(inverse(true.poses[:-1]) @ true.poses[1:]) / np.diff(true.stamps)[:, None]
        rates = noise.clock * 0.5 * (steps[np.arange(-1, len(steps)).clip(0)] + np.concatenate([steps, steps[-1:]]))
    return np.concatenate([J, rates[last, :, None] - A @ rates[first, :, None]], axis=2)


def _remounted(errors: Array, J: Array, P: Array) -> Array:
    """Errors (M, 6, k) without what the truth's sensor explains of them.

    The rig's errors are treated as the residuals are: else a turn of the rig, that a mounting explains, would count in
    the covariance alone.
    """
    JW = np.swapaxes(np.linalg.solve(P, J), 1, 2)
    information = np.tensordot(JW, J, axes=((0, 2), (0, 1))) + np.eye(J.shape[2])
    return np.asarray(errors - J @ np.linalg.solve(information, np.tensordot(JW, errors, axes=((0, 2), (0, 1)))))


def _shared(A: Array, ends: Sequence[tuple[CommonError, CommonError]], N: Array) -> tuple[Array, Array]:
    """What errors of unit variance that the poses at their ends share make of relative poses (M)."""
    N, G = N.copy(), np.zeros((len(ends), _DOF, max((last.root.shape[1] for _, last in ends), default=0)))
    for row, (a, (first, last)) in enumerate(zip(A, ends)):
        if first.jacobian.shape == last.jacobian.shape:
            G[row, :, : last.root.shape[1]] = (last.jacobian - a @ first.jacobian) @ last.root
        else:
            N[row] += last.covariance - a @ first.covariance @ a.T
    return N, G


def _mean(values: Array) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
