"""What an error of the rig's calibration does to measurements and poses, as data between the system's parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from slam.geometry.arrays import Array


@dataclass(frozen=True)
class CommonError:
    """What poses are off by through the rig's error: ``shares @ scale @ c``, with the same c for all poses.

    What has become known of the error since a pose was made, and stays in it, is one column of `scale`: how far the
    pose moves by it is known from a model of the estimator alone, and counts as an error, too.

    Attributes:
        shares: derivative (6, m) by errors that are the same for all poses, perturbing on the right.
        scale: these errors by ones of unit variance, c, as they are known now (m, n).
    """

    shares: Array = field(default_factory=lambda: np.zeros((6, 0)))
    scale: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def covariance(self) -> Array:
        """What it adds to the pose's covariance (6, 6)."""
        root = self.shares @ self.scale
        return np.asarray(root @ root.T)


class Correction(Protocol):
    """What is known of the rig's error, for whoever holds measurements."""

    def rows(self, z: Array) -> Array:
        """Corrected rectified rows (uL, vL, uR) (N, 3) of measured ones [px]."""
        ...

    def undone(self, z: Array) -> Array:
        """Measured rows (N, 3) of corrected ones: the inverse of `rows`."""
        ...


class Revision(Protocol):
    """A change of the rig's correction in the course of a run, for measurements that were corrected as before."""

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected anew."""
        ...
