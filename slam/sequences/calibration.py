"""Calibration files of the formats: EuRoC's, KITTI's, Kalibr's and OpenCV's, each to cameras or a rig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse
from slam.sequences.yaml_files import read_calibration, read_yaml

_MODELS = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "none": "none",
}


@dataclass(frozen=True, eq=False)
class ImuCamera:
    """A camera and its pose ``T_body_camera`` (4, 4) on a body."""

    camera: PinholeCamera
    T_body_camera: Array


def rig_from_cameras(left: ImuCamera, right: ImuCamera, path: Path) -> StereoRig:
    """The rig of two cameras on one body; faults are reported under the name `path`."""
    with naming(path):
        T = inverse(right.T_body_camera) @ left.T_body_camera
        return rig_from_transform(left.camera, right.camera, T)


def rig_from_transform(left: PinholeCamera, right: PinholeCamera, T_right_left: Array) -> StereoRig:
    """The rig with ``b = Rᵀ t``, since ``h_right = R (h_left + b)`` (paper A, Eq. 6)."""
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    return StereoRig(left, right, R, R.T @ t)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the file's name before the message of a calibration fault."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


# ------------------------------------------------------------------------------------------------ EuRoC, Kalibr


def euroc_camera(path: Path) -> ImuCamera:
    """A camera by EuRoC's ``sensor.yaml``."""
    node = read_yaml(path)
    with naming(path):
        T_body_camera = _transform(_field(node, "T_BS"), "T_BS")
        return ImuCamera(_yaml_camera(node, "distortion_coefficients"), T_body_camera)


def kalibr_cameras(path: Path) -> list[ImuCamera]:
    """Cameras ``cam0`` and ``cam1`` of Kalibr's ``camchain.yaml``; the body is the IMU or, without one, cam0."""
    node = read_yaml(path)
    with naming(path):
        nodes = [_field(node, cam) for cam in ("cam0", "cam1")]
        if not all(isinstance(n, Mapping) for n in nodes):
            raise CalibrationError("cam0 or cam1 is empty")
        cameras = [_yaml_camera(n, "distortion_coeffs") for n in nodes]
        if all("T_cam_imu" in n for n in nodes):
            poses = [inverse(_transform(n["T_cam_imu"], "T_cam_imu")) for n in nodes]
        else:
            T_right_left = _transform(_field(nodes[1], "T_cn_cnm1"), "T_cn_cnm1")
            poses = [np.eye(4), inverse(T_right_left)]
        return [ImuCamera(camera, T) for camera, T in zip(cameras, poses)]


def _yaml_camera(node: Mapping[str, Any], coefficients: str) -> PinholeCamera:
    """A camera by the keys that EuRoC and Kalibr share."""
    kind = node.get("camera_model", "pinhole")
    if kind != "pinhole":
        raise CalibrationError(f"camera model {kind!r} is not supported, only pinhole")
    model = _MODELS.get(str(node.get("distortion_model", "none")).lower())
    if model is None:
        raise CalibrationError(f"distortion model {node['distortion_model']!r} is not supported")
    intrinsics = _numbers(_field(node, "intrinsics"), "intrinsics", 4)
    width, height = _numbers(_field(node, "resolution"), "resolution", 2)
    distortion = () if model == "none" else tuple(_numbers(_field(node, coefficients), coefficients))
    fu, fv, u0, v0 = intrinsics
    return PinholeCamera(fu, fv, u0, v0, int(width), int(height), model, distortion)


def _field(node: Any, key: str) -> Any:
    """An entry that must be there."""
    if not isinstance(node, Mapping) or key not in node:
        raise CalibrationError(f"{key} is missing")
    return node[key]


def _numbers(value: Any, name: str, count: int | None = None) -> list[float]:
    """A flat list of finite numbers, `count` of them."""
    try:
        numbers = np.array(value, dtype=float).reshape(-1)
    except NO_NUMBERS:
        raise CalibrationError(f"{name} is not a list of numbers") from None
    if count is not None and len(numbers) != count:
        raise CalibrationError(f"{name} has {len(numbers)} numbers, {count} expected")
    require_possible(numbers, name)
    return [float(x) for x in numbers]


#: What making an array of numbers raises where the values are none: text, ragged lists, numbers of 400 digits.
NO_NUMBERS = (ValueError, TypeError, OverflowError)

#: Numbers of a calibration are smaller than this; larger ones overflow in what is made of them.
_MOST = 1e9


def require_possible(numbers: Array, name: str) -> None:
    """Raise where a number of a calibration is not finite, or larger than any in a calibration.

    Raises:
        CalibrationError: one is.
    """
    if not np.isfinite(numbers).all():
        raise CalibrationError(f"{name} is not finite: {numbers.tolist()}")
    if np.abs(numbers).max(initial=0) > _MOST:
        raise CalibrationError(f"{name} is impossibly large: {numbers.tolist()}")


def _transform(value: Any, name: str) -> Array:
    """A rigid motion (4, 4), given as rows or as ``{rows, cols, data}``."""
    data = value["data"] if isinstance(value, Mapping) and "data" in value else value
    T = np.array(_numbers(data, name, 16)).reshape(4, 4)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0:
        raise CalibrationError(f"{name} is not a rigid motion")
    return T


# ------------------------------------------------------------------------------------------------ KITTI


def read_kitti(path: Path) -> dict[str, Array]:
    """The ``name: numbers`` rows of KITTI's calibration files; rows that are no numbers (dates) are left out.

    The two-line form that holds only P0 and P1 and the old one without colons are accepted.

    Raises:
        CalibrationError: the file is missing or holds no such row.
    """
    rows: dict[str, Array] = {}
    for line in read_calibration(path).splitlines():
        name, _, rest = line.replace(":", " ", 1).strip().partition(" ")
        try:
            rows[name] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    if not rows:
        raise CalibrationError(f"{path}: no calibration in this file")
    return rows


def kitti_matrix(rows: Mapping[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """One finite matrix of a KITTI calibration."""
    if name not in rows:
        raise CalibrationError(f"{name} is missing")
    value = rows[name]
    if value.size != np.prod(shape):
        raise CalibrationError(f"{name} has {value.size} numbers, {int(np.prod(shape))} expected")
    require_possible(value, name)
    return value.reshape(shape)


def rig_from_projections(P_left: Array, P_right: Array, size: tuple[int, int]) -> StereoRig:
    """The rig of two rectified projections ``P = K [I | t]`` (3, 4) from one frame of reference.

    Offsets across the baseline below a thousandth of it are rounding of the file: such images are rectified.
    """
    b = projection_offset(P_right) - projection_offset(P_left)
    if np.abs(b[1:]).max() < 1e-3 * abs(b[0]):
        b[1:] = 0
    left, right = (PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *size) for P in (P_left, P_right))
    return StereoRig(left, right, np.eye(3), b)


def projection_offset(P: Array) -> Array:
    """``K⁻¹ p₄`` (3,) [m]: where the frame of reference's origin lies in this camera's axes.

    Raises:
        CalibrationError: P is no projection of a rectified camera.
    """
    K = P[:, :3]
    zeros = np.abs([K[0, 1], K[1, 0], K[2, 0], K[2, 1]]).max()
    if not (K[0, 0] > 0 and K[1, 1] > 0) or K[2, 2] != 1 or zeros > 0:
        raise CalibrationError(f"not a rectified projection matrix: {P.tolist()}")
    return np.asarray(np.linalg.solve(K, P[:, 3]), np.float64)
