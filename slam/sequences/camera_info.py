"""The rig of two ROS cameras by their CameraInfo messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose
from slam.sequences.calibration import (
    NO_NUMBERS,
    projection_offset,
    require_possible,
    rig_from_projections,
    rig_from_transform,
)

_MODELS = {
    "": False, "none": False, "plumb_bob": False, "rational_polynomial": False, "equidistant": True, "fisheye": True,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """A CameraInfo message of ROS 1 or 2.

    Attributes:
        size: width and height [px].
        model: name of the distortion model.
        K: camera matrix (3, 3) of the raw image.
        D: its distortion coefficients.
        R: rotation (3, 3) from raw to rectified camera axes.
        P: projection (3, 4) of the rectified image; ``P[0, 3] = -fx B`` of the right camera of a pair.
    """

    size: tuple[int, int]
    model: str
    K: Array
    D: Array
    R: Array
    P: Array

    @classmethod
    def of(cls, message: Any) -> CameraInfo:
        """A message as it was read; ROS 1 writes its matrices in capitals.

        Raises:
            CalibrationError: it holds what no calibration holds, or only a part of the image is given.
        """
        K, D, R, P = (
            _matrix(message, name, shape) for name, shape in (("K", (3, 3)), ("D", (-1,)), ("R", (3, 3)), ("P", (3, 4)))
        )
        size = int(message.width), int(message.height)
        roi = int(message.roi.width), int(message.roi.height)
        if max(int(message.binning_x), int(message.binning_y)) > 1 or roi not in ((0, 0), size):
            raise CalibrationError("binning and regions of interest are not supported")
        return cls(size, str(message.distortion_model), K, D, R, P)

    @property
    def baseline_term(self) -> float:
        """``-P[0, 3] / P[0, 0]``: how far the camera stands to the right of the pair's left one [m]; NaN for no P."""
        return float(-self.P[0, 3] / self.P[0, 0]) if self.P[0, 0] > 0 else float("nan")


def rig_from_camera_infos(left: CameraInfo, right: CameraInfo, rectified: bool, unit: float = 1.0) -> StereoRig:
    """The rig of the rectified or of the raw images.

    For the raw ones ``h_rectified = R h`` in each camera, and the rectified cameras differ by the baseline in ``P``,
    which is in units of so many metres.

    Raises:
        CalibrationError: a camera is not calibrated, or not as one of a pair; or the rig is impossible.
    """
    for side, info in (("left", left), ("right", right)):
        if not (info.P[0, 0] > 0 and info.K[0, 0] > 0):
            raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
    if right.P[0, 3] == left.P[0, 3]:
        raise CalibrationError("the cameras are not calibrated as a pair: P of the right one holds no baseline")
    if left.size != right.size:
        raise CalibrationError("the images of the two cameras differ in size")
    scale = np.array([1, 1, 1, unit])
    if rectified:
        return rig_from_projections(left.P * scale, right.P * scale, left.size)
    offset = unit * (projection_offset(right.P) - projection_offset(left.P))
    T_right_left = pose(right.R.T @ left.R, right.R.T @ offset)
    return rig_from_transform(_camera(left), _camera(right), T_right_left)


def _camera(info: CameraInfo) -> PinholeCamera:
    model = info.model.lower()
    if model not in _MODELS:
        raise CalibrationError(f"distortion model {info.model!r} is not supported")
    return PinholeCamera.from_matrix(info.K, info.D, info.size, fisheye=_MODELS[model])


def _matrix(message: Any, name: str, shape: tuple[int, ...]) -> Array:
    value = getattr(message, name, None)
    value = getattr(message, name.lower(), None) if value is None else value
    try:
        matrix = np.array(value, float).reshape(shape)
    except NO_NUMBERS:
        raise CalibrationError(f"{name} is no matrix of shape {shape}") from None
    require_possible(matrix, name)
    return matrix
