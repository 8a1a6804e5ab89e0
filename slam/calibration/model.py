"""The possible errors of a stereo calibration, and how each moves pixels: linear about the calibration as delivered.

Coordinates are those of the rectified rig: x, y from the principal point in focal lengths, d the disparity in focal
lengths (inverse depth times the baseline). A parameter is the *correction* that takes what was measured to what an
ideal rig would have measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slam.data import StereoFeatures
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
_FIRST, _SECOND = np.array(RESIDUAL).T.copy()
_SCALES = np.sqrt((2 * _FIRST + 1) * (2 * _SECOND + 1))  # for a mean square of one over the image


class RigModel:
    """The parameters of a rig's error, and the fields that they make.

    The order is: left camera (`LENS`), right camera (the same), `POSE`. In addition, there are residual fields, of
    which only the size is known: they are not corrected, but make the parameters less certain.

    Args:
        rig: the cameras as calibrated.
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

    def far(self, columns: int = 15, rows: int = 7) -> Array:
        """Points at infinity ``(x, y, 0)`` (N, 3) [px] spread evenly over the left image."""
        x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
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
        """Change (N, 3, n) [px] of points ``(x, y, d)`` (N, 3) [px] by the parameters.

        With the right camera's true direction ``(x - d, y)`` and the baseline ``(1, down, forward)``, the true d is
        ``x_left - x_right`` plus ``forward · d · x_right``. Rows of x and y are finite where d is not.

        A shift of both principal points looks almost like a rotation of the whole rig, and neither is known well. Lest
        the pose rotate with each revision, the ideal rig is rotated such that the left image as a whole does not move.
        """
        field, n = _field(points, self.focal), len(self.names)
        return np.asarray(field[:, :3, :n] + field[:, :3, n:] @ self._gauge)

    def shift(self, points: Array, parameters: Array) -> Array:
        """Change (N, 3) [px] of points ``(x, y, d)`` (N, 3) [px] by parameters (n,)."""
        return np.asarray(self.field(points) @ parameters)

    @cached_property
    def _gauge(self) -> Array:
        """Rotation of the ideal rig (3, n) [rad] that cancels the left image's mean displacement by the parameters."""
        n = len(self.names)
        rows = _field(self.far(), self.focal)[:, :2].reshape(-1, n + 3)
        return -np.asarray(np.linalg.lstsq(rows[:, n:], rows[:, :n], rcond=None)[0])

    def vertical(self, points: Array) -> Array:
        """Change (N, n) [px] of the vertical disparity, right row less left row, by the parameters.

        A pair of pixels of one point on an ideal rig has none; the baseline's direction adds
        ``d · (forward · y - down)``, which the correction takes away.
        """
        return _field(points, self.focal)[:, 3, : len(self.names)]

    def residual_products(self, factors: Array, points: Array) -> Array:
        """Sum over points (N, 3) of factors (N, 3, n) times the residual fields (N, 3, m) there: (n, m).

        The fields are those of x and y of the left camera, then of the right one.
        """
        x, y, d = points.T / self.focal
        n = len(RESIDUAL)
        out = np.zeros((factors.shape[2], 4 * n))
        left, right = (self.focal * self._polynomials(v, y) for v in (x, x - d))
        out[:, :n] = (factors[:, 0] + factors[:, 2]).T @ left
        out[:, n : 2 * n] = factors[:, 1].T @ left
        out[:, 2 * n : 3 * n] = -(factors[:, 2].T @ right)
        return out

    def residual_vertical(self, points: Array) -> Array:
        """As `vertical`, by the residual fields (N, m)."""
        x, y, d = points.T / self.focal
        n = len(RESIDUAL)
        out = np.zeros((len(points), 4 * n))
        out[:, n : 2 * n] = -self.focal * self._polynomials(x, y)
        out[:, 3 * n :] = self.focal * self._polynomials(x - d, y)
        return out

    def _polynomials(self, x: Array, y: Array) -> Array:
        """Products of Legendre polynomials (N, k), with a mean square of one over the image."""
        from slam.calibration.kernels import polynomials

        # 1.1: polynomials are held constant beyond the image, this many half widths from its centre
        at = (np.stack([x, y]) - self._centre[:, None]) / self._half[:, None]
        return np.asarray(polynomials(at, 1.1, _FIRST, _SECOND, _SCALES)).T


def lens_change(x: Array, y: Array) -> tuple[Array, Array]:
    """Change of x and of y (N, 8 each) [focal lengths] by the parameters of one camera, see `LENS`."""
    field = _field(np.column_stack([x, y, np.zeros(len(x))]), 1.0)
    return field[:, 0, : len(LENS)], field[:, 1, : len(LENS)]


def _field(points: Array, focal: float) -> Array:
    """Change (N, 4, n + 3) [px] of points (N, 3) [px] and their vertical disparities by parameters and a turn."""
    from slam.calibration.kernels import field

    return np.asarray(field(np.ascontiguousarray(points, float), focal))


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
        z = self.model.rows(points + self.model.shift(points, self.parameters))
        vertical = uv_right[:, 1] - uv_left[:, 1] + self.model.vertical(points) @ self.parameters
        return z[:, :2], np.column_stack([z[:, 2], z[:, 1] + vertical])


@dataclass(frozen=True, eq=False)
class Revision:
    """A change of the correction during a run, for measurements that have the earlier correction."""

    before: RigCorrection  # the corrections
    after: RigCorrection

    def rows(self, z: Array) -> Array:
        """Rectified rows (uL, vL, uR) (N, 3) [px], corrected again."""
        return self.after.rows(self.before.undone(z))
