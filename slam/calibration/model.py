"""The possible errors of a stereo calibration, and how each moves pixels: linear about the calibration as delivered.

Coordinates are those of the rectified rig: x, y from the principal point in focal lengths, d the disparity in focal
lengths (inverse depth times the baseline). A parameter is the *correction* that takes what was measured to what an
ideal rig would have measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.calibration import kernels
from slam.data import StereoFeatures
from slam.geometry.arrays import changed
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array

#: Corrections of one camera: principal point, focal length, its ratio of height to width, radial (cubic and quintic)
#: and tangential distortion.
LENS = ("cx", "cy", "f", "aspect", "k1", "k2", "p1", "p2")

#: How the right camera stands to the left: the rotation about its x, y and z axis that makes it parallel; the
#: direction of the baseline from left to right, down and forward for each unit along the rows.
POSE = ("pitch", "yaw", "roll", "down", "forward")

_UNITS = {"cx": "focal lengths", "cy": "focal lengths", "pitch": "rad", "yaw": "rad", "roll": "rad"}

#: Products of Legendre polynomials in x and y, up to these degrees, for what no lens model holds. Constant and linear
#: ones are left out: `LENS` and `POSE` have them.
_DEGREES = 5, 3
RESIDUAL = tuple((i, j) for i in range(_DEGREES[0] + 1) for j in range(_DEGREES[1] + 1) if i + j > 1)


class RigModel:
    """The parameters of a rig's error, and the fields that they make.

    The order is: left camera (`LENS`), right camera (the same), `POSE`. In addition, there are residual fields, of
    which only the size is known: they are not corrected, but make the parameters less certain.
    """

    names = (*(f"{side}_{name}" for side in ("left", "right") for name in LENS), *POSE)
    units = tuple(_UNITS.get(name.removeprefix("left_").removeprefix("right_"), "1") for name in names)

    def __init__(self, rig: StereoRig) -> None:
        self.rig = rig
        rectified_rig = rig.rectified.rig
        self.focal = float(rectified_rig.left.fu)
        self.origin = np.array([rectified_rig.left.u0, rectified_rig.left.v0])
        self.right_u0 = rectified_rig.right.u0
        half = 0.5 * np.array([rig.width - 1, rig.height - 1])
        self._centre, self._half = (half - self.origin) / self.focal, half / self.focal

    def far(self) -> Array:
        """Points at infinity ``(x, y, 0)`` (105, 3) [px] spread evenly over the left image."""
        x, y = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 7))
        xy = self._centre + self._half * np.column_stack([x.ravel(), y.ravel()])
        return self.focal * np.column_stack([xy, np.zeros(len(xy))])

    def points(self, z: Array) -> Array:
        """Points ``(x, y, d)`` (N, 3) [px from the principal point] of rectified rows (uL, vL, uR) (N, 3)."""
        xy = z[:, :2] - self.origin
        return np.column_stack([xy, xy[:, 0] - (z[:, 2] - self.right_u0)])

    def rows(self, points: Array) -> Array:
        """The inverse of `points`."""
        u = points[:, :2] + self.origin
        return np.column_stack([u, points[:, 0] - points[:, 2] + self.right_u0])

    def field(self, points: Array) -> Array:
        """Change (N, 4, n) [px] by the parameters, of points ``(x, y, d)`` (N, 3) [px] and of their vertical disparity.

        With the right camera's true direction ``(x - d, y)`` and the baseline ``(1, down, forward)``, the true d is
        ``x_left - x_right`` plus ``forward · d · x_right``, and the vertical disparity, right row less left row, which
        an ideal rig does not have, grows by ``d · (forward · y - down)``. Rows of x and y are finite where d is not.

        A shift of both principal points looks almost like a rotation of the whole rig, and neither is known well. Lest
        the pose rotate with each revision, the ideal rig is rotated such that the left image as a whole does not move.
        """
        field, n = kernels.field(np.ascontiguousarray(points, float), self.focal), len(self.names)
        return np.asarray(field[:, :, :n] + field[:, :, n:] @ self._gauge)

    def shift(self, points: Array, parameters: Array) -> Array:
        """Change (N, 4) [px] of points ``(x, y, d)`` (N, 3) [px] and of vertical disparities by parameters (n,)."""
        amounts = np.concatenate([parameters, self._gauge @ parameters])
        return np.asarray(kernels.shift(np.ascontiguousarray(points, float), self.focal, amounts))

    @cached_property
    def _gauge(self) -> Array:
        """Rotation of the ideal rig (3, n) [rad] that cancels the left image's mean displacement by the parameters."""
        n = len(self.names)
        rows = kernels.field(self.far(), self.focal)[:, :2].reshape(-1, n + 3)
        return -np.asarray(np.linalg.lstsq(rows[:, n:], rows[:, :n], rcond=None)[0])

    def residual_field(self, points: Array) -> Array:
        """As `field`, by the residual fields (N, 4, m): of x and y of the left camera, then of the right one."""
        points = np.ascontiguousarray(points, float)
        return np.asarray(kernels.residual_field(points, self.focal, self._centre, self._half, _DEGREES))


@dataclass(frozen=True, eq=False)
class RigCorrection:
    """Maps measured pixels to those of an ideal rig."""

    model: RigModel  # the parameters' meaning
    parameters: Array  # their values (n,)

    def rows(self, z: Array) -> Array:
        """Corrected rectified rows (uL, vL, uR) (N, 3) of measured ones [px]; uR NaN stays NaN."""
        points = self.model.points(z)
        return self.model.rows(points + self.model.shift(points, self.parameters)[:, :3])

    def undone(self, z: Array) -> Array:
        """Measured rows (N, 3) of corrected ones: the inverse of `rows`."""
        corrected = points = self.model.points(z)
        for _ in range(4):  # 4: fixed-point iterations that undo a correction; each reduces the error some 30 times
            points = corrected - self.model.shift(points, self.parameters)[:, :3]
        return self.model.rows(points)

    def features(self, features: StereoFeatures) -> StereoFeatures:
        """Features with both pixels corrected; the right row keeps the remaining vertical disparity."""
        left, right = features.uv_left, features.uv_right
        points = self.model.points(np.column_stack([left, right[:, 0]]))
        change = self.model.shift(points, self.parameters)
        z, vertical = self.model.rows(points + change[:, :3]), right[:, 1] - left[:, 1] + change[:, 3]
        return changed(features, uv_left=z[:, :2], uv_right=np.column_stack([z[:, 2], z[:, 1] + vertical]))


@dataclass(frozen=True, eq=False)
class Revision:
    """A change of the correction during a run, for measurements that have the earlier correction."""

    before: RigCorrection  # the corrections
    after: RigCorrection

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected again."""
        return self.after.rows(self.before.undone(z))
