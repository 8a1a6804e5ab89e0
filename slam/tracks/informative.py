"""Selects the matched landmarks most informative of the camera's motion, if not all are to be measured.

A measurement of landmark i adds ``A_iᵀ A_i`` to the information Λ of the camera's motion since the last frame, with
``A_i = R_i^{-1/2} J_i``: J the Jacobian by the pose, R the noise of the pixels and of the landmark. All measurements
cost the same, so those with the largest gain ``log det(I + A_i Λ⁻¹ A_iᵀ)`` are chosen greedily, a tenth of the number
per round, with gains conditioned on the earlier rounds. Chosen one by one, they would reach at least 63 % of the
largest possible total gain (Nemhauser, Wolsey and Fisher, 1978).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import Prediction
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.models import EstimatorModels


def most_informative(
    rig: StereoRig, models: EstimatorModels, prediction: Prediction, ids: NDArray[np.int64], positions: Array,
    dt: float, most: int,
) -> NDArray[np.intp]:  # fmt: skip
    """Rows of the `most` landmarks most informative of the motion, ascending; all if there are no more.

    Args:
        rig: the cameras.
        models: noise of the pixels and of the motion.
        prediction: of the back end, for the landmarks' uncertainty; landmarks not in it count as exact.
        ids: of the matched landmarks (K,).
        positions: of the landmarks (K, 3) in the world [m].
        dt: time since the last frame [s].
        most: how many to choose.
    """
    if len(ids) <= most:
        return np.arange(len(ids))
    local = transform(inverse(prediction.T_world_left), positions)
    J = rig.project_stereo(local)[1] @ points_by_pose(local)
    J[~np.isfinite(J).all(axis=(1, 2))] = 0.0
    motion = np.repeat(models.motion.velocity_variance(dt)[::-1], 3) * dt * dt  # [rotation, translation]
    variance = models.pixel_sigma**2 + _own_variance(prediction, ids, J, motion, models.pixel_sigma)
    return _greedy(J / np.sqrt(variance)[:, None, None], np.diag(1.0 / motion), most)


def _own_variance(prediction: Prediction, ids: NDArray[np.int64], J: Array, motion: Array, pixel_sigma: float) -> Array:
    """Variance (K,) [px²] that a landmark's own uncertainty adds to each pixel."""
    if not len(prediction.ids):
        return np.zeros(len(ids))
    order = np.argsort(prediction.ids)
    place = order[np.searchsorted(prediction.ids, ids, sorter=order).clip(0, len(order) - 1)]
    by_motion = (J[:, :2] * motion * J[:, :2]).sum(axis=(1, 2))
    innovation = np.trace(prediction.innovation[place], axis1=1, axis2=2)
    own = 0.5 * (innovation - by_motion) - pixel_sigma**2
    return np.where(prediction.ids[place] == ids, np.maximum(own, 0.0), 0.0)


def _greedy(A: Array, information: Array, most: int) -> NDArray[np.intp]:
    """Rows of A (K, 3, 6) that increase the log determinant of the information (6, 6) most."""
    free, chosen = np.ones(len(A), bool), np.zeros(len(A), bool)
    at_once = -(-most // 10)  # 10: rounds of the choice; more are closer to one by one
    while (missing := most - int(chosen.sum())) > 0:
        # One inverse (6, 6) serves all K rows.
        gains = np.linalg.det(np.eye(3) + A @ np.linalg.inv(information) @ np.swapaxes(A, 1, 2))
        best = np.argsort(np.where(free, -gains, np.inf), kind="stable")[: min(at_once, missing)]
        free[best], chosen[best] = False, True
        rows = A[best].reshape(-1, 6)
        information = information + rows.T @ rows
    return np.flatnonzero(chosen)
