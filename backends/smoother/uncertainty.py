"""How landmarks depend on the poses that measured them: refinement, covariances, and their Jacobians by these poses.

A landmark's position, given all poses, follows from its measurements alone: ``l = l(x_1, x_2, …) + e`` with
``cov(e) = σ² (ΣEᵀE)⁻¹`` and ``∂l/∂x_j = −(ΣEᵀE)⁻¹ E_jᵀF_j``, where E and F are the measurements' Jacobians by the
landmark and by the pose. A measurement depends on nothing but where the landmark stands in the camera, so
``F_j = −E_j G_j``, where G_j is how a point moves that is fixed to pose j; thus ``∂l/∂x_j = (ΣI)⁻¹ I_j G_j`` with the
information ``I_j = E_jᵀE_j``: each pose carries the landmark along by its share of the information. With the joint
covariance of the poses that gives every covariance asked for, with the correlations between poses and landmarks.
"""

from __future__ import annotations

import numpy as np

from backends.smoother import landmark_kernels as kernels
from backends.smoother.landmarks import Landmarks
from backends.smoother.measurement_log import Measurements
from backends.smoother.pose_set import PoseSet
from slam.data import IndexArray
from slam.geometry.se3 import Array, points_by_pose
from slam.window.stereo import RectifiedStereo

#: numerics: Landmarks are refined until a step would lessen their sum of squares by less than this, in at most so many.
_GAIN, _REFINEMENTS = 0.01, 10
_DAMPING = 0.01  # numerics: the first that is tried where a plain step fails, as a share of the information
_BEHIND = 1e4  # numerics: sum of squares of a measurement whose landmark lies behind the camera


def linearise(
    stereo: RectifiedStereo, sigma: float, poses: Array, measurements: Measurements, points: Array, rows: IndexArray
) -> tuple[Array, Array, Array]:
    """Linearise the measurements `rows` (M, K), −1 for none, of the landmarks at `points` (M, 3).

    Returns:
        the information of each measurement on its landmark (M, K, 3, 3), the gradient of all of a landmark together
        (M, 3), and their sum of squares (M,), to which each that has the landmark behind its camera adds `_BEHIND`.
    """
    information, gradient, squares, behind = kernels.information_of(
        stereo.intrinsics, stereo.rectified_rig.R_left, poses, measurements.frame, measurements.z, points, rows, sigma
    )
    return information, gradient, squares + _BEHIND * behind


def position_step(
    information: Array, gradient: Array, prior: Array, offset: Array, damping: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Gauss-Newton steps (M, 3) of the positions, their covariances (M, 3, 3) where all poses are known, and gains.

    `information` (M, 3, 3) and `gradient` (M, 3) are those of measurements, `prior` (M, 3, 3) is prior information
    about positions `offset` (M, 3) from the present ones. `damping` (M,) multiplies the information's diagonal. The
    gain (M,) is the decrease of the sum of squares by a step, to first order.
    """
    information = information + prior
    # Far points leave their depth nearly free: the little that is added keeps the inverse finite.
    diagonal = np.einsum("mii->mi", information)
    diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-12
    diagonal *= 1 + np.reshape(damping, (-1, 1))
    covariance = np.linalg.inv(information)
    gradient = gradient + (prior @ offset[:, :, None])[:, :, 0]
    step = (covariance @ gradient[:, :, None])[:, :, 0]
    return step, covariance, (gradient * step).sum(axis=1)


def refined(
    stereo: RectifiedStereo, sigma: float, poses: Array, measurements: Measurements, marks: Landmarks, slots: IndexArray
) -> Array:
    """Positions (M, 3) of landmarks that fit their recent measurements, by Levenberg-Marquardt for each landmark alone.

    A single step of Gauss-Newton from a distant start may end behind the camera.
    """
    start, rows, older = marks.position[slots], marks.recent[slots], marks.older[slots]
    prior, mean = marks.prior[slots], marks.mean[slots]

    def at(x: Array, m: IndexArray) -> tuple[Array, Array, Array]:
        information, gradient, squares = linearise(stereo, sigma, poses, measurements, x, rows[m])
        moved = start[m] - x
        gradient += (older[m] @ moved[:, :, None])[:, :, 0]
        squares += _form(older[m], moved) + _form(prior[m], mean[m] - x)
        return information.sum(axis=1) + older[m], gradient, squares

    x, damping, todo = start.copy(), np.zeros(len(slots)), np.arange(len(slots))
    information, gradient, cost = at(x, todo)
    for _ in range(_REFINEMENTS):
        step, _, gain = position_step(
            information[todo], gradient[todo], prior[todo], mean[todo] - x[todo], damping[todo]
        )
        todo, step = todo[gain > _GAIN], step[gain > _GAIN]
        if not len(todo):
            break
        tried = x[todo] + step
        information_new, gradient_new, cost_new = at(tried, todo)
        better = cost_new < cost[todo]
        rows_better = todo[better]
        x[rows_better], cost[rows_better] = tried[better], cost_new[better]
        information[rows_better], gradient[rows_better] = information_new[better], gradient_new[better]
        damping[todo] = np.where(better, 0.1 * damping[todo], np.maximum(10 * damping[todo], _DAMPING))
    return x


def _form(A: Array, x: Array) -> Array:
    """``xᵀ A x`` (M,) for A (M, 3, 3) and x (M, 3)."""
    return np.einsum("mi,mij,mj->m", x, A, x)


def by_poses(known: PoseSet, measurements: Measurements, landmarks: Landmarks, slots: IndexArray) -> Array:
    """Jacobians (M, 3, 6 W) of landmark positions by poses of the set.

    A measurement from a pose outside the set counts for the next pose of the set, as if both were fixed to each other.
    Older measurements that are no longer kept count for the pose next to the oldest kept one. A prior depends on no
    pose.
    """
    return np.asarray(kernels.carried_by(
        known.frames, known.poses, measurements.frame, landmarks.position[slots], landmarks.recent[slots],
        landmarks.information[slots], landmarks.older[slots], landmarks.covariance[slots],
    ))  # fmt: skip


class WindowJacobians:
    """`by_poses` for one set of poses, cached for each landmark.

    Args:
        window: the poses.
        slots: number of slots in the map.
    """

    def __init__(self, window: PoseSet, slots: int) -> None:
        self.window = window
        self._known = np.zeros(slots, bool)
        self._jacobians = np.empty((slots, 3, 6 * len(window)))

    def of(self, measurements: Measurements, landmarks: Landmarks, slots: IndexArray) -> Array:
        """Jacobians (M, 3, 6 W) of landmark positions."""
        missing = slots[~self._known[slots]]
        if len(missing):
            self._jacobians[missing] = by_poses(self.window, measurements, landmarks, missing)
            self._known[missing] = True
        return self._jacobians[slots]


def moved_with_pose(T: Array, points: Array) -> Array:
    """How points (M, 3) move that are fixed to a pose (4, 4), by its perturbation (M, 3, 6)."""
    return np.asarray(-T[:3, :3] @ points_by_pose((points - T[:3, 3]) @ T[:3, :3]))


def quadratic(A: Array, P: Array) -> Array:
    """``A P Aᵀ`` (M, k, k) for A (M, k, n), symmetric to the last digit."""
    count, k, n = A.shape
    Q = (A.reshape(count * k, n) @ P).reshape(count, k, n) @ np.swapaxes(A, 1, 2)
    return np.asarray(0.5 * (Q + np.swapaxes(Q, 1, 2)))
