"""What back ends do if most observations contradict the prediction, which then must be wrong itself."""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc

from slam.chi_square import chi_square_limit
from slam.geometry.pnp import find_consensus
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.models import EstimatorModels

MIN_OBSERVATIONS = 6  #: fewest observations whose agreement is tested
ONE_AGREES_IN = 3  #: a prediction holds if at least one in so many observations agrees with it
MIN_CONSENSUS = 5  #: fewest observations that agree on a pose by more than chance; three determine it
INFLATION = (3.0, 10.0)  #: factors on the process noise's standard deviation tried if observations disagree
_HYPOTHESES = 200  # cost: poses tried in the search for one on which the observations agree
_AS_NEW = 2.0  # innovation variance of a landmark as uncertain as a new one, in units of the pixel variance


def landmarks_pose(
    rig: StereoRig, points: Array, z: Array, models: EstimatorModels, T_world_left: Array, seed: int
) -> Array | None:
    """The pose (4, 4) on which most landmarks agree; None if fewer than five agree.

    Args:
        rig: the cameras.
        points: the landmarks (M, 3) in the world [m].
        z: measurements (M, 3) = (uL, vL, uR) in the rig's own pixels.
        models: pixel noise and gate.
        T_world_left: initial guess of the pose (4, 4).
        seed: of the random choice.
    """
    threshold = models.pixel_sigma * np.sqrt(_AS_NEW * chi_square_limit(3, models.gate_probability))
    found = find_consensus(rig, points, z, T_world_left, float(threshold), _HYPOTHESES, seed)
    enough = found.inliers.sum() >= max(MIN_CONSENSUS, (len(z) + 1) // 2)
    return found.T_world_left if enough and np.isfinite(found.T_world_left).all() else None


def share_by_chance(rejected: Array, limit: float) -> float:
    """The share of wrong observations that pass a gate by chance.

    The rejected observations show how widely wrong ones scatter about their predictions.

    Args:
        rejected: squared Mahalanobis distances (R,) of the rejected observations, χ² with three degrees of freedom.
        limit: the gate.
    """
    median = chi_square_limit(3, 0.5)
    spread = float(np.median(rejected)) / median  # in units of the innovation covariances
    return float(gammainc(1.5, limit / spread / 2))
