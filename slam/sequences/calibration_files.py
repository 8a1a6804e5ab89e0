"""Rigs written as calibration files: OpenCV's form, and Kalibr's camchain."""

from __future__ import annotations

from pathlib import Path

from slam.errors import CalibrationError
from slam.files import write_text
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import pose

_FISHEYE = "equidistant"


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write a rig with the entries of ``cv2.stereoCalibrate``: K1, D1, K2, D2, R, T [m], and the size of the images.

    Raises:
        SlamError: it cannot be written.
    """
    import cv2
    import numpy as np

    left, right, R, b = rig.as_recorded
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    storage.write("image_width", left.width)
    storage.write("image_height", left.height)
    if rig.left.model == _FISHEYE:
        storage.write("distortion_model", _FISHEYE)
    for number, camera in enumerate((left, right), 1):
        storage.write(f"K{number}", camera.K)
        storage.write(f"D{number}", np.array([camera.distortion or (0.0,) * 4]))
    storage.write("R", R)
    storage.write("T", (R @ b).reshape(3, 1))
    write_text(path, storage.releaseAndGetString())


def write_kalibr(path: Path, rig: StereoRig) -> None:
    """Write a rig as a camchain, cam0 the left camera.

    Raises:
        CalibrationError: a camera has more than four coefficients of distortion, which the form does not have.
        SlamError: it cannot be written.
    """
    import yaml

    require_kalibr(path, rig)
    cameras = rig.as_recorded
    left, right = (_kalibr_camera(camera) for camera in cameras[:2])
    right["T_cn_cnm1"] = pose(cameras[2], cameras[2] @ cameras[3]).tolist()
    write_text(path, yaml.safe_dump({"cam0": left, "cam1": right}, default_flow_style=None, sort_keys=False))


def require_kalibr(path: Path, rig: StereoRig) -> None:
    """Raise where Kalibr's form cannot hold a rig.

    Raises:
        CalibrationError: a camera has more than four coefficients of distortion.
    """
    if max(len(camera.distortion) for camera in (rig.left, rig.right)) > 4:
        raise CalibrationError(f"{path}: Kalibr's form has k1, k2, p1 and p2, and this rig further distortion")


def _kalibr_camera(camera: PinholeCamera) -> dict[str, object]:
    """A camera of a camchain."""
    return {
        "camera_model": "pinhole",
        "intrinsics": [float(x) for x in (camera.fu, camera.fv, camera.u0, camera.v0)],
        "distortion_model": _FISHEYE if camera.model == _FISHEYE else "radtan",
        "distortion_coeffs": [float(x) for x in camera.distortion or (0.0,) * 4],
        "resolution": [int(camera.width), int(camera.height)],
    }
