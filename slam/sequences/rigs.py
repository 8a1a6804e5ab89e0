"""Rigs by calibration files of any form: what the entries describe, `slam.load_rig`, files found, and files written."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.camera import PinholeCamera, baseline_doubt, is_camera_matrix, size_doubt
from slam.geometry.rig import NOT_SIDE_BY_SIDE, StereoRig
from slam.geometry.se3 import Array, inverse, is_rotation, pose, so3_exp
from slam.sequences.calibration import Entries, array, naming, plain_name, read_entries
from slam.sequences.images import Size, recorded_size, size_text
from slam.sequences.options import value_of

logger = logging.getLogger("slam.sequences")

_ENDINGS = (".yaml", ".yml", ".xml", ".json", ".conf")
_USUAL = (
    *((stem + end,) for stem, end in product(
        ("calibration", "calib", "stereo", "camchain"), _ENDINGS)),
    *((a + end, b + end) for (a, b), end in product(
        (("intrinsics", "extrinsics"), ("left", "right")), (".yaml", ".yml"))),
    ("calib.txt",), ("calib_cam_to_cam.txt",),
)  # fmt: skip

#: EuRoC's calibrations, from the folder that holds the cameras.
EUROC = (("cam0/sensor.yaml", "cam1/sensor.yaml"),
         *((f"{at}camchain.yaml",) for at in ("", "dso/", "../", "../dso/")))  # fmt: skip

_FISHEYE = ("equidistant", "fisheye", "kannalabrandt8", "kannalabrandt")
_PINHOLE = ("", "none", "radialtangential", "radtan", "plumbbob", "rationalpolynomial", "pinhole", "perspective",
            "rectified")  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FOUR = ("fx", "fy", "cx", "cy")

#: guard: shortest focal length as a share of the image's width: a pinhole camera of 170 degrees has 0.044.
_SHORTEST_FOCAL = 0.04

#: guard: cosine of the widest angle between the optical axes of a stereo pair, 60 degrees.
_ALIKE = 0.5


def load_rig(
    *paths: str | Path,
    size: tuple[int, int] | None = None,
    unit: str = "m",
    rectified: bool = False,
    fisheye: bool = False,
) -> StereoRig:
    """The rig of a calibration; a length of the baseline or a size that no rig has is logged.

    Args:
        *paths: one file: OpenCV's (YAML, XML, JSON), Kalibr's camchain, ORB-SLAM's or stella_vslam's settings, ZED's
            or depthai's file, KITTI's ``calib.txt`` or ``calib_cam_to_cam.txt``, or the numbers fx, fy, cx, cy [px]
            and baseline in YAML. Two files: OpenCV's intrinsics and extrinsics, ROS's or EuRoC's of the left and the
            right camera. Or the folder where they are under their usual names.
        size: width and height of the images [px], where the file names none.
        unit: of length in an OpenCV file: ``"m"``, ``"cm"``, ``"mm"`` or ``"in"``, inches.
        rectified: take the rectified cameras (``P1``, ``P2``).
        fisheye: the distortion in an OpenCV file is ``cv2.fisheye``'s.

    Raises:
        CalibrationError: a file is missing, unreadable or of no known form, or the rig is impossible.
        ConfigurationError: an option that is none.
    """
    options = {"unit": value_of("unit", unit), "rectified": rectified, "fisheye": fisheye}
    files = [expanded(path, CalibrationError) for path in paths]
    if not files:
        raise CalibrationError("no calibration is named")
    if len(files) == 1 and files[0].is_dir():
        folder = files[0]
        files = first_complete([*files_in(folder, (*_USUAL, *EUROC)), *files_in(folder / "mav0", EUROC)])
        if not files:
            raise CalibrationError(f"{folder}: no calibration under one of the usual names: name the file")
    rig = read_rig(files, size, options)
    if rig.turns:  # and the images are not
        raise CalibrationError(NOT_SIDE_BY_SIDE)
    for doubt in filter(None, (baseline_doubt(rig.baseline), size_doubt(rig.left, rig.right))):
        logger.warning("%s: %s", " and ".join(map(str, files)), doubt)
    return rig


def read_rig(
    paths: Sequence[Path], size: Size | None, options: Mapping[str, Any], cameras: tuple[str, str] = ("0", "1")
) -> StereoRig:
    """The rig of one or two files, see `load_rig` and `rig_of`; `cameras` are the numbers of two in KITTI's files."""
    source = Path(" and ".join(map(str, paths)))  # which of two is at fault, the message says
    return rig_of(read_entries(paths, size, cameras), source, size, options)


def rig_of(entries: Entries, source: Path, size: Size | None, options: Mapping[str, Any]) -> StereoRig:
    """The rig of the entries of a calibration, the `source`; of cameras above each other, that of turned images.

    Of the `options` ``unit``, ``rectified`` and ``fisheye`` count. SequenceError where the images, of this size if it
    is known, are not of the calibration's; CalibrationError where entries are missing, or the rig is impossible.
    """
    unit, rectified, fisheye = options.get("unit", 1.0), options.get("rectified", False), options.get("fisheye", False)
    for name, given in (("unit", unit != 1), ("fisheye", fisheye)):
        if given and entries.form:
            raise ConfigurationError(f"option {name!r} does nothing with {source}, which is {entries.form}")
    with naming(source):
        if unit == 1 and not entries.form and (named := entries.find("unit")):
            try:
                unit = value_of("unit", str(named[1]).strip())
            except ConfigurationError as error:
                raise CalibrationError(str(error)) from None
        rig = _rig(entries, size, unit, rectified, fisheye)
    if fisheye and "equidistant" not in (rig.left.model, rig.right.model):
        raise ConfigurationError(f"option 'fisheye' does nothing with {source}: by it the images have no distortion")
    expected = recorded_size(rig)
    if size not in (None, expected):
        raise SequenceError(f"images are {size_text(size or ())}, those of {source} are {size_text(expected)}")
    return rig


def calibration_files(folder: Path, options: Mapping[str, Any], own: Sequence[Sequence[Path]] = ()) -> list[Path]:
    """The file, or two files, by the option ``calibration`` (joined by a comma), of the format's `own`, or usual ones.

    Names are relative to the folder: the sequence's, or that of the file that it is; of a camera the working folder.
    CalibrationError where there is none.
    """
    if "calibration" in options:
        names = options["calibration"].split(",")
        files = [folder / expanded(name, CalibrationError) for name in names]
        for name, file in zip(names, files):
            if not os.path.exists(file) and os.path.exists(name):  # noqa: PTH110 false for what can be no name, too
                raise CalibrationError(f"{file}: there is no such file; calibration={name} is relative to {folder}")
        return files
    files = first_complete([*own, *files_in(folder, _USUAL)])
    if not files:
        first = next(path for path in (own[0] if own else [folder / "calibration.yaml"]) if not path.is_file())
        others = sorted(path.name for path in folder.iterdir() if path.suffix in _ENDINGS)
        hint = f"; is it {', '.join(others[:3])}?" if others else ""
        raise CalibrationError(f"{first}: the calibration is missing: add calibration=FILE{hint}")
    return files


def files_in(folder: Path, sets: Iterable[Sequence[str]]) -> list[list[Path]]:
    """Files of a folder by sets of their names."""
    return [[folder / name for name in names] for names in sets]


def first_complete(sets: Iterable[Sequence[Path]]) -> list[Path]:
    """The first set of files that are all there; empty where none is."""
    return next((list(files) for files in sets if all(file.is_file() for file in files)), [])


def _rig(entries: Entries, images: Size | None, unit: float, rectified: bool, fisheye: bool) -> StereoRig:
    """The rig of two cameras, each with its matrix and distortion, and how they stand; or of two projections."""
    sizes = [_size(entries, side) for side in (0, 1)]
    size = sizes[0] or sizes[1] or images
    if size is None:
        raise CalibrationError("names no image size: give size=(width, height)")
    with_K = [bool(entries.find("K", side) or entries.find("fx", side)) for side in (0, 1)]
    with_P = [bool(entries.find("P", side)) for side in (0, 1)]
    if rectified or (any(with_P) and not with_K[0]):
        if not all(with_P):
            raise entries.incomplete([f"P{side + 1}" for side in (0, 1) if not with_P[side]])
        return _rectified(_projections(entries, unit) or [], size)
    T_right_left = _extrinsics(entries, unit)
    if T_right_left is None and not any(entries.find("K", side) for side in (0, 1)):
        P = _projections(entries, unit)
        if P is not None:
            return _rectified(P, size)
    missing = [f"K{side + 1}" for side in (0, 1) if not with_K[side]]
    missing += [role for role in ("R", "T") if T_right_left is None and entries.find(role) is None]
    if missing or T_right_left is None:
        raise entries.incomplete(missing)
    left, right = (_camera(entries, side, sizes[side] or size, fisheye) for side in (0, 1))
    for side, other in enumerate((right, left)):
        if other.has_distortion and not any(entries.find(role, side) for role in ("D", *_COEFFICIENTS)):
            raise entries.incomplete([f"D{side + 1}"])
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    b = R.T @ t  # h_right = R (h_left + b), paper A, Eq. 6
    if entries.form and b[0] > np.abs(b).max() / 2:
        raise CalibrationError(
            f"the second camera stands {b[0]:.4f} m to the left of the first one: are the cameras swapped (the first "
            "one of a calibration is the left one), or is its pose the inverse one?"
        )
    if R[2, 2] < _ALIKE:
        apart = np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))
        raise CalibrationError(f"the cameras look {apart:.0f} degrees apart: is a rotation in degrees?")
    return StereoRig.side_by_side(left, right, R, b)


def _rectified(projections: Sequence[Array], size: Size) -> StereoRig:
    """The rig of two rectified projections ``P = K [I | t]`` (3, 4) [m] from one frame of reference."""
    offsets = [projection_offset(P) for P in projections]
    b = offsets[1] - offsets[0]
    b[np.abs(b) < 1e-3 * np.abs(b).max()] = 0  # across the baseline: rounding of the file
    for P in projections:
        _require_pixels(P[0, 0], size)
    left, right = (PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *size) for P in projections)
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
    if not is_rotation(T[:3, :3], 1e-3):
        raise CalibrationError(f"{name} is not a rigid motion: its rotation is {T[:3, :3].tolist()}")
    return T


def body_pose(entries: Entries, side: int) -> Array | None:
    """``T_body_camera`` (4, 4) of a camera; None where the files name no body."""
    return _motion(entries, "T_BS", side, "T_cam_imu")


def _motion(entries: Entries, role: str, side: int | None, opposite: str) -> Array | None:
    """A rigid motion (4, 4) by its own entry, or by that of the opposite one; None where there is neither."""
    T, T_opposite = (entries.numbers(name, side, (4, 4)) for name in (role, opposite))
    if T is not None:
        return rigid(T, role)
    return None if T_opposite is None else inverse(rigid(T_opposite, opposite))


def _extrinsics(entries: Entries, unit: float) -> Array | None:
    """``T_right_left`` (4, 4) [m], by whichever entries say it; None where none does."""
    R, t = entries.numbers("R", None, None), entries.numbers("T", None, (3,))
    if R is not None and t is not None:
        return pose(so3_exp(R) if R.size == 3 else array(R, "R", (3, 3)), unit * t)
    T_body_left, T_body_right = body_pose(entries, 0), body_pose(entries, 1)
    if T_body_left is not None and T_body_right is not None:
        return inverse(T_body_right) @ T_body_left
    T_right_left = _motion(entries, "T_cn_cnm1", None, "T_c1_c2")
    left, right = (entries.numbers("R_rect", side, (3, 3)) for side in (0, 1))
    if T_right_left is not None or left is None or right is None:
        return T_right_left
    P = _projections(entries, unit)
    return None if P is None else pose(right.T @ left, right.T @ (projection_offset(P[1]) - projection_offset(P[0])))


def _projections(entries: Entries, unit: float) -> Sequence[Array] | None:
    """Both projections (3, 4) [m], perhaps by five numbers of a rectified pair of equal cameras; None for neither."""
    P = [entries.numbers("P", side, (3, 4)) for side in (0, 1)]
    found = [own * [1, 1, 1, unit] for own in P if own is not None]
    if len(found) == 2:
        if (found[0][:2, 3] == found[1][:2, 3]).all():
            raise CalibrationError("the cameras are not calibrated as a pair: P of the right one holds no baseline")
        return found
    side = 0 if entries.find("fx") is None and entries.find("fx", 0) else None
    last = "bf" if entries.find("baseline") is None and entries.find("bf") else "baseline"
    if not any(entries.find(role, side) for role in _FOUR) and not entries.find(last):
        return None
    try:
        (fx, _, cx), (_, fy, cy) = _matrix(entries, side)[:2].tolist()
        length = entries.number(last)
        if min(fx, fy, length) <= 0:
            raise CalibrationError(f"fx, fy and {last} must be positive")
    except CalibrationError as error:
        raise CalibrationError(f"{error} (a rectified pair needs fx, fy, cx, cy in pixels and baseline)") from None
    D = entries.numbers("D", side, None)
    if any(entries.number(role, side, 0.0) for role in _COEFFICIENTS) or (D is not None and D.any()):
        raise CalibrationError("names distortion, but only one camera: images of five numbers are rectified")
    left: Array = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -unit * (length if last == "bf" else fx * length)
    return [left, right]


def _require_pixels(focal: float, size: Size) -> None:
    if focal < _SHORTEST_FOCAL * size[0]:
        raise CalibrationError(f"a focal length of {focal:g} px for images {size[0]} px wide: is it in pixels?")


def _camera(entries: Entries, side: int, size: Size, fisheye: bool) -> PinholeCamera:
    """One camera from its matrix, or its four numbers, and its distortion."""
    for role in ("distortion model", "camera model"):
        _, model = entries.find(role, side) or entries.find(role) or ("", "")
        name = plain_name(model)
        if name not in _FISHEYE + _PINHOLE and (entries.form or role == "distortion model"):
            raise CalibrationError(f"{role} {model!r} is not supported")
        fisheye = fisheye or name in _FISHEYE
    K = _matrix(entries, side)
    _require_pixels(K[0, 0], size)
    D = entries.numbers("D", side, None)
    if D is None:
        names = ("k1", "k2", "k3", "k4") if fisheye else _COEFFICIENTS
        D = np.array([entries.number(name, side, 0.0) for name in names])
    if 0 < len(D) < 4:
        name = (entries.find("D", side) or ("distortion", ""))[0]
        raise CalibrationError(f"{name}: a distortion takes 4 coefficients or more, got {len(D)}")
    D = D[:4] if fisheye else D
    return PinholeCamera.from_matrix(K, D if D.any() or fisheye else None, size, fisheye)


def _matrix(entries: Entries, side: int | None) -> Array:
    """A camera matrix (3, 3), by its own entry or by four numbers."""
    name, _ = entries.find("K", side) or ("K", None)
    values = entries.numbers("K", side, None)
    if values is None:
        values = np.array([entries.number(role, side) for role in _FOUR])
    if len(values) not in (4, 9):
        raise CalibrationError(f"{name} has {len(values)} numbers; it has fx, fy, cx, cy, or 3 rows of 3")
    if len(values) == 4:
        fx, fy, cx, cy = values
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    K = values.reshape(3, 3)
    if not is_camera_matrix(K):
        raise CalibrationError(f"{name} is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {K.tolist()}")
    return K


def _size(entries: Entries, side: int) -> Size | None:
    """Width and height of a camera's images, where the files name them."""
    for which in (side, None):
        both = entries.numbers("size", which, (2,))
        if both is None and entries.find("width", which) and entries.find("height", which):
            both = np.array([entries.number(role, which) for role in ("width", "height")])
        if both is not None:
            return int(both[0]), int(both[1])
    return None
