"""What marginalised variables leave behind: a prior on the variables that they touched, relative to one of the poses.

A run goes on for longer than its place in the world is known well, so what stays may still move by metres as one. A
linear prior on each variable would then be off by the square of the turn times the distance, and would pull a stiff
block of poses and landmarks out of shape. So the variables are held relative to the oldest pose that stays: the prior
does not change where all of them move together, and what is known of the place in the world is held by that pose alone.

With ξ_i the perturbations of poses (on the right) and landmarks (in world axes), r the reference pose and
``M_i = T_r⁻¹ T_i``, the relative perturbations are ``δ_r = ξ_r``, ``δ_i = ξ_i − Ad(M_i⁻¹) ξ_r`` for poses, and for a
landmark at p in the reference camera ``δ_l = R_rᵀ ξ_l + [p]× ω_r − v_r``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from backends.smoother.reference_pose import ReferencePose
from backends.smoother.solver import FAILURES, SolverError
from backends.smoother.variables import size_of
from slam.geometry.se3 import Array, adjoint, hat, inverse, nearest_rotation, points_by_pose

#: numerics: Added to the information, as a share of its diagonal, until it is positive definite in double precision.
_JITTER = (1e-13, 1e-11, 1e-9)
_NOTHING = 1e-12  # numerics: information [1/m², 1/rad²] that is none


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """A Gaussian on poses and landmarks relative to the first of the poses, and on that pose in the world.

    Attributes:
        poses: pose variables; the first is the reference.
        landmarks: landmark variables.
        T_reference: where the reference pose stood (4, 4).
        T_relative: where the other poses stood before it (P − 1, 4, 4).
        local: where the landmarks stood before it (L, 3) [m].
        R: square root of the information (n, n), upper triangular, n = 6 P + 3 L.
        d: ``R δ = d`` at the mean (n,).
    """

    poses: tuple[int, ...]
    landmarks: tuple[int, ...]
    T_reference: Array
    T_relative: Array
    local: Array
    R: Array
    d: Array

    @property
    def keys(self) -> tuple[int, ...]:
        """All variables, in the order of the columns."""
        return self.poses + self.landmarks

    def factor(self) -> gtsam.NonlinearFactor:
        """The prior for the solver."""
        # gtsam.Pose3 of arrays that are nearly rigid keeps their error: these come from gtsam itself.
        reference = gtsam.Pose3(self.T_reference).inverse()
        relative = [gtsam.Pose3(T).inverse() for T in self.T_relative]
        columns = 6 * len(self.poses)
        by_landmark = self.R[:, columns:].reshape(len(self.R), -1, 3)

        def error(_this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Any:
            poses = [values.atPose3(key) for key in self.poses]
            T, back = poses[0].matrix(), poses[0].inverse()
            R_world_reference = T[:3, :3]
            moved = reference.compose(poses[0])
            delta = np.empty(len(self.R))
            delta[:6] = gtsam.Pose3.Logmap(moved)
            for i, (before, now) in enumerate(zip(relative, poses[1:]), start=1):
                delta[6 * i : 6 * i + 6] = gtsam.Pose3.Logmap(before.compose(back.compose(now)))
            points = np.array([values.atPoint3(key) for key in self.landmarks]).reshape(-1, 3)
            local = (points - T[:3, 3]) @ R_world_reference
            delta[columns:] = (local - self.local).ravel()
            if jacobians is not None:
                by_reference = self.R[:, :6] @ gtsam.Pose3.LogmapDerivative(delta[:6])
                for i, now in enumerate(poses[1:], start=1):
                    part = slice(6 * i, 6 * i + 6)
                    J = self.R[:, part] @ gtsam.Pose3.LogmapDerivative(delta[part])
                    by_reference -= J @ now.inverse().compose(poses[0]).AdjointMap()
                    jacobians[i] = J
                if len(local):
                    carried = points_by_pose(local)
                    by_reference += self.R[:, columns:] @ carried.reshape(-1, 6)
                    turned = by_landmark @ R_world_reference.T
                    for i in range(len(local)):
                        jacobians[len(poses) + i] = turned[:, i]
                jacobians[0] = by_reference
            return self.R @ delta - self.d

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(self.R)), list(self.keys), error)

    def held(self, T_reference: Array) -> ReferencePose:
        """The reference pose held where it stands, `T_reference` (4, 4)."""
        known = self.of_reference()
        information = known.R.T @ known.R
        return ReferencePose(self.poses[0], T_reference, information, np.linalg.inv(information))

    def of_reference(self) -> MarginalPrior:
        """What is known of the reference pose alone."""
        backwards = np.arange(len(self.R))[::-1]
        R, d = self.R[:, backwards], self.d
        H, b = _schur(R.T @ R, R.T @ d, len(R) - 6)
        root = _root(H[::-1, ::-1])
        d = solve_triangular(root, b[::-1], trans="T")
        return MarginalPrior(self.poses[:1], (), self.T_reference, self.T_relative[:0], self.local[:0], root, d)


def reference_prior(key: int, T: Array, covariance: Array) -> MarginalPrior:
    """What is known of one pose alone: that it is T (4, 4) with a covariance (6, 6)."""
    T = gtsam.Pose3(gtsam.Rot3(nearest_rotation(T[:3, :3])), T[:3, 3]).matrix()
    R = _root(np.linalg.inv(covariance))
    return MarginalPrior((key,), (), T, np.zeros((0, 4, 4)), np.zeros((0, 3)), R, np.zeros(6))


def marginal_prior(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaving: Sequence[int], staying: Sequence[int]
) -> MarginalPrior:
    """Marginalise the variables `leaving` out of `factors`.

    Args:
        factors: all factors that touch what leaves.
        values: of all variables; everything is linearised there.
        leaving: variables to marginalise.
        staying: all other variables of the factors: poses from the oldest on, then landmarks.

    Raises:
        SolverError: gtsam cannot linearise them, or the information is not positive.
    """
    ordering = gtsam.Ordering()
    for key in (*leaving, *staying):
        ordering.push_back(key)
    try:
        augmented = factors.linearize(values).augmentedHessian(ordering)
    except FAILURES as error:
        raise SolverError(f"gtsam: {' '.join(str(error).split())[:200]}") from error
    if not np.isfinite(augmented).all():
        raise SolverError("the information of what leaves is not finite")
    gone = sum(map(size_of, leaving))
    information, vector = _schur(augmented[:-1, :-1], augmented[:-1, -1], gone)
    poses = tuple(key for key in staying if size_of(key) == 6)
    landmarks = tuple(staying[len(poses) :])
    T = np.array([values.atPose3(key).matrix() for key in poses])
    T_relative = inverse(T[0]) @ T[1:]
    local = (np.array([values.atPoint3(key) for key in landmarks]).reshape(-1, 3) - T[0, :3, 3]) @ T[0, :3, :3]
    # ξ = C δ
    n = len(information)
    C = np.eye(n)
    for i, M in enumerate(T_relative, start=1):
        C[6 * i : 6 * i + 6, :6] = adjoint(inverse(M))
    for i, p in enumerate(local):
        part = slice(6 * len(poses) + 3 * i, 6 * len(poses) + 3 * i + 3)
        C[part, :6] = T[0, :3, :3] @ np.concatenate([-hat(p), np.eye(3)], axis=1)
        C[part, part] = T[0, :3, :3]
    R = _root(C.T @ information @ C)
    d = solve_triangular(R, C.T @ vector, trans="T")
    return MarginalPrior(poses, landmarks, T[0], T_relative, local, R, d)


def _schur(H: Array, b: Array, gone: int) -> tuple[Array, Array]:
    """Information and information vector of the rest once the first `gone` rows are marginalised."""
    L = _root(H[:gone, :gone])
    W = solve_triangular(L, H[:gone, gone:], trans="T")
    w = solve_triangular(L, b[:gone], trans="T")
    return H[gone:, gone:] - W.T @ W, b[gone:] - W.T @ w


def _root(H: Array) -> Array:
    """Upper triangular R with ``Rᵀ R = H``; where nothing is known of a row, as little as can be is added.

    Raises:
        SolverError: H is not positive definite, by more than rounding.
    """
    H = 0.5 * (H + H.T)
    diagonal = np.diag(H)
    scale = np.sqrt(np.where(diagonal > _NOTHING, diagonal, 1.0))
    S = H / np.outer(scale, scale)
    for jitter in _JITTER:
        try:
            return np.asarray(cholesky(S + jitter * np.eye(len(S)))) * scale
        except LinAlgError:
            continue
    raise SolverError("the information of what leaves is not positive definite")
