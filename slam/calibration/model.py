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
_BEYOND = 1.1  # polynomials are held constant beyond the image, this many half widths from its centre


class RigModel:
    """The parameters of a rig's error, and the fields that they make.

    The order is: left camera (`LENS`), right camera (the same), `POSE`. Besides, there are residual fields, of which
    only the size is known: they are not corrected, but make the parameters less certain.

    Args:
        rig: the cameras as calibrated.
    """

    names = (*(f"{side}_{name}" for side in ("left", "right") for name in LENS), *POSE)
    units = tuple(_UNITS.get(name.removeprefix("left_").removeprefix("right_"), "1") for name in names)

    def __init__(self, rig: StereoRig) -> None:
        self.rig = rig
        rectified_rig = rig.rectified.rig
        self.focal = rectified_rig.left.fu
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

        A shift of both principal points looks almost like a turn of the whole rig, and neither is known well. So that
        the pose does not turn with each revision, the ideal rig is turned such that the left image as a whole stays
        where it is.
        """
        return self._unturned(points) + _turn(points, self.focal) @ self._gauge

    @cached_property
    def _gauge(self) -> Array:
        """Rotation of the ideal rig (3, n) that takes back what the parameters turn the left image by."""
        far = self.far()
        turned, moved = (
            rows[:, :2].reshape(2 * len(far), -1) for rows in (_turn(far, self.focal), self._unturned(far))
        )
        return -np.asarray(np.linalg.lstsq(turned, moved, rcond=None)[0])

    def _unturned(self, points: Array) -> Array:
        """`field` without the rotation."""
        x, y, d = points.T / self.focal
        left, right = lens_change(x, y), lens_change(x - d, y)
        turn = np.stack([-(x - d) * y, 1 + (x - d) ** 2, -y], axis=1)
        none = np.zeros((len(points), len(LENS) + len(POSE)))
        along_d = [left[0], -right[0], -turn, 0 * x[:, None], (d * (x - d))[:, None]]
        rows = [[left[0], none], [left[1], none], along_d]
        return np.asarray(self.focal * np.stack([np.concatenate(row, axis=1) for row in rows], axis=1))

    def vertical(self, points: Array) -> Array:
        """Change (N, n) [px] of the vertical disparity, right row less left row, by the parameters.

        A pair of pixels of one point on an ideal rig has none; the baseline's direction adds
        ``d · (forward · y - down)``, which the correction takes away.
        """
        x, y, d = points.T / self.focal
        left, right = lens_change(x, y)[1], lens_change(x - d, y)[1]
        turn = np.stack([-1 - y**2, (x - d) * y, x - d], axis=1)
        return np.asarray(self.focal * np.concatenate([-left, right, turn, d[:, None], (-d * y)[:, None]], axis=1))

    def residual_field(self, points: Array) -> Array:
        """As `field`, by the residual fields (N, 3, m): of x and y of the left camera, then of the right one."""
        x, y, d = points.T / self.focal
        left, right = self._polynomials(x, y), self._polynomials(x - d, y)
        none = 0 * left
        rows = [[left, none, none, none], [none, left, none, none], [left, none, -right, none]]
        return np.asarray(self.focal * np.stack([np.concatenate(row, axis=1) for row in rows], axis=1))

    def residual_vertical(self, points: Array) -> Array:
        """As `vertical`, by the residual fields (N, m)."""
        x, y, d = points.T / self.focal
        left, right = self._polynomials(x, y), self._polynomials(x - d, y)
        return np.asarray(self.focal * np.concatenate([0 * left, -left, 0 * left, right], axis=1))

    def _polynomials(self, x: Array, y: Array) -> Array:
        """Products of Legendre polynomials (N, k), with a mean square of one over the image."""
        at = [np.clip((v - c) / h, -_BEYOND, _BEYOND) for v, c, h in zip((x, y), self._centre, self._half)]
        a, b = (legvander(v, n) * np.sqrt(2 * np.arange(n + 1) + 1) for v, n in zip(at, _DEGREES))
        return np.stack([a[:, i] * b[:, j] for i, j in RESIDUAL], axis=1)


def lens_change(x: Array, y: Array) -> tuple[Array, Array]:
    """Change of x and of y (N, 8 each) [focal lengths] by the parameters of one camera."""
    none, r2 = 0 * x, x * x + y * y
    along_x = [none + 1, none, x, none, x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x]
    along_y = [none, none + 1, y, y, y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y]
    return np.stack(along_x, axis=1), np.stack(along_y, axis=1)


def _turn(points: Array, focal: float) -> Array:
    """Change (N, 3, 3) [px] of points ``(x, y, d)`` (N, 3) [px] by a small rotation of the rig [rad]."""
    x, y, d = points.T / focal
    none = 0 * x
    change = [[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x], [-d * y, d * x, none]]
    return np.asarray(focal * np.stack([np.stack(row, axis=1) for row in change], axis=1))
