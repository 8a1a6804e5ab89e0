"""Checks of landmarks with a known prior position, the same for every back end."""

from __future__ import annotations

import numpy as np

from slam.checks import FARTHEST_POSITION
from slam.data import IdArray
from slam.errors import MeasurementError
from slam.geometry.se3 import LEAST_VARIANCE, Array
from slam.table import LandmarkRows

_LARGEST = 1e18  # guard: variance [m²], far above that of any landmark worth having
_ROUNDING = 1e-14  # numerics: share of a covariance's largest eigenvalue below which the smallest is rounding
_SYMMETRIC = 1e-6  # guard: largest share by which a covariance may differ from its transpose


def require_known(owner: str, ids: IdArray, positions: Array, covariances: Array) -> None:
    """Check landmarks (N) at positions (N, 3) [m] with covariances (N, 3, 3) [m²]; `owner` is named in messages.

    Raises:
        MeasurementError: shapes differ, an id occurs twice, a position is not finite or absurdly far, or a covariance
            is not symmetric and positive definite.
    """
    n = len(ids)
    if positions.shape != (n, 3) or covariances.shape != (n, 3, 3):
        shapes = f"positions {positions.shape} and covariances {covariances.shape}"
        raise MeasurementError(f"{owner}: {n} landmark ids, but {shapes}")
    if len(np.unique(ids)) != n:
        raise MeasurementError(f"{owner}: a landmark id stands twice")
    C = np.nan_to_num(covariances, nan=np.inf)
    scale = np.abs(C).max(axis=(1, 2), initial=0)
    C = np.where((scale < _LARGEST)[:, None, None], C, -np.eye(3))
    good = np.abs(C - np.swapaxes(C, 1, 2)).max(axis=(1, 2), initial=0) <= _SYMMETRIC * scale
    for bad, what in (
        (~np.isfinite(positions).all(axis=1), "the position of landmark {} is not finite"),
        (
            (np.abs(positions) > FARTHEST_POSITION).any(axis=1),
            f"landmark {{}} lies more than {FARTHEST_POSITION:g} m off",
        ),
        (
            ~good | (np.linalg.eigvalsh(C)[:, 0] <= 0),
            "the covariance of landmark {} is not symmetric and positive definite",
        ),
    ):
        if bad.any():
            raise MeasurementError(f"{owner}: {what.format(ids[bad][0])}")


def definite(covariances: Array) -> Array:
    """Covariances (N, 3, 3) [m²] symmetric and positive definite: what rounding took from the least variance is added.

    A landmark that is hardly known in one direction may have lost its variance in another one.
    """
    P = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    values = np.linalg.eigvalsh(P)
    short = np.maximum(np.maximum(LEAST_VARIANCE, _ROUNDING * values[:, 2]) - values[:, 0], 0)
    return np.asarray(P + short[:, None, None] * np.eye(3))


def known_landmarks(
    backend: str, table: LandmarkRows, ids: IdArray, positions: Array, covariances: Array
) -> tuple[IdArray, Array, Array]:
    """Copies of landmarks (N,) handed to `slam.interfaces.MapBackend`, checked; they may not be in the table yet.

    Raises:
        MeasurementError: as `require_known`; or one is in the table already.
    """
    require_known(backend, ids, positions, covariances)
    table.require_new(ids)
    return np.array(ids, np.int64), np.array(positions, float), np.array(covariances, float)
