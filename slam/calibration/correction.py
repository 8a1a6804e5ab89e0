"""Corrections of pixels by a rig's parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.calibration.model import RigModel
from slam.data import StereoFeatures
from slam.geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class RigCorrection:
    """Maps measured pixels to those of an ideal rig."""

    model: RigModel  # the parameters' meaning
    parameters: Array  # their values (n,)

    def rows(self, z: Array) -> Array:
        """Corrected rectified rows (uL, vL, uR) (N, 3) of measured ones [px]; uR NaN stays NaN."""
        points = self.model.points(z)
        return self.model.rows(points + self.model.shift(points, self.parameters))

    def undone(self, z: Array) -> Array:
        """Measured rows (N, 3) of corrected ones: the inverse of `rows`."""
        corrected = points = self.model.points(z)
        for _ in range(4):  # 4: fixed-point iterations that undo a correction; each reduces the error some 30 times
            points = corrected - self.model.shift(points, self.parameters)
        return self.model.rows(points)

    def features(self, features: StereoFeatures) -> StereoFeatures:
        """Features with both pixels corrected."""
        uv_left, uv_right = self.pixels(features.uv_left, features.uv_right)
        return replace(features, uv_left=uv_left, uv_right=uv_right)

    def pixels(self, uv_left: Array, uv_right: Array) -> tuple[Array, Array]:
        """Corrected rectified pixels (N, 2) of measured ones; the right row keeps the remaining vertical disparity."""
        points = self.model.points(np.column_stack([uv_left, uv_right[:, 0]]))
        change = self.model.shift_with_vertical(points, self.parameters)
        z = self.model.rows(points + change[:, :3])
        return z[:, :2], np.column_stack([z[:, 2], z[:, 1] + uv_right[:, 1] - uv_left[:, 1] + change[:, 3]])


@dataclass(frozen=True, eq=False)
class Revision:
    """A change of the correction during a run, for measurements that have the earlier correction."""

    before: RigCorrection  # the corrections
    after: RigCorrection

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected again."""
        return self.after.rows(self.before.undone(z))
