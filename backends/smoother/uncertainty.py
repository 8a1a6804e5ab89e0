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

from backends.smoother.landmarks import Landmarks
from backends.smoother.measurement_log import Measurements
from backends.smoother.pose_set import PoseSet
from backends.smoother.stereo import RectifiedStereo
from slam.data import IndexArray
from slam.geometry.se3 import Array

#: numerics: Landmarks are refined until a step would lessen their sum of squares by less than this, in at most so many.
_GAIN, _REFINEMENTS = 0.01, 10
_DAMPING = 0.01  # numerics: the first that is tried where a plain step fails, as a share of the information
_BEHIND = 1e4  # numerics: sum of squares of a measurement whose landmark lies behind the camera


def linearise(
    stereo: RectifiedStereo, sigma: float, poses: Array, measurements: Measurements, points: Array, rows: IndexArray
) -> tuple[Array, Array]:
    """Linearise the measurements `rows` (M, K), −1 for none, of the landmarks at `points` (M, 3).

    Returns:
        Jacobians E (M, K, 3, 3) by the landmarks and residuals (M, K, 3), measured less predicted, both in units of
        the pixel noise; what is missing is zero.
    """
    shape = rows.shape
    T = poses[measurements.frame[rows]].reshape(-1, 4, 4)
    R = T[:, :3, :3]
    offset = np.repeat(points, shape[1], axis=0) - T[:, :3, 3]
    h, J = stereo.project((offset[:, None, :] @ R)[:, 0])
    r = measurements.z[rows].reshape(-1, 3) - h
    missing = ~np.isfinite(r) | (rows.reshape(-1, 1) < 0)
    r[missing] = 0
    J[missing] = 0
    E = J @ np.swapaxes(R, 1, 2)
    return E.reshape(*shape, 3, 3) / sigma, r.reshape(*shape, 3) / sigma


def position_step(
    E: Array, r: Array, older: Array, moved: Array, prior: Array, offset: Array, damping: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Gauss-Newton steps (M, 3) of the positions, their covariances (M, 3, 3) where all poses are known, and gains.

    `older` (M, 3, 3) is the information of measurements that are not linearised here, about positions that are `moved`
    (M, 3) from the present ones; `prior` (M, 3, 3) is prior information about positions `offset` (M, 3) from these.
    `damping` (M,) multiplies the information's diagonal. The gain (M,) is the decrease of the sum of squares by a step,
    to first order.
    """
    count, width = r.shape[:2]
    E = E.reshape(count, 3 * width, 3)
    Et = np.swapaxes(E, 1, 2)
    information = Et @ E + older + prior
    # Far points leave their depth nearly free: the little that is added keeps the inverse finite.
    information += np.eye(3) * (1e-12 * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-12)
    information += np.eye(3) * information * np.reshape(damping, (-1, 1, 1))
    covariance = np.linalg.inv(information)
    gradient = Et @ r.reshape(count, 3 * width, 1) + older @ moved[:, :, None] + prior @ offset[:, :, None]
    step = covariance @ gradient
    return step[:, :, 0], covariance, (gradient * step).sum(axis=(1, 2))


def refined(
    stereo: RectifiedStereo, sigma: float, poses: Array, measurements: Measurements, marks: Landmarks, slots: IndexArray
) -> Array:
    """Positions (M, 3) of landmarks that fit their recent measurements, by Levenberg-Marquardt for each landmark alone.

    A single step of Gauss-Newton from a distant start may end behind the camera.
    """
    start, rows, older = marks.position[slots], marks.recent[slots], marks.older[slots]
    prior, mean = marks.prior[slots], marks.mean[slots]

    def at(x: Array, m: IndexArray) -> tuple[Array, Array, Array]:
        E, r = linearise(stereo, sigma, poses, measurements, x, rows[m])
        behind = (rows[m] >= 0) & (E == 0).all(axis=(2, 3))
        cost = (r**2).sum(axis=(1, 2)) + _form(older[m], start[m] - x) + _form(prior[m], mean[m] - x)
        return E, r, cost + _BEHIND * behind.sum(axis=1)

    x, damping, todo = start.copy(), np.zeros(len(slots)), np.arange(len(slots))
    E, r, cost = at(x, todo)
    for _ in range(_REFINEMENTS):
        step, _, gain = position_step(
            E[todo], r[todo], older[todo], start[todo] - x[todo], prior[todo], mean[todo] - x[todo], damping[todo]
        )
        todo, step = todo[gain > _GAIN], step[gain > _GAIN]
        if not len(todo):
            break
        tried = x[todo] + step
        E_new, r_new, cost_new = at(tried, todo)
        better = cost_new < cost[todo]
        rows_better = todo[better]
        x[rows_better], E[rows_better], r[rows_better] = tried[better], E_new[better], r_new[better]
        cost[rows_better] = cost_new[better]
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
    rows, count, width = landmarks.recent[slots], len(slots), len(known)
    if not width:
        return np.zeros((count, 3, 0))
    frames = measurements.frame[rows] if measurements.count else np.zeros_like(rows)
    place = np.minimum(np.searchsorted(known.frames, frames), width - 1)
    share = (place[:, None, :] == np.arange(width)[None, :, None]).astype(float)
    information = (share @ landmarks.information[slots].reshape(*rows.shape, 9)).reshape(count, width, 3, 3)
    oldest = np.where(rows >= 0, place, width - 1).min(axis=1)
    information[np.arange(count), oldest] += landmarks.older[slots]
    by_pose = landmarks.covariance[slots][:, None] @ information @ _moved_with(known.poses, landmarks.position[slots])
    return np.swapaxes(by_pose, 1, 2).reshape(count, 3, 6 * width)


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


def _moved_with(poses: Array, points: Array) -> Array:
    """G (M, W, 3, 6): how points (M, 3) move that are fixed to poses (W, 4, 4), by the poses' perturbation."""
    R = poses[None, :, :3, :3]
    x, y, z = np.moveaxis(points[:, None] - poses[None, :, :3, 3], 2, 0)
    zero = np.zeros_like(x)
    turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=2).reshape(*x.shape, 3, 3)  # −hat of the offset
    return np.concatenate([turn @ R, np.broadcast_to(R, turn.shape)], axis=3)


def moved_with_pose(T: Array, points: Array) -> Array:
    """How points (M, 3) move that are fixed to a pose (4, 4), by its perturbation (M, 3, 6)."""
    return _moved_with(T[None], points)[:, 0]


def quadratic(A: Array, P: Array) -> Array:
    """``A P Aᵀ`` (M, k, k) for A (M, k, n), symmetric to the last digit."""
    count, k, n = A.shape
    Q = (A.reshape(count * k, n) @ P).reshape(count, k, n) @ np.swapaxes(A, 1, 2)
    return np.asarray(0.5 * (Q + np.swapaxes(Q, 1, 2)))
