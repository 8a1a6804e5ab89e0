"""Checks of the features that a caller gives, before a step changes anything."""

from __future__ import annotations

from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from slam.checks import LATEST_STAMP
from slam.data import ImagePair, StereoFeatures
from slam.errors import MeasurementError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array

#: Columns of `StereoFeatures`: number of dimensions, kinds of dtype that are taken, and the dtype that comes out.
_COLUMNS: dict[str, tuple[int, str, type]] = {
    "uv_left": (2, "f", np.float64),
    "uv_right": (2, "f", np.float64),
    "scale": (1, "f", np.float64),
    "angle": (1, "f", np.float64),
    "response": (1, "f", np.float64),
    "laplacian": (1, "i", np.int8),
    "descriptors": (2, "f", np.float32),
}


def usable(features: StereoFeatures, rig: StereoRig, dimensions: int | None, after: float) -> StereoFeatures:
    """The features with the documented dtypes; a frame without features gets descriptors (0, `dimensions`).

    Args:
        features: of a frame.
        rig: the cameras.
        dimensions: length of the descriptors so far; None if there were none.
        after: stamp of the frame before [s].

    Raises:
        MeasurementError: they are not as `StereoFeatures` says: a wrong type, shape or number of dimensions, a value
            that is not finite (except NaN in `uv_right`), a pixel farther outside the image than its width or height,
            a stamp that is no number or not later than the one before, or images of another type or size.
    """
    if not isinstance(features, StereoFeatures):
        raise MeasurementError(f"features must be StereoFeatures, got {type(features).__name__}")
    stamp = _number("stamp", features.stamp)
    if not np.isfinite(stamp) or abs(stamp) > LATEST_STAMP:
        raise MeasurementError(f"features: the stamp must be finite and within {LATEST_STAMP:g} s, got {stamp}")
    if stamp <= after:
        raise MeasurementError(
            f"features: the stamp {stamp} s is not later than {after} s, the last frame's (a frame whose step was "
            "interrupted counts too): go on with a later one"
        )
    threshold = _number("threshold", features.threshold)
    columns: dict[str, Any] = {name: _column(name, getattr(features, name)) for name in _COLUMNS}
    _require_rows(columns)
    for name in ("scale", "angle", "response", "descriptors"):
        if not np.isfinite(columns[name]).all():
            raise MeasurementError(f"features: a value of {name} is not finite")
    _require_pixels(columns["uv_left"], columns["uv_right"], rig)
    _require_images(features.images, rig)
    columns["descriptors"] = _of_length(columns["descriptors"], dimensions)
    return replace(features, stamp=stamp, threshold=threshold, **columns)


def _number(name: str, value: Any) -> float:
    """A real number as a float."""
    if isinstance(value, Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise MeasurementError(f"features: {name} must be a number, got {str(value)[:40]!r}")


def _column(name: str, array: Any) -> Array:
    """One column with its documented dtype."""
    dimensions, kinds, dtype = _COLUMNS[name]
    if not isinstance(array, np.ndarray) or array.ndim != dimensions or array.dtype.kind not in kinds:
        got = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise MeasurementError(
            f"features: {name} must be an array of {dimensions} dimensions of {dtype.__name__}, got {got}"
        )
    if array.dtype == dtype:
        return np.asarray(array)
    with np.errstate(over="ignore"):  # reported as not finite
        return (np.sign(array) if "i" in kinds else np.asarray(array)).astype(dtype)


def _require_rows(columns: dict[str, Any]) -> None:
    n = len(columns["uv_left"])
    for name, array in columns.items():
        wrong = len(array) != n or (name.startswith("uv") and array.shape[1] != 2)
        if wrong or (n and not array.size):
            raise MeasurementError(f"features: {name} is of shape {array.shape}, with {n} rows in uv_left")


def _require_pixels(left: Array, right: Array, rig: StereoRig) -> None:
    """Check that left pixels are finite, right pixels finite or NaN, and none far outside its image."""
    if not np.isfinite(left).all():
        raise MeasurementError("features: a left pixel is not finite")
    if np.isinf(right).any():
        raise MeasurementError("features: a right pixel is infinite; NaN says that there is no stereo match")
    size = np.array([rig.width, rig.height])
    for name, uv in (("left", left), ("right", right)):
        if ((uv < -size) | (uv > 2 * size)).any():  # NaN compares false
            raise MeasurementError(f"features: a {name} pixel lies far outside of the image")


def _require_images(images: Any, rig: StereoRig) -> None:
    """Check that images, if there are any, are a pair of the rectified rig, of the rig's own size."""
    if images is None:
        return
    if not isinstance(images, ImagePair):
        raise MeasurementError(f"features: images must be an ImagePair, got {type(images).__name__}")
    for side, image in (("left", images.left), ("right", images.right)):
        if image is None and side == "right":
            continue
        shape = (rig.height, rig.width)
        if not isinstance(image, np.ndarray) or image.dtype != np.float32 or image.shape != shape:
            got = f"{image.dtype} of shape {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise MeasurementError(f"features: the {side} image must be float32 of shape {shape}, got {got}")


def _of_length(descriptors: Array, dimensions: int | None) -> Array:
    """Descriptors (N, D), checked to be as long as those before; an empty array gets that length too."""
    if dimensions is None or descriptors.shape[1] == dimensions:
        return descriptors
    if len(descriptors):
        raise MeasurementError(
            f"features: descriptors have {descriptors.shape[1]} numbers, those of earlier frames {dimensions}"
        )
    return np.zeros((0, dimensions), descriptors.dtype)
