"""What both back ends do where most observations contradict the prediction: then the prediction itself is wrong."""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc

from slam.chi_square import chi_square_limit
from slam.geometry.pnp import find_consensus
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

ENOUGH = 6  #: observations whose agreement can be tested
HEEDED = 3  #: one in so many observations is enough to agree with a prediction
CONFIRMED = 5  #: observations that agree on a pose by more than chance: three fix it
INFLATION = (3.0, 10.0)  #: process noise that is tried where they disagree, in standard deviations of the usual one
_HYPOTHESES = 200  # cost: poses that are tried in the search for that on which the observations agree
_AS_NEW = 2.0  # variance of an innovation, in that of the pixels, where the landmark is as uncertain as a new one


def landmarks_pose(
    rig: StereoRig, points: Array, z: Array, models: EstimatorModels, T_world_left: Array, seed: int
) -> Array | None:
    """The pose (4, 4) on which most landmarks agree, and at least five; None where there is none.

    Args:
        rig: the cameras.
        points: the landmarks (M, 3) in the world [m].
        z: measurements (M, 3) = (uL, vL, uR) in the rig's own pixels.
        models: pixel noise and gate.
        T_world_left: pose (4, 4) to begin with.
        seed: of the random choice.
    """
    threshold = models.pixel_sigma * np.sqrt(_AS_NEW * chi_square_limit(3, models.gate_probability))
    found = find_consensus(rig, points, z, T_world_left, float(threshold), _HYPOTHESES, seed)
    enough = found.inliers.sum() >= max(CONFIRMED, (len(z) + 1) // 2)
    return found.T_world_left if enough and np.isfinite(found.T_world_left).all() else None


def share_by_chance(rejected: Array, limit: float) -> float:
    """The share of wrong observations that passes a gate.

    Wrong observations are taken to be spread about their predictions as those that are rejected.

    Args:
        rejected: squared Mahalanobis distances (R,) of the rejected observations, χ² with three degrees of freedom.
        limit: the gate.
    """
    median = chi_square_limit(3, 0.5)
    spread = float(np.median(rejected)) / median  # in units of the innovation covariances
    return float(gammainc(1.5, limit / spread / 2))
