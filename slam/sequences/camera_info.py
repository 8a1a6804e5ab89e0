"""The rig of two ROS cameras by their CameraInfo messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from slam.errors import CalibrationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.sequences.calibration_keys import Entries, array, rig_of


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
        shapes = {"K": (3, 3), "D": None, "R": (3, 3), "P": (3, 4)}
        matrices = {n: array(getattr(message, n, getattr(message, n.lower(), None)), n, s) for n, s in shapes.items()}
        size = int(message.width), int(message.height)
        roi = int(message.roi.width), int(message.roi.height)
        if max(int(message.binning_x), int(message.binning_y)) > 1 or roi not in ((0, 0), size):
            raise CalibrationError("binning and regions of interest are not supported")
        return cls(size, str(message.distortion_model), **matrices)

    @property
    def baseline_term(self) -> float:
        """``-P[0, 3] / P[0, 0]``: how far the camera stands to the right of the pair's left one [m]; NaN for no P."""
        return float(-self.P[0, 3] / self.P[0, 0]) if self.P[0, 0] > 0 else float("nan")


def rig_from_camera_infos(left: CameraInfo, right: CameraInfo, rectified: bool, unit: float = 1.0) -> StereoRig:
    """The rig of the rectified or of the raw images; the baseline in ``P`` is in units of so many metres.

    Raises:
        CalibrationError: a camera is not calibrated, or not as one of a pair; or the rig is impossible.
    """
    for side, info in (("left", left), ("right", right)):
        if not (info.P[0, 0] > 0 and info.K[0, 0] > 0):
            raise CalibrationError(f"the {side} camera is not calibrated: K or P is zero")
    if left.size != right.size:
        raise CalibrationError("the images of the two cameras differ in size")
    names = "cameramatrix", "distcoeffs", "rectificationmatrix", "projectionmatrix", "distortionmodel", "size"
    files = [
        {name: (name, value) for name, value in zip(names, (i.K, i.D, i.R, i.P, i.model, i.size))}
        for i in (left, right)
    ]
    return rig_of(Entries(files), left.size, unit, rectified, False)
