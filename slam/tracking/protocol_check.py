"""Checks of what third-party back ends and front ends return, so that an error ends a step with one clear line."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np

from slam.checks import LATEST_STAMP
from slam.data import Estimate, IdArray, Patches, Prediction, UpdateReport, UpdateStatus
from slam.errors import SlamError
from slam.geometry.se3 import Array

_REPORT = {"status": UpdateStatus, "reason": str, "used": np.ndarray, "rejected": np.ndarray, "nis": Real, "dof": Real}


def require_prediction(prediction: Any, owner: object) -> None:
    """Check what `Backend.predict` of `owner` returned.

    Raises:
        SlamError: it is no `Prediction`, shapes differ from the documented ones, or pose or covariance are not finite.
    """
    what = f"{type(owner).__name__}.predict"
    _require_kind(prediction, Prediction, what)
    _require_belief(prediction, what)
    n = len(prediction.ids)
    shapes = {"uv_left": (n, 2), "uv_right": (n, 2), "innovation": (n, 2, 2)}
    for name, shape in shapes.items():
        _require_shape(getattr(prediction, name), shape, f"{what}: {name}")


def require_report(report: Any, owner: object) -> None:
    """Check what `Backend.update` of `owner` returned.

    Raises:
        SlamError: it is no `UpdateReport`, or one of its values is of another type than documented.
    """
    what = f"{type(owner).__name__}.update"
    _require_kind(report, UpdateReport, what)
    for name, kind in _REPORT.items():
        _require_kind(getattr(report, name), kind, f"{what}: {name}")
    for name in ("used", "rejected"):
        ids = getattr(report, name)
        if ids.ndim != 1 or ids.dtype.kind not in "iu":
            raise SlamError(f"{what}: {name} must be an array (N,) of ids, got {ids.dtype} {ids.shape}")


def require_estimate(estimate: Any, owner: object) -> Estimate:
    """What `Backend.estimate` of `owner` returned, checked.

    Raises:
        SlamError: it is no `Estimate`, or pose, landmarks or covariances are of another shape or not finite.
    """
    what = f"{type(owner).__name__}.estimate"
    _require_kind(estimate, Estimate, what)
    _require_belief(estimate, what)
    n = len(estimate.ids)
    for name, shape in {"ids": (n,), "positions": (n, 3), "covariances": (n, 3, 3)}.items():
        _require_shape(getattr(estimate, name), shape, f"{what}: {name}")
        if not np.isfinite(getattr(estimate, name)).all():
            raise SlamError(f"{what}: a value of {name} is not finite")
    return estimate


def require_positions(positions: Any, ids: IdArray, owner: object) -> Array:
    """What `Backend.positions` of `owner` returned for `ids`, checked.

    Raises:
        SlamError: not (N, 3), or not finite.
    """
    what = f"{type(owner).__name__}.positions"
    _require_shape(positions, (len(ids), 3), what)
    if not np.isfinite(positions).all():
        raise SlamError(f"{what}: a landmark's position is not finite")
    return np.asarray(positions)


def require_patches(patches: Any, count: int, known: Patches, owner: object) -> None:
    """Check what `AligningFrontend.patches` of `owner` returned for `count` pixels.

    Raises:
        SlamError: it is no `Patches` with `count` rows, or their size differs from that of the `known` ones.
    """
    what = f"{type(owner).__name__}.patches"
    _require_kind(patches, Patches, what)
    shape = np.shape(patches.images)
    if len(shape) != 3 or shape[0] != count or (len(known) and shape[1:] != known.images.shape[1:]):
        expected = f"({count}, S, S)" if not len(known) else str((count, *known.images.shape[1:]))
        raise SlamError(f"{what}: images must be {expected}, got {shape}")
    _require_shape(patches.centres, (count, 2), f"{what}: centres")
    _require_shape(patches.size, (count,), f"{what}: size")


def require_aligned(found: Any, count: int, owner: object) -> tuple[Array, Array]:
    """Left and right pixels that `AligningFrontend.align` of `owner` returned for `count` patches, checked.

    Raises:
        SlamError: they are not two arrays (N, 2).
    """
    what = f"{type(owner).__name__}.align"
    if not isinstance(found, tuple) or len(found) != 2:
        raise SlamError(f"{what}: must give left and right pixels, got {type(found).__name__}")
    for side, uv in zip(("left", "right"), found):
        _require_shape(uv, (count, 2), f"{what}: {side} pixels")
    return found[0], found[1]


def _require_belief(belief: Prediction | Estimate, what: str) -> None:
    """Check stamp, ids, pose and its covariance."""
    _require_kind(belief.stamp, Real, f"{what}: the stamp")
    if not abs(belief.stamp) <= LATEST_STAMP:
        raise SlamError(f"{what}: the stamp must be within {LATEST_STAMP:g} s")
    _require_kind(belief.ids, np.ndarray, f"{what}: ids")
    for name, value, side in (("the pose", belief.T_world_left, 4), ("the covariance", belief.covariance, 6)):
        _require_shape(value, (side, side), f"{what}: {name}")
        if not np.isfinite(value).all():
            raise SlamError(f"{what}: {name} is not finite")


def _require_kind(value: Any, kind: type, what: str) -> None:
    if not isinstance(value, kind):
        raise SlamError(f"{what}: must give a {kind.__name__}, got {type(value).__name__}")


def _require_shape(value: Any, shape: tuple[int, ...], what: str) -> None:
    """Check that a value is a numeric array of this shape."""
    if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind not in "fiu":
        got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        raise SlamError(f"{what}: must be an array {shape} of numbers, got {got}")
