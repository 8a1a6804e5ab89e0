"""Least-squares alignment of two sets of positions: rigid, with or without scale, in space or in the plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.errors import TrajectoryError
from slam.geometry.se3 import Array, nearest_rotation, so3_exp
from slam.geometry.trajectory import Trajectory

_STILL = 1e-12  # numerics: [m²] product of the two spreads: less than a micrometre each is no motion


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity ``target ≈ scale R source + t``.

    Attributes:
        R: proper rotation (D, D).
        t: translation (D,) [m].
        scale: 1 where it was not estimated.
        rank: number of directions that the positions determine; a turn about a straight path (rank 1) or of a path
            that stands still (rank 0) is not determined by them.
    """

    R: Array
    t: Array
    scale: float
    rank: int

    def apply(self, positions: Array) -> Array:
        """Aligned positions (N, D)."""
        return np.asarray(self.scale * positions @ self.R.T + self.t, np.float64)

    def apply_trajectory(self, trajectory: Trajectory) -> Trajectory:
        """The aligned trajectory: positions by the similarity, orientations by its rotation."""
        poses = trajectory.poses.copy()
        poses[:, :3, :3] = self.R @ poses[:, :3, :3]
        poses[:, :3, 3] = self.apply(trajectory.positions)
        return Trajectory(trajectory.stamps, poses)


def align_positions(
    source: Array, target: Array, with_scale: bool = False, orientations: Array | None = None
) -> Alignment:
    """The similarity that takes positions `source` (N, D) nearest to `target` (N, D), D = 2 or 3 (Umeyama 1991).

    Where the positions leave a turn open (fewer than three, on one line, standing still), `orientations` (N, 3, 3)
    decide it: the products ``R_target R_sourceᵀ``, whose mean the rotation is brought nearest to. Without them it is
    the turn nearest to none. The result is a proper rotation in every case, and depends on nothing but the input.

    Raises:
        TrajectoryError: shapes differ, there is no position, or one is not finite or impossibly large.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if source.shape != target.shape or source.ndim != 2 or not len(source):
        raise TrajectoryError(f"alignment: positions {source.shape} and {target.shape} do not go together")
    if not np.abs([source, target]).max() <= 1e100:  # 1e100: position [m] whose square is a number
        raise TrajectoryError("alignment: a position is not finite, or impossibly large")
    centre_s, centre_t = source.mean(axis=0), target.mean(axis=0)
    s, t, dimensions = source - centre_s, target - centre_t, source.shape[1]
    guide = np.eye(dimensions) if orientations is None else orientations.mean(axis=0)
    U, d, Vt = np.linalg.svd(t.T @ s / len(s))
    signs = np.ones(dimensions)  # the weakest direction is turned round where U Vᵀ is a mirror
    signs[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    if np.sqrt((s**2).mean() * (t**2).mean()) < _STILL or d[0] < _STILL:
        rank, R = 0, nearest_rotation(guide)
    else:
        # 1e-12: second singular value by the first, below which positions lie on a line
        rank, R = int((d > 1e-12 * d[0]).sum()), U @ np.diag(signs) @ Vt
        if rank == 1 and dimensions == 3:
            R = _turn_about(U[:, 0], R, guide)
    scale = float((d * signs).sum() / (s**2).sum(axis=1).mean()) if with_scale and rank else 1.0
    return Alignment(R, centre_t - scale * R @ centre_s, scale, rank)


def align(estimate: Trajectory, truth: Trajectory, with_scale: bool = False) -> Alignment:
    """The alignment of an estimated path with the true one, row by row; orientations decide what is left open.

    Raises:
        TrajectoryError: the lengths differ, or there is no pose.
    """
    if len(estimate) != len(truth):
        raise TrajectoryError(f"alignment: {len(estimate)} estimated poses, {len(truth)} true ones")
    orientations = truth.poses[:, :3, :3] @ np.swapaxes(estimate.poses[:, :3, :3], 1, 2)
    return align_positions(estimate.positions, truth.positions, with_scale, orientations)


def _turn_about(axis: Array, R: Array, guide: Array) -> Array:
    """``Rot(axis, φ) R`` with the φ that brings it nearest to `guide` in the Frobenius norm."""
    N = guide @ R.T
    skew = np.array([N[2, 1] - N[1, 2], N[0, 2] - N[2, 0], N[1, 0] - N[0, 1]])
    sine, cosine = axis @ skew, np.trace(N) - axis @ N @ axis
    if np.hypot(sine, cosine) < 1e-12:  # the guide says nothing about this turn
        return R
    return np.asarray(so3_exp(axis * np.arctan2(sine, cosine)) @ R, np.float64)
