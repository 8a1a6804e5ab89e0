"""Rigs by calibration files of any form: what the entries describe, `slam.load_rig`, files found, and files written."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.files import expanded, write_text
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, pose, so3_exp
from slam.sequences.calibration import Entries, array, is_kitti, naming, plain_name, read_entries
from slam.sequences.images import Size, recorded_size, size_text
from slam.sequences.options import value_of

_USUAL = (
    *((stem + end,) for stem, end in product(
        ("calibration", "calib", "stereo", "camchain"), (".yaml", ".yml", ".xml", ".json", ".conf"))),
    *((a + end, b + end) for (a, b), end in product(
        (("intrinsics", "extrinsics"), ("left", "right")), (".yaml", ".yml"))),
)  # fmt: skip
_KITTI = ("calib.txt", "calib_cam_to_cam.txt")
_OF_FORMATS = (*((name,) for name in _KITTI), ("dso/camchain.yaml",), ("cam0/sensor.yaml", "cam1/sensor.yaml"),
               ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"))  # fmt: skip
_FISHEYE = ("equidistant", "fisheye", "kannalabrandt8", "kannalabrandt")
_PINHOLE = ("", "none", "radialtangential", "radtan", "plumbbob", "rationalpolynomial", "pinhole", "perspective",
            "rectified")  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FOUR = ("fx", "fy", "cx", "cy")

#: guard: shortest focal length as a share of the image's width: a pinhole camera of 170 degrees has 0.044.
_SHORTEST_FOCAL = 0.04

#: guard: largest skew as a share of the focal length: a thousandth moves the image's border by half a pixel.
_SKEW = 1e-3

#: guard: cosine of the widest angle between the optical axes of a stereo pair, 60 degrees.
_ALIKE = 0.5


def load_rig(
    *paths: str | Path,
    size: tuple[int, int] | None = None,
    unit: str = "m",
    rectified: bool = False,
    fisheye: bool = False,
) -> StereoRig:
    """The rig of a calibration.

    Args:
        *paths: one file: OpenCV's (YAML, XML, JSON), Kalibr's camchain, ORB-SLAM's or stella_vslam's settings, ZED's
            or depthai's file, KITTI's ``calib.txt`` or ``calib_cam_to_cam.txt``, or the numbers fx, fy, cx, cy [px]
            and baseline in YAML. Two files: OpenCV's intrinsics and extrinsics, ROS's or EuRoC's of the left and the
            right camera. Or the folder where they are under their usual names.
        size: width and height of the images [px], where the file names none.
        unit: of length in an OpenCV file: ``"m"``, ``"cm"`` or ``"mm"``.
        rectified: take the rectified cameras (``P1``, ``P2``).
        fisheye: the distortion in an OpenCV file is ``cv2.fisheye``'s.

    Raises:
        CalibrationError: a file is missing, unreadable or of no known form, or the rig is impossible.
        ConfigurationError: an option that is none.

    Examples:
        >>> import slam
        >>> rig = slam.load_rig("calibration.yaml")  # doctest: +SKIP
    """
    options = {"unit": value_of("unit", unit), "rectified": rectified, "fisheye": fisheye}
    files = [expanded(path, CalibrationError) for path in paths]
    if not files:
        raise CalibrationError("no calibration is named")
    if len(files) == 1 and files[0].is_dir():
        folder = files[0]
        files = _first(folder, [*_USUAL, *_OF_FORMATS])
        if not files:
            raise CalibrationError(f"{folder}: no calibration under one of the usual names: name the file")
    rig = read_rig(files, size, options)
    return StereoRig(*rig.as_recorded) if rig.turns else rig  # refused, unless the images are turned, too


def read_rig(paths: Sequence[Path], size: Size | None, options: Mapping[str, Any]) -> StereoRig:
    """The rig of one or two files, see `load_rig`; of cameras above each other, that of turned images.

    Of the `options` ``unit``, ``rectified`` and ``fisheye`` count. SequenceError where the images, of this size if it
    is known, are of another one than the calibration is for.
    """
    unit, rectified, fisheye = options.get("unit", 1.0), options.get("rectified", False), options.get("fisheye", False)
    entries = read_entries(paths, size)
    for name, given in (("unit", unit != 1), ("fisheye", fisheye)):
        if given and entries.form:
            raise ConfigurationError(f"option {name!r} does nothing with {paths[0]}, which is {entries.form}")
    with naming(paths[-1]):
        rig = rig_of(entries, size, unit, rectified, fisheye)
    if size is not None:
        require_size(size, rig, paths[0])
    return rig


def require_size(size: Size, rig: StereoRig, calibration: Path) -> None:
    """Raise SequenceError where images, as recorded, are not of the calibration's size."""
    expected = recorded_size(rig)
    if size != expected:
        raise SequenceError(f"images are {size_text(size)}, but {calibration} is for {size_text(expected)}")


def calibration_files(folder: Path, options: Mapping[str, Any], missing: str = "") -> list[Path]:
    """The file, or the two files, by the option ``calibration`` (names joined by a comma) or under usual names.

    Names are relative to the folder: the sequence's, or that of the file that it is; of a camera the working folder.
    CalibrationError, with the text `missing`, where there is none.
    """
    if "calibration" in options:
        names = options["calibration"].split(",")
        files = [folder / expanded(name, CalibrationError) for name in names]
        for name, file in zip(names, files):
            if not os.path.exists(file) and os.path.exists(name):  # noqa: PTH110 false for what can be no name, too
                raise CalibrationError(f"{file}: there is no such file; calibration={name} is relative to {folder}")
        return files
    texts = [folder / name for name in _KITTI if (folder / name).is_file()]
    files = _first(folder, _USUAL) or [file for file in texts if is_kitti(file)][:1]
    if not files:
        there = f" ({texts[0].name} is not of KITTI's form)" if texts else ""
        others = sorted(path.name for path in folder.iterdir() if path.suffix in (".yaml", ".yml", ".xml", ".json"))
        hint = f"; is it {', '.join(others[:3])}?" if others else ""
        usual = f"{folder}: the calibration is missing{there}: calibration.yaml, or add calibration=FILE"
        raise CalibrationError((missing or usual) + hint)
    return files


def _first(folder: Path, names: Sequence[Sequence[str]]) -> list[Path]:
    """The first of several sets of files that is complete; empty where none is."""
    sets = ([folder / name for name in names_] for names_ in names)
    return next((files for files in sets if all(file.is_file() for file in files)), [])


def rig_of(entries: Entries, images: Size | None, unit: float, rectified: bool, fisheye: bool) -> StereoRig:
    """The rig of calibration files, lengths in them in units of so many metres.

    Taken are two cameras with R and T as ``cv2.stereoCalibrate`` gives them (``h_right = R h_left + T``), with poses on
    a body, or with rectifications; for `rectified` images two projections, or fx, fy, cx, cy and baseline. The size of
    the images counts where the files name none; `fisheye` distortion is ``cv2.fisheye``'s. CalibrationError where
    entries are missing, or the rig is impossible.
    """
    sizes = [_size(entries, side) for side in (0, 1)]
    size = sizes[0] or sizes[1] or images
    if size is None:
        raise CalibrationError("names no image size: give size=(width, height)")
    P, K, four = ([entries.find(role, side) is not None for side in (0, 1)] for role in ("P", "K", "fx"))
    if rectified or (any(P) and not K[0] and not four[0]):
        if not all(P):
            raise entries.incomplete([f"P{side + 1}" for side in (0, 1) if not P[side]])
        return rig_from_projections(*_projections(entries, unit), size)
    T_right_left = _extrinsics(entries, unit)
    if T_right_left is None and not any(K) and (plain := _plain(entries, size, unit)) is not None:
        return plain
    missing = [f"K{side + 1}" for side in (0, 1) if not (K[side] or four[side])]
    missing += [role for role in ("R", "T") if T_right_left is None and entries.find(role) is None]
    if missing or T_right_left is None:
        raise entries.incomplete(missing)
    cameras = [_camera(entries, side, sizes[side] or size, fisheye) for side in (0, 1)]
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    b = R.T @ t  # h_right = R (h_left + b), paper A, Eq. 6
    if entries.form and b[0] > np.abs(b).max() / 2:
        raise CalibrationError(
            f"the second camera stands {b[0]:.4f} m to the left of the first one: are the cameras swapped? The "
            "first one of a calibration is the left one"
        )
    if R[2, 2] < _ALIKE:
        apart = np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))
        raise CalibrationError(f"the cameras look {apart:.0f} degrees apart: is a rotation in degrees?")
    return StereoRig.side_by_side(cameras[0], cameras[1], R, b)


def rig_from_projections(P_left: Array, P_right: Array, size: Size) -> StereoRig:
    """The rig of two rectified projections ``P = K [I | t]`` (3, 4) from one frame of reference."""
    b = projection_offset(P_right) - projection_offset(P_left)
    b[np.abs(b) < 1e-3 * np.abs(b).max()] = 0  # across the baseline: rounding of the file
    left, right = (PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *size) for P in (P_left, P_right))
    return StereoRig.side_by_side(left, right, np.eye(3), b)


def projection_offset(P: Array) -> Array:
    """``K⁻¹ p₄`` (3,) [m], the frame of reference's place in this camera's axes; CalibrationError for no such P."""
    K = P[:, :3]
    zeros = np.abs([K[0, 1], K[1, 0], K[2, 0], K[2, 1]]).max()
    if not (K[0, 0] > 0 and K[1, 1] > 0) or K[2, 2] != 1 or zeros > 0:
        raise CalibrationError(f"not a rectified projection matrix: {P.tolist()}")
    return np.asarray(np.linalg.solve(K, P[:, 3]), np.float64)


def rigid(T: Array, name: str) -> Array:
    """The rigid motion (4, 4); CalibrationError where its rotation is none."""
    R = T[:3, :3]
    if np.abs(R).max() > 1.01 or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CalibrationError(f"{name} is not a rigid motion: its rotation is {R.tolist()}")
    return T


def body_pose(entries: Entries, side: int) -> Array | None:
    """``T_body_camera`` (4, 4) of a camera; None where the files name no body."""
    T_body_camera, T_camera_body = (entries.numbers(role, side, (4, 4)) for role in ("T_BS", "T_cam_imu"))
    if T_body_camera is not None:
        return rigid(T_body_camera, "T_BS")
    return None if T_camera_body is None else inverse(rigid(T_camera_body, "T_cam_imu"))


def _extrinsics(entries: Entries, unit: float) -> Array | None:
    """``T_right_left`` (4, 4) [m], by whichever entries say it; None where none does."""
    R, t = entries.numbers("R", None, None), entries.numbers("T", None, (3,))
    if R is not None and t is not None:
        return pose(so3_exp(R) if R.size == 3 else array(R, "R", (3, 3)), unit * t)
    T_body_left, T_body_right = body_pose(entries, 0), body_pose(entries, 1)
    if T_body_left is not None and T_body_right is not None:
        return inverse(T_body_right) @ T_body_left
    for role, turned in (("T_cn_cnm1", False), ("T_c1_c2", True)):
        T = entries.numbers(role, None, (4, 4))
        if T is not None:
            return inverse(rigid(T, role)) if turned else rigid(T, role)
    left, right = (entries.numbers("R_rect", side, (3, 3)) for side in (0, 1))
    offset = None  # of the rectified left camera in the rectified right one's axes (3,) [m]
    if all(entries.find("P", side) for side in (0, 1)):
        P_left, P_right = _projections(entries, unit)
        offset = projection_offset(P_right) - projection_offset(P_left)
    elif entries.find("baseline"):
        offset = np.array([-unit * entries.number("baseline"), 0.0, 0.0])
    elif entries.find("bf") and entries.find("fx"):
        offset = np.array([-unit * entries.number("bf") / entries.number("fx"), 0.0, 0.0])
    return None if left is None or right is None or offset is None else pose(right.T @ left, right.T @ offset)


def _projections(entries: Entries, unit: float) -> tuple[Array, Array]:
    """Both projections (3, 4), their last column for metres."""
    left, right = (entries.numbers("P", side, (3, 4)) for side in (0, 1))
    assert left is not None and right is not None
    if left[0, 3] == right[0, 3] and left[1, 3] == right[1, 3]:
        raise CalibrationError("the cameras are not calibrated as a pair: P of the right one holds no baseline")
    scale = np.array([1, 1, 1, unit])
    return left * scale, right * scale


def _plain(entries: Entries, size: Size, unit: float) -> StereoRig | None:
    """A rectified rig of two equal cameras by five numbers; None where there are none."""
    side = 0 if entries.find("fx") is None and entries.find("fx", 0) else None
    last = "bf" if entries.find("baseline") is None and entries.find("bf") else "baseline"
    if not any(entries.find(role, side) for role in _FOUR) and not entries.find(last):
        return None
    try:
        fx, fy, cx, cy, length = (*(entries.number(role, side) for role in _FOUR), entries.number(last))
        if min(fx, fy, length) <= 0:
            raise CalibrationError(f"fx, fy and {last} must be positive")
    except CalibrationError as error:
        raise CalibrationError(f"{error} (a rectified pair needs fx, fy, cx, cy in pixels and baseline)") from None
    if any(entries.number(role, side, 0.0) for role in _COEFFICIENTS):
        raise CalibrationError("names distortion, but only one camera: images of five numbers are rectified")
    _require_pixels(fx, size)
    camera = PinholeCamera(fx, fy, cx, cy, *size)
    b = np.array([-unit * length / (fx if last == "bf" else 1), 0, 0])
    return StereoRig.side_by_side(camera, camera, np.eye(3), b)


def _require_pixels(focal: float, size: Size) -> None:
    if focal < _SHORTEST_FOCAL * size[0]:
        raise CalibrationError(f"a focal length of {focal:g} px for images {size[0]} px wide: is it in pixels?")


def _camera(entries: Entries, side: int, size: Size, fisheye: bool) -> PinholeCamera:
    """One camera from its matrix, or its four numbers, and its distortion."""
    for role in ("distortion model", "camera model"):
        model = entries.find(role, side) or entries.find(role) or ("", "")
        name = plain_name(model[1])
        if name not in _FISHEYE + _PINHOLE and (entries.form or role == "distortion model"):
            raise CalibrationError(f"{role} {model[1]!r} is not supported")
        fisheye = fisheye or name in _FISHEYE
    K = _matrix(entries, side)
    _require_pixels(K[0, 0], size)
    D = entries.numbers("D", side, None)
    if D is None:
        names = ("k1", "k2", "k3", "k4") if fisheye else _COEFFICIENTS
        D = np.array([entries.number(name, side, 0.0) for name in names])
    D = D[:4] if fisheye else D
    if 0 < len(D) < 4:
        raise CalibrationError(f"distortion model takes 4 coefficients or more, got {len(D)}")
    return PinholeCamera.from_matrix(K, D if D.any() or fisheye else None, size, fisheye)


def _matrix(entries: Entries, side: int) -> Array:
    """A camera matrix (3, 3), by its own entry or by four numbers."""
    found = entries.find("K", side)
    name = found[0] if found else "K"
    values = array(found[1], name, None) if found else np.array([entries.number(role, side) for role in _FOUR])
    if len(values) not in (4, 9):
        raise CalibrationError(f"{name} has {len(values)} numbers; it has fx, fy, cx, cy, or 3 rows of 3")
    if len(values) == 4:
        fx, fy, cx, cy = values
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    K = values.reshape(3, 3)
    if abs(K[0, 1]) > _SKEW * abs(K[0, 0]) or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        raise CalibrationError(f"{name} is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {K.tolist()}")
    return K


def _size(entries: Entries, side: int) -> Size | None:
    """Width and height of a camera's images, where the files name them."""
    for which in (side, None):
        both = entries.numbers("size", which, (2,))
        if both is not None:
            return int(both[0]), int(both[1])
        if entries.find("width", which) and entries.find("height", which):
            return int(entries.number("width", which)), int(entries.number("height", which))
    return None


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write a rig, as recorded, with the entries of ``cv2.stereoCalibrate`` [m]; SlamError where that fails."""
    import cv2

    left, right, R, b = rig.as_recorded
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    storage.write("image_width", left.width)
    storage.write("image_height", left.height)
    if rig.left.model == "equidistant":
        storage.write("distortion_model", "equidistant")
    for number, camera in enumerate((left, right), 1):
        storage.write(f"K{number}", camera.K)
        storage.write(f"D{number}", np.array([camera.distortion or (0.0,) * 4]))
    storage.write("R", R)
    storage.write("T", (R @ b).reshape(3, 1))
    write_text(path, storage.releaseAndGetString())
