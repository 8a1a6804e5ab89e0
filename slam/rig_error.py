"""Effects of the rig's calibration error on measurements and poses, as data between the system's parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from slam.geometry.arrays import Array


@dataclass(frozen=True, eq=False)
class CommonError:
    """Error of poses due to the rig's error: ``jacobian @ root @ c``, with the same c for all poses.

    If the correction has changed since a pose was estimated, the pose still contains the difference. It is one column
    of `root`: its effect on the pose is only known from a model of the estimator, so it counts as an error, too.
    """

    jacobian: Array = field(default_factory=lambda: np.zeros((6, 0)))  # of the pose by the m shared errors (6, m)
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of these by c (m, n), which has unit variance

    @property
    def covariance(self) -> Array:
        """What it adds to the pose's covariance (6, 6)."""
        S = self.jacobian @ self.root
        return np.asarray(S @ S.T)


class Revision(Protocol):
    """A change of the rig's correction during a run, for measurements that have the earlier correction."""

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected again."""
        ...


class Correction(Revision, Protocol):
    """A correction of measurements by the present estimate of the rig's error."""

    def undone(self, z: Array) -> Array:
        """Measured rows (N, 3) of corrected ones: the inverse of `rows`."""
        ...
