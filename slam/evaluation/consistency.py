"""Whether pose covariances are as large as the errors: NEES from the start, over stretches of the path, and of scale.

With ``T_true = T_estimated exp(e)`` the error of the relative pose from frame i to frame j is, to first order,
``e_j − A e_i`` with ``A = Ad((T_i⁻¹ T_j)⁻¹)``. Errors of odometry grow by increments that do not depend on what was
before, so the covariance of that difference is ``P_j − A P_i Aᵀ``. Where an old place is measured again it may not be
positive definite; such stretches are left out.

Truth has errors of its own. `TruthNoise` gives each true pose an independent one, the first included: the turn of a
recording's first true pose would otherwise count as an error of the whole path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.metrics import chi_square_band, nees, pose_residuals
from slam.geometry.arrays import Array
from slam.geometry.se3 import adjoint, inverse
from slam.geometry.trajectory import Trajectory, TruthNoise

#: Lengths of the stretches over which relative poses are judged [m].
STRETCHES = (1.0, 10.0, 100.0)

RowArray = NDArray[np.intp]

_DOF = 6
_SMALLEST = 1e-12  # eigenvalue of a covariance [rad², m²] below which it is none


def consistency_figures(own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise) -> dict[str, float]:
    """The figures of a run's summary; those that the path is too short for are left out.

    One run's errors are correlated over time: its mean may leave the band, which holds for independent ones, without
    a fault. The first pose defines the world and is left out.

    Args:
        own: the online path (N poses).
        true: the truth at the same stamps.
        covariances: of the path's poses (N, 6, 6).
        noise: of the truth.

    Returns:
        "mean NEES" from the start and its 95 % band for independent errors, "NEES over L m" for each of `STRETCHES`;
        six is right for all of these; "scale error [%]" and "scale sigma [%]".
    """
    first = np.zeros(len(own) - 1, np.intp)
    from_start = stretch_nees(own, true, covariances, noise, first, np.arange(1, len(own)))
    low, high = chi_square_band(_DOF, max(len(from_start), 1))
    figures = {"mean NEES": _mean(from_start), "band low": low, "band high": high, "dof": float(_DOF)}
    closed = _closings(covariances)
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(true.positions, axis=0), axis=1).cumsum()])
    for length in STRETCHES:
        last = np.searchsorted(along, along + length).astype(np.intp)
        starts = np.flatnonzero(last < len(own))
        starts = starts[closed[starts] == closed[last[starts]]]
        values = stretch_nees(own, true, covariances, noise, starts, last[starts])
        if len(values):
            figures[f"NEES over {length:g} m"] = _mean(values)
    figures.update(_scale(own, true, covariances, noise))
    return figures


def _closings(covariances: Array) -> RowArray:
    """Number of rows (N,) so far in which the position has become surer by half at once, as where a loop is closed.

    A stretch with one inside has no covariance that follows from those of its ends.
    """
    size = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        return np.concatenate([[0], np.cumsum(size[1:] < 0.5 * size[:-1])]).astype(np.intp)


def stretch_nees(
    own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise, first: RowArray, last: RowArray
) -> Array:
    """NEES (K,) of the relative poses between rows `first` and `last` (M,); K < M where covariances are unusable."""
    estimated = inverse(own.poses[first]) @ own.poses[last]
    residuals = pose_residuals(estimated, inverse(true.poses[first]) @ true.poses[last])
    A = np.array([adjoint(inverse(T)) for T in estimated]).reshape(-1, _DOF, _DOF)
    P = covariances[last] - A @ covariances[first] @ np.swapaxes(A, 1, 2)
    P = P + noise.covariance + A @ noise.covariance @ np.swapaxes(A, 1, 2)
    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    finite = np.isfinite(P).all(axis=(1, 2)) & np.isfinite(residuals).all(axis=1)
    usable = np.flatnonzero(finite)
    usable = usable[np.linalg.eigvalsh(P[usable])[:, 0] > _SMALLEST]
    return nees(residuals[usable], P[usable])


def _scale(own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise) -> dict[str, float]:
    """Error of the distance from the start to the farthest true pose, and its claimed standard deviation [%]."""
    away = np.linalg.norm(true.positions - true.positions[0], axis=1)
    far = int(np.argmax(away))
    if away[far] < 1.0:
        return {}
    way = own.positions[far] - own.positions[0]
    distance = float(np.linalg.norm(way))
    if not distance > 0:
        return {}
    along = own.poses[far, :3, :3].T @ way / distance
    variance = float(along @ covariances[far, 3:, 3:] @ along) + 2 * noise.translation**2
    return {
        "scale error [%]": 100 * (distance / float(away[far]) - 1),
        "scale sigma [%]": 100 * float(np.sqrt(max(variance, 0.0))) / float(away[far]),
    }


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def verdict(figures: dict[str, float]) -> str:
    """One line in words on what the figures say; empty where there are none."""
    key = next(
        (k for k in ("NEES over 10 m", "NEES over 1 m", "mean NEES") if np.isfinite(figures.get(k, np.nan))), None
    )
    if key is None:
        return ""
    ratio = figures[key] / _DOF
    what = "from the start" if key == "mean NEES" else key.removeprefix("NEES ")
    if ratio > 2:
        return f"covariances are too small: errors {what} are {np.sqrt(ratio):.1f} times what they claim"
    if ratio < 0.5:
        return f"covariances are too large: errors {what} are {np.sqrt(ratio):.1f} times what they claim"
    return f"covariances hold: errors {what} are {np.sqrt(ratio):.1f} times what they claim"
