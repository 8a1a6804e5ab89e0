"""What an error of the rig's calibration does to measurements and poses, as data between the system's parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from slam.geometry.arrays import Array


@dataclass(frozen=True)
class CommonError:
    """What poses are off by through the rig's error: ``shares @ (scale @ c + known)``, with the same c for all poses.

    Attributes:
        shares: derivative (6, m) by errors that are the same for all poses, perturbing on the right.
        scale: these errors by ones of unit variance, c, as they are known now (m, n).
        known: the part of them that is known by now, but stays in poses of before (m,).
    """

    shares: Array = field(default_factory=lambda: np.zeros((6, 0)))
    scale: Array = field(default_factory=lambda: np.zeros((0, 0)))
    known: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def root(self) -> Array:
        """A square root (m, n + 1) of the errors' covariance; that the known part was not corrected counts as well."""
        return np.column_stack([self.scale, self.known])

    @property
    def covariance(self) -> Array:
        """What it adds to the pose's covariance (6, 6)."""
        root = self.shares @ self.root
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
