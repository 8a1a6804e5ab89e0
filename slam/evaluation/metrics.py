"""Accuracy of an estimated path: ATE, RPE by frames and by distance, and consistency (NEES).

Definitions, with P the estimated and Q the true poses ``T_world_left`` at common stamps:

- ATE: ``|p_i − q_i|`` [m] and the angle of ``Q_i⁻¹ P_i`` [deg] after one alignment of the whole path.
- RPE over Δ frames: translation [m] and angle [deg] of ``(Q_i⁻¹ Q_{i+Δ})⁻¹ (P_i⁻¹ P_{i+Δ})``; no alignment.
- Segment error: the same over stretches of the true path of given lengths, divided by the length (KITTI's measure).
- NEES: ``eᵀ Σ⁻¹ e`` with ``T_true = T_estimated exp(e)``, e = [rotation, translation] as pose covariances have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.chi_square import chi_square_limit
from slam.errors import TrajectoryError
from slam.geometry.se3 import Array, inverse, log, pose, rotation_angle, so3_exp, so3_log
from slam.geometry.trajectory import Trajectory, alignment

#: Lengths of KITTI's segments [m].
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)

_ROUNDING = 1e-6  # [s] by which a stamp may differ that was written to a file and read again


@dataclass(frozen=True, eq=False)
class PathErrors:
    """Errors of poses, or of relative motions, row by row.

    Attributes:
        translation: (N,) [m].
        rotation: (N,) [deg].
    """

    translation: Array
    rotation: Array

    @property
    def rmse(self) -> float:
        """Root mean square of the translation [m]."""
        return float(np.sqrt(np.mean(self.translation**2)))

    @property
    def rotation_rmse(self) -> float:
        """The same of the rotation [deg]."""
        return float(np.sqrt(np.mean(self.rotation**2)))


def associate(estimate: Trajectory, truth: Trajectory, tolerance: float = 0.02) -> tuple[Trajectory, Trajectory]:
    """Both paths at common stamps, row by row: the estimate's rows that have truth, and the truth for them.

    The truth is taken between two true poses: positions linearly, orientations at constant angular velocity. So it is
    before the first one and after the last, up to `tolerance` and to their usual distance: farther, noise would grow.

    Args:
        estimate: the estimated path.
        truth: the true path.
        tolerance: the nearer of the two true poses may lie so far away in time [s].

    Raises:
        TrajectoryError: no estimated pose has truth.
    """
    own, stamps = truth.stamps, estimate.stamps
    rows = np.zeros(0, int)
    if len(own):
        outside = min(tolerance, float(np.median(np.diff(own)))) if len(own) > 1 else _ROUNDING
        rows = np.flatnonzero((stamps >= own[0] - outside) & (stamps <= own[-1] + outside))
        after = np.searchsorted(own, stamps[rows]).clip(min(1, len(own) - 1), len(own) - 1)
        before = (after - 1).clip(0)
        near = np.minimum(np.abs(own[after] - stamps[rows]), np.abs(own[before] - stamps[rows])) <= tolerance
        rows, after, before = rows[near], after[near], before[near]
    if not len(rows):
        raise TrajectoryError(
            f"no estimated pose has a true one within {tolerance:g} s: {_span('estimate', stamps)}, "
            f"{_span('truth', own)}"
        )
    step, since = own[after] - own[before], stamps[rows] - own[before]
    share = np.divide(since, step, out=np.zeros(len(rows)), where=step > 0)[:, None]
    first, second = truth.poses[before], truth.poses[after]
    turn = so3_log(np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3])
    t = (1 - share) * first[:, :3, 3] + share * second[:, :3, 3]
    true = pose(first[:, :3, :3] @ so3_exp(share * turn), t)
    return Trajectory(stamps[rows], estimate.poses[rows]), Trajectory(stamps[rows], true)


def _span(name: str, stamps: Array) -> str:
    return f"{name} from {stamps[0]:.3f} to {stamps[-1]:.3f} s" if len(stamps) else f"{name} is empty"


def absolute_errors(estimate: Trajectory, truth: Trajectory) -> PathErrors:
    """ATE of two paths of equal length, row by row (see `associate`), after their alignment without scale.

    Positions alone align them, so errors of the rotation mean little where the camera stood or went straight.

    Raises:
        TrajectoryError: the lengths differ, or there is no pose.
    """
    _require_pairs(estimate, truth, 1)
    poses = alignment(estimate, truth) @ estimate.poses
    distance = np.linalg.norm(poses[:, :3, 3] - truth.positions, axis=1)
    turn = np.swapaxes(truth.poses[:, :3, :3], 1, 2) @ poses[:, :3, :3]
    return PathErrors(distance, np.degrees(rotation_angle(turn)))


def relative_errors(estimate: Trajectory, truth: Trajectory, delta: int = 1) -> PathErrors:
    """RPE over `delta` frames, from every frame.

    Raises:
        TrajectoryError: the lengths differ, there are not more than `delta` poses, or `delta` is not positive.
    """
    if delta < 1:
        raise TrajectoryError(f"RPE: delta must be at least 1 frame, got {delta}")
    _require_pairs(estimate, truth, delta + 1)
    first = np.arange(len(truth) - delta)
    return _motion_errors(estimate, truth, first, first + delta)


def segment_errors(estimate: Trajectory, truth: Trajectory) -> Array:
    """Errors over stretches of the true path, as KITTI's odometry benchmark has them.

    The stretches are KITTI's of 100 to 800 m for a path of at least 1 km, else of eight lengths up to four fifths of
    the path. From every tenth frame a stretch reaches to the first frame that lies farther along the path than its
    length; starts from which the path is too short give none.

    Returns:
        rows (M, 3) of the length asked for [m], and of errors by length: translation [%] and rotation [deg/m].

    Raises:
        TrajectoryError: the lengths of the two paths differ, or there is no pose.
    """
    _require_pairs(estimate, truth, 1)
    whole = truth.length if truth.length > 1e-6 else 0.0
    lengths = KITTI_LENGTHS if whole >= 1000 else [whole * i / 10 for i in range(1, 9) if whole]
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).cumsum()])
    starts = np.arange(0, len(truth), 10)
    rows = [np.zeros((0, 3))]
    for length in lengths:
        ends = np.searchsorted(along, along[starts] + length, side="right")
        inside = ends < len(truth)
        errors = _motion_errors(estimate, truth, starts[inside], ends[inside])
        asked = np.full(len(errors.translation), length)
        rows.append(np.column_stack([asked, 100 * errors.translation / length, errors.rotation / length]))
    return np.concatenate(rows)


def _require_pairs(estimate: Trajectory, truth: Trajectory, count: int) -> None:
    if len(estimate) != len(truth):
        raise TrajectoryError(f"{len(estimate)} estimated poses, {len(truth)} true ones: associate them first")
    if len(estimate) < count:
        raise TrajectoryError(f"{len(estimate)} poses are too few, {count} are needed")


def _motion_errors(estimate: Trajectory, truth: Trajectory, first: np.ndarray, last: np.ndarray) -> PathErrors:
    true = inverse(truth.poses[first]) @ truth.poses[last]
    estimated = inverse(estimate.poses[first]) @ estimate.poses[last]
    return error_sizes(inverse(true) @ estimated)


def error_sizes(E: Array) -> PathErrors:
    """Of error motions (N, 4, 4)."""
    return PathErrors(np.linalg.norm(E[:, :3, 3], axis=1), np.degrees(rotation_angle(E[:, :3, :3])))


def pose_residuals(estimated: Array, true: Array) -> Array:
    """``e`` (N, 6) = [rotation, translation] with ``T_true = T_estimated exp(e)``, for poses (N, 4, 4)."""
    return log(inverse(estimated) @ true)


def nees(residuals: Array, covariances: Array) -> Array:
    """Normalised estimation error squared (N,) of residuals (N, D) with covariances (N, D, D), positive definite."""
    whitened = np.linalg.solve(np.linalg.cholesky(covariances), residuals[..., None])[..., 0]
    return np.asarray((whitened**2).sum(axis=-1), np.float64)


def chi_square_band(dof: int, count: int = 1) -> tuple[float, float]:
    """Bounds between which the mean of `count` independent NEES of `dof` degrees of freedom lies.

    The sum of the `count` values has a χ² distribution of ``dof · count`` degrees of freedom; the band is two-sided and
    holds in 95 % of cases where the estimator is consistent. Values of one run are not independent: take the mean
    over runs (Monte Carlo), or read the band as a guide.
    """
    return chi_square_limit(dof * count, 0.025) / count, chi_square_limit(dof * count, 0.975) / count
