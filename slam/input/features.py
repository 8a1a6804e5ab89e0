"""Checks of features before a step changes anything: once what they are, then whether they follow the last frame's."""

from __future__ import annotations

from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from slam.checks import LATEST_STAMP, unit_doubt
from slam.data import (
    BoolArray,
    Estimate,
    FrameResult,
    ImagePair,
    Observations,
    RecentPoses,
    StereoFeatures,
    StereoFrame,
)
from slam.errors import ConfigurationError, MeasurementError
from slam.geometry.arrays import changed, median
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend
from slam.models import EstimatorModels

_SHARE = 0.1  # guard: of features outside of the image; by which the lengths of descriptors may differ from 1

#: Columns of `StereoFeatures`: numbers in a row (None for any number), and the dtype that comes out.
_COLUMNS: dict[str, tuple[tuple[int | None, ...], type]] = {
    "uv_left": ((2,), np.float64), "uv_right": ((2,), np.float64), "scale": ((), np.float64), "angle": ((), np.float64),
    "response": ((), np.float64), "laplacian": ((), np.int8), "descriptors": ((None,), np.float32),
}  # fmt: skip


def documented(features: Any, rig: StereoRig) -> StereoFeatures:
    """The features with the documented dtypes; MeasurementError where they are not as `StereoFeatures` says.

    That is a wrong type, shape or number of dimensions, a value that is not finite (except NaN in `uv_right`), a pixel
    farther outside the image than its width or height, exchanged x and y, descriptors that are no unit vectors, a stamp
    that is no number, or images of another type or size.
    """
    if not isinstance(features, StereoFeatures):
        raise MeasurementError(f"features must be StereoFeatures, got {type(features).__name__}")
    stamp, threshold = _number("stamp", features.stamp), _number("threshold", features.threshold)
    if not np.isfinite(stamp) or abs(stamp) > LATEST_STAMP:
        raise MeasurementError(
            f"features: the stamp must be finite and within {LATEST_STAMP:g} s, got {stamp}{unit_doubt(stamp)}"
        )
    rows = len(features) if isinstance(features.uv_left, np.ndarray) and features.uv_left.ndim else 0
    columns: dict[str, Any] = {name: _column(name, getattr(features, name), rows) for name in _COLUMNS}
    size = np.array([rig.left.width, rig.left.height])
    for name in ("uv_left", "uv_right"):
        if ((columns[name] < -size) | (columns[name] > 2 * size)).any():  # NaN compares false
            raise MeasurementError(f"features: a pixel of {name} lies far outside of the image")
    u, v = columns["uv_left"].T
    if not features.rectified and np.mean([*(v >= size[1]), False]) > _SHARE and (u < size[1]).all():
        raise MeasurementError("features: uv_left lies below the image: are its columns, x and y, exchanged?")
    looks = columns["descriptors"]
    length = median(np.sqrt(np.einsum("nd,nd->n", looks, looks))) if looks.any() else 1.0
    if abs(length - 1) > _SHARE:
        raise MeasurementError(
            f"features: descriptors must be unit vectors; the median of their lengths is {length:.3g}"
        )
    _require_images(features.images, rig)
    return changed(features, stamp=stamp, threshold=threshold, **columns)


def outside_masks(features: StereoFeatures, frame: StereoFrame, rig: StereoRig) -> StereoFeatures:
    """The features where the masks of their frame are True; under the right camera's only the right pixel goes."""
    if frame.left_mask is not None:
        uv = rig.rectified.unrectify_left(features.uv_left) if features.rectified else features.uv_left
        features = features.select(_at(frame.left_mask, uv))
    if frame.right_mask is not None:
        uv = rig.rectified.unrectify_right(features.uv_right) if features.rectified else features.uv_right
        visible = _at(frame.right_mask, uv)[:, None]
        features = changed(features, uv_right=np.where(visible, features.uv_right, np.nan))
    return features


def _at(mask: BoolArray, uv: Array) -> BoolArray:
    """The mask (H, W) at pixels (N, 2); True beyond its border and where a pixel is NaN."""
    out, visible = np.ones(len(uv), bool), np.isfinite(uv).all(axis=1)
    column, row = np.rint(uv[visible]).astype(int).T.clip(0, np.array([mask.shape[1] - 1, mask.shape[0] - 1])[:, None])
    out[visible] = mask[row, column]
    return out


def following(features: StereoFeatures, dimensions: int | None, after: float) -> StereoFeatures:
    """The features of a frame after the stamp [s] of the last one; without any, descriptors are (0, `dimensions`).

    Raises MeasurementError where the stamp is not later, or the descriptors are of another length.
    """
    if features.stamp <= after:
        raise MeasurementError(
            f"features: the stamp {features.stamp} s is not later than {after} s, the last frame's (a frame whose step "
            "was interrupted counts too): go on with a later one"
        )
    length = features.descriptors.shape[1]
    if dimensions is None or length == dimensions:
        return features
    if len(features):
        raise MeasurementError(f"features: descriptors have {length} numbers, those of earlier frames {dimensions}")
    return changed(features, descriptors=np.zeros((0, dimensions), np.float32))


def _number(name: str, value: Any) -> float:
    if isinstance(value, Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise MeasurementError(f"features: {name} must be a number, got {str(value)[:40]!r}")


def _column(name: str, array: Any, rows: int) -> Array:
    shape, dtype = _COLUMNS[name]
    kinds = "i" if dtype is np.int8 else "f"
    if not isinstance(array, np.ndarray) or array.ndim != 1 + len(shape) or array.dtype.kind not in kinds:
        got = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        dimensions = f"{1 + len(shape)} dimensions of {dtype.__name__}"
        raise MeasurementError(f"features: {name} must be an array of {dimensions}, got {got}")
    if len(array) != rows or (shape == (2,) and array.shape[1] != 2) or (rows and not array.size):
        raise MeasurementError(f"features: {name} is of shape {array.shape}, with {rows} rows in uv_left")
    if array.dtype != dtype:
        with np.errstate(over="ignore"):  # reported as not finite
            array = (np.sign(array) if "i" in kinds else array).astype(dtype)
    if (np.isinf(array) if name == "uv_right" else ~np.isfinite(array)).any():
        raise MeasurementError(f"features: a value of {name} is not finite")
    return np.asarray(array)


def _require_images(images: Any, rig: StereoRig) -> None:
    """Check that images, if there are any, are a pair of the rectified rig, of the rig's own size."""
    if images is None:
        return
    if not isinstance(images, ImagePair):
        raise MeasurementError(f"features: images must be an ImagePair, got {type(images).__name__}")
    for side, image in (("left", images.left), ("right", images.right)):
        if image is None and side == "right":
            continue
        shape = (rig.left.height, rig.left.width)
        if not isinstance(image, np.ndarray) or image.dtype != np.float32 or image.shape != shape:
            got = f"{image.dtype} of shape {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise MeasurementError(f"features: the {side} image must be float32 of shape {shape}, got {got}")


class Rectification:
    """The ways between a rig and its rectified pair `rig`. Where it is rectified, everything passes unchanged."""

    def __init__(self, rig: StereoRig) -> None:
        self._ways, self._none = rig.rectified, rig.is_rectified
        self.rig = self._ways.rig
        self._back = inverse(self._ways.T_left_rectified)
        self._adjoint = adjoint(self._ways.T_left_rectified)

    def require_fits(self, backend: Backend) -> None:
        """Raise ConfigurationError if a back end was made for cameras with lenses or turned axes."""
        rig = getattr(backend, "rig", None)
        if isinstance(rig, StereoRig) and not rig.is_rectified:
            raise ConfigurationError("the back end works behind rectification: make it with rig.rectified.rig")

    def models(self, models: EstimatorModels) -> EstimatorModels:
        """Models for the rectified pair: what its pixels do, and the first pose of its left camera."""
        if self._none:
            return models
        T, scale = models.initial_pose @ self._ways.T_left_rectified, self._ways.scale
        objects = replace(models.objects, drift=models.objects.drift * scale)
        slide, sigma = replace(models.slide, density=models.slide.density * scale), models.pixel_sigma * scale
        return replace(models, pixel_sigma=sigma, slide=slide, T_world_left=T.tolist(), objects=objects)

    def features_in(self, features: StereoFeatures) -> StereoFeatures:
        """Features in pixels of the rectified pair; those outside of its left image are left out."""
        if self._none or features.rectified:
            return features
        left = self._ways.rectify_left(features.uv_left)
        moved = changed(features, uv_left=left, uv_right=self._right(features.uv_right))
        inside = self.rig.left.in_image(left)
        return moved if inside.all() else moved.select(np.flatnonzero(inside))

    def observations_in(self, seen: Observations) -> Observations:
        """Observations in pixels of the rectified pair."""
        if self._none:
            return seen
        return Observations(seen.ids, self._ways.rectify_left(seen.uv_left), self._right(seen.uv_right))

    def _right(self, uv: Array) -> Array:
        """Right pixels (N, 2); none where they come to lie farther outside the image than that is large.

        A fisheye sees rays across its axis, whose pixels in the rectified pair lie at infinity.
        """
        right, size = self._ways.rectify_right(uv), np.array([self.rig.left.width, self.rig.left.height])
        far = (np.abs(right - 0.5 * size) > 1.5 * size).any(axis=1, keepdims=True)  # NaN compares false
        return np.where(far, np.nan, right)

    def result_out(self, result: FrameResult) -> FrameResult:
        """A result in pixels and axes of the rig's own left camera."""
        if self._none:
            return result
        f, common = result.features, result.common
        left, right = self._ways.unrectify_left(f.uv_left), self._ways.unrectify_right(f.uv_right)
        return changed(
            result,
            estimate=self.estimate_out(result.estimate),
            features=changed(f, uv_left=left, uv_right=right, rectified=False),
            common=changed(common, jacobian=self._adjoint @ common.jacobian),
            recent=self.recent_out(result.recent),
        )

    def estimate_out(self, estimate: Estimate) -> Estimate:
        """An estimate with the pose of the rig's own left camera."""
        if self._none:
            return estimate
        P = self._adjoint @ estimate.covariance @ self._adjoint.T
        return changed(estimate, T_world_left=estimate.T_world_left @ self._back, covariance=P)

    def recent_out(self, recent: RecentPoses | None) -> RecentPoses | None:
        """The last poses of the rig's own left camera, with their joint covariance; None of none."""
        if self._none or recent is None:
            return recent
        each, J = np.arange(len(recent)), np.zeros((6 * len(recent),) * 2)
        J.reshape(len(each), 6, len(each), 6)[each, :, each] = self._adjoint
        return RecentPoses(recent.stamps, recent.poses @ self._back, J @ recent.covariance @ J.T)

    def path_out(self, path: Trajectory) -> Trajectory:
        """A path of the rig's own left camera."""
        return path if self._none else Trajectory(path.stamps, path.poses @ self._back)
