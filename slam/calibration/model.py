"""The possible errors of a stereo calibration, and how each moves pixels: linear about the calibration as delivered.

Coordinates are those of the rectified rig: x, y from the principal point in focal lengths, d the disparity in focal
lengths (inverse depth times the baseline). A parameter is the *correction* that takes what was measured to what an
ideal rig would have measured.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import legvander

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
        turned = field[:, :, n:].reshape(-1, 3) @ self._gauge
        return np.asarray(field[:, :, :n] + turned.reshape(-1, 3, n))

    def shift(self, points: Array, parameters: Array) -> Array:
        """Change (N, 3) [px] of points ``(x, y, d)`` (N, 3) [px] by parameters (n,): ``field(points) @ parameters``."""
        both = np.concatenate([parameters, self._gauge @ parameters])
        return np.asarray((_field(points, self.focal).reshape(-1, len(both)) @ both).reshape(-1, 3))

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
        x, y, d = points.T / self.focal
        right = x - d
        pose = -1 - y * y, right * y, right, d, -d * y
        left_lens, right_lens = (lens_change(u, y)[1] for u in (x, right))
        return self.focal * np.concatenate([-left_lens, right_lens, np.stack(pose, axis=1)], axis=1)

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
        # 1.1: polynomials are held constant beyond the image, this many half widths from its centre
        at = np.clip((np.column_stack([x, y]) - self._centre) / self._half, -1.1, 1.1)
        by_x, by_y = (legvander(v, n) * np.sqrt(2 * np.arange(n + 1) + 1) for v, n in zip(at.T, _DEGREES))
        return np.asarray(by_x[:, _FIRST] * by_y[:, _SECOND])


def lens_change(x: Array, y: Array) -> tuple[Array, Array]:
    """Change of x and of y (N, 8 each) [focal lengths] by the parameters of one camera, see `LENS`."""
    r2, both, none, one = x * x + y * y, 2 * x * y, np.zeros(len(x)), np.ones(len(x))
    along = one, none, x, none, x * r2, x * r2 * r2, both, r2 + 2 * x * x
    across = none, one, y, y, y * r2, y * r2 * r2, r2 + 2 * y * y, both
    return np.stack(along, axis=1), np.stack(across, axis=1)


def _field(points: Array, focal: float) -> Array:
    """Change (N, 3, n + 3) [px] of points ``(x, y, d)`` (N, 3) [px] by the parameters, and by a turn of the rig."""
    x, y, d = points.T / focal
    right, none, side = x - d, np.zeros(len(x)), len(LENS)
    out = np.zeros((len(x), 3, 2 * side + len(POSE) + 3))
    out[:, 0, :side], out[:, 1, :side] = lens_change(x, y)
    out[:, 2, :side], out[:, 2, side : 2 * side] = out[:, 0, :side], -lens_change(right, y)[0]
    out[:, 2, 2 * side : -3] = np.stack([right * y, -1 - right * right, y, none, d * right], axis=1)
    out[:, 0, -3:] = np.stack([-x * y, 1 + x * x, -y], axis=1)
    out[:, 1, -3:] = np.stack([-1 - y * y, x * y, x], axis=1)
    out[:, 2, -3:] = np.stack([-d * y, d * x, none], axis=1)
    return focal * out
