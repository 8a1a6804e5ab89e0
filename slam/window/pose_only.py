"""The newest pose alone, by robust Gauss-Newton on reprojection errors: where the estimators of many poses start from.

They take one Gauss-Newton step or two for all variables together and have no defence against a poor start; so the new
pose is brought close first, with the landmarks held where they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.chi_square import chi_square_limits
from slam.data import BoolArray
from slam.geometry import kernels
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array
from slam.window import solver
from slam.window.problem import RelativePrior, Rows, Window
from slam.window.solver import row_distances
from slam.window.stereo import RectifiedStereo

_ROUNDS = 3  # numerics: of solving and gating
_ANY = RelativePrior.of_pose(np.eye(4), np.eye(6))


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """Landmarks, what was measured of them, and what was predicted."""

    stereo: RectifiedStereo  # the projection
    points: Array  # landmark positions (M, 3) in world coordinates
    z: Array  # measurements (M, 3), NaN where missing
    noise: Array  # covariances (M, 3, 3) of the residuals for a known pose: pixel noise and landmark uncertainty [px²]
    predicted: Array  # pose (4, 4)
    information: Array  # of the predicted pose (6, 6)
    probability: float  # share of good measurements that the gate shall let pass

    def window(self, T: Array) -> Window:
        """One free pose, at T (4, 4), with the prediction as prior, and known points."""
        n = len(self.points)
        rows = Rows(np.zeros(n, np.intp), np.arange(n), self.z, self.whiteners)
        prior = changed(_ANY, T=self.predicted, information=self.information)
        return Window(self.stereo, T[None], self.points, rows, known=np.ones(n, bool), prior=prior)

    @cached_property
    def whiteners(self) -> Array:
        """What scales residuals to unit variance (M, 3, 3); the third row is zero where there is no right pixel.

        With ``S = L Lᵀ`` the noise, ``L⁻¹``. Zero, so that the row does not count, where S is not positive definite:
        a landmark of which next to nothing is known in one direction, more than the digits of its covariance hold.
        """
        W = np.asarray(kernels.whiteners(self.noise))
        W[np.isnan(self.z[:, 2]), 2] = 0
        W[~np.isfinite(W).all(axis=(1, 2))] = 0
        return W

    def distances(self, T: Array) -> Array:
        """Squared distance of each measurement (M,) from what a pose (4, 4) predicts, see `row_distances`."""
        return row_distances(self.window(T))


def solve(problem: PoseProblem, start: Array) -> tuple[Array, BoolArray]:
    """Pose (4, 4) and which measurements (M,) agree with it: first robust, then least squares on what agrees.

    Raises LinAlgError where a value is not finite.
    """
    w = problem.window(start)
    rows = w.rows
    limits = chi_square_limits(2 + np.isfinite(problem.z[:, 2]), problem.probability)
    w = solver.solve(w, huber=1.5).window  # whitened; the pull of what is farther off grows no more
    used = row_distances(w) <= limits
    for _ in range(_ROUNDS):
        counts = np.where(used[:, None, None], rows.root, 0.0)
        w = solver.solve(w.at(w.poses, w.points, changed(rows, root=counts))).window
        again = row_distances(w.at(w.poses, w.points, rows)) <= limits
        if (again == used).all():
            break
        used = again
    return w.poses[0], used


def seen_from(T: Array, points: Array, own: Array) -> tuple[Array, Array]:
    """Points (M, 3) and their covariances (M, 3, 3) in the coordinates of a camera at T (4, 4)."""
    R = T[:3, :3]
    return (points - T[:3, 3]) @ R, R.T @ own @ R


def residual_noise(stereo: RectifiedStereo, sigma: float, local: Array, own: Array, z: Array) -> Array:
    """Covariances (M, 3, 3) of the residuals of measurements (M, 3) for a known pose [px²].

    The landmarks are at `local` (M, 3) in the camera's coordinates, with covariances `own` (M, 3, 3) where all poses
    are known. Pixel noise and the landmark's own uncertainty, linearised at the estimated or at the measured position,
    whichever gives the smaller covariance: close to the camera a small error of depth would explain any pixel.
    """
    return np.asarray(kernels.residual_noise(stereo.intrinsics, local, np.ascontiguousarray(own), z, sigma))
