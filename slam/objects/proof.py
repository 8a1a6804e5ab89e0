"""Whether a body has moved relative to the world: a test against the whole uncertainty of what its tracks measured.

The velocity on which the members' displacements from older to recent frames agree is known to within

- their own noise, whose size is that of their scatter about it (matches slide over a surface, depths err,
  limbs swing), so that the test is an F test, and
- the error of the camera's motion in between, as the rest of the scene tells it, which all members share: it does not
  fall with their number.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from slam.geometry.se3 import points_by_pose
from slam.objects.displacements import Displacements
from slam.objects.regions import Scene

PROVEN = 12.0  #: evidence from which a body has moved for certain: by chance once in 10¹² times
_ALLOWANCE = 3.0  # what a frame must bring besides, as the frames of a window say nearly the same
_MOST = 30.0  # numerics: of the evidence of a frame
_LEAST = 3  # members, for a scatter
_WEAK = 1e-9  # numerics: of information [1/m²]


def with_frame(evidence: float, moved: Displacements, scene: Scene) -> float:
    """The evidence that a body moves after one more frame: a cumulative sum of −log10 of the test's p-values.

    Args:
        evidence: before.
        moved: how far the members (N,) went.
        scene: the still world, as it appears to move.
    """
    n = len(moved.d)
    if n < _LEAST:
        return evidence
    lag = moved.lag[:, None, None]
    total = np.linalg.inv((lag**2 * moved.W).sum(axis=0) + _WEAK * np.eye(3))
    by_common = -lag * points_by_pose(moved.points)
    gap = moved.d - by_common @ scene.common
    weight = total @ (lag * moved.W)
    velocity = np.einsum("nij,nj->i", weight, gap)
    rest = gap - moved.lag[:, None] * velocity
    scatter = float(np.einsum("ni,nij,nj->", rest, moved.W, rest)) / (3 * n - 3)
    by_pose = np.einsum("nij,njk->ik", weight, by_common)
    covariance = max(scatter, 1.0) * total + by_pose @ scene.covariance @ by_pose.T
    test = float(velocity @ np.linalg.solve(covariance, velocity))
    chance = -np.log10(max(fdtrc(3, 3 * n - 3, test / 3.0), 10.0**-_MOST))
    return max(0.0, evidence + chance - _ALLOWANCE)
