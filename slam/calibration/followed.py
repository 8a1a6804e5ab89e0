"""What a back end follows of a rig's errors: the combinations that move what it measures, and their fields.

Some changes of the parameters move the right row alone, which back ends do not measure: the direction of the baseline
across, say. With V the others, orthonormal, the field of the rows (uL, vL, uR) is ``F = F V Vᵀ``, so that following
``Vᵀ δ`` instead of δ changes no covariance. Fewer cannot be followed: combinations that hardly move pixels are those of
which a recording teaches little, and after some seconds they are a good part of the covariance.
"""

from __future__ import annotations

import numpy as np

from slam.calibration.model import RigModel
from slam.geometry.arrays import Array

#: Standard deviation of the baseline's length, as a share of it: the squares of a calibration board are known to some
#: tenths of a percent. It scales the whole world, so images never show it.
BASELINE = 0.002


class FollowedErrors:
    """The k combinations of the parameters' and the baseline's errors that move the rows (uL, vL, uR) of any point.

    Args:
        model: the rig's parameters.
    """

    def __init__(self, model: RigModel) -> None:
        self._origin, self._focal = model.origin, model.focal
        far = model.far()
        # (0, 0.1, 0.2): disparities [focal lengths]; with rows and columns of `far`, enough for a field's polynomial
        points = np.concatenate([far + np.array([0.0, 0.0, d * self._focal]) for d in (0.0, 0.1, 0.2)])
        field = np.zeros((*points.shape, len(model.names) + 1))
        field[:, :, :-1] = model.field(points)
        field[:, 2, -1] = -points[:, 2]  # with a longer baseline, the nominal one's disparity is smaller
        field[:, 2] = field[:, 0] - field[:, 2]  # of uR
        _, sizes, rows = np.linalg.svd(field.reshape(-1, field.shape[2]), full_matrices=False)
        V = rows[sizes > 1e-9 * sizes[0]].T  # 1e-9: numerics, rounding
        products = _products(np.column_stack([points[:, :2], points[:, 0] - points[:, 2]]) / self._focal)
        self._V, self._by_baseline = V[:-1], BASELINE * V[-1]
        self._coefficients = np.linalg.lstsq(products.T, (field @ V).reshape(len(points), -1), rcond=None)[0]

    def of(self, parameters: Array) -> Array:
        """The combinations (k,) of parameters (n,), the baseline as delivered."""
        return np.asarray(parameters @ self._V)

    def covariance(self, parameters: Array) -> Array:
        """Covariance (k, k) of the combinations by that of the parameters (n, n)."""
        return np.asarray(self._V.T @ parameters @ self._V + np.outer(self._by_baseline, self._by_baseline))

    def field(self, z: Array, known: Array) -> Array:
        """Derivatives (N, 3, k + 1) of rows (uL, vL, uR) (N, 3) [px] by the combinations; last, by `known` (k,).

        The last are the sum of the others times `known`. A missing uR has none.
        """
        u, v = self._origin / self._focal
        missing = np.isnan(z[:, 2])
        rows = np.where(np.isnan(z), 0.0, z) / self._focal - np.array([u, v, u])
        by_one = self._coefficients.reshape(-1, 3, len(known))
        coefficients = np.concatenate([by_one, (by_one @ known)[:, :, None]], axis=2)
        field = (_products(rows).T @ coefficients.reshape(len(by_one), -1)).reshape(len(z), *coefficients.shape[1:])
        field[missing, 2] = np.nan
        return np.asarray(field)


def _products(rows: Array) -> Array:
    """Of (x, y, x of the right camera) (N, 3) [focal lengths], those (16, N) whose sums all fields of a rig are."""
    x, y, right = rows.T
    xx, yy, square = x * x, y * y, right * right
    left, other = xx + yy, square + yy
    return np.stack([
        np.ones(len(rows)), x, y, xx, x * y, yy, x * left, x * left * left, y * left, y * left * left,
        right, square, right * y, right * other, right * other * other, x * right,
    ])  # fmt: skip
