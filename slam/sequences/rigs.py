"""Rigs by calibration files of any form that a reader of sequences knows: `slam.load_rig`."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from slam.errors import CalibrationError, ConfigurationError
from slam.files import expanded
from slam.geometry.rig import StereoRig
from slam.sequences.calibration import (
    euroc_camera,
    kalibr_cameras,
    kitti_matrix,
    naming,
    read_kitti,
    rig_from_cameras,
    rig_from_projections,
)
from slam.sequences.images import Size
from slam.sequences.opencv_storage import opencv_rig
from slam.sequences.source import require_size
from slam.sequences.yaml_files import read_calibration

#: Options of the formats whose calibration is in a file that can be named.
OPTIONS = frozenset({"calibration", "unit", "rectified", "fisheye"})

_STORAGE_SUFFIXES = (".yaml", ".yml", ".xml", ".json")
_STEMS = ("calibration", "calib", "stereo", "camchain")
_ONE_FILE = tuple(stem + s for stem in _STEMS for s in _STORAGE_SUFFIXES)
_TWO_FILES = tuple((f"intrinsics{s}", f"extrinsics{s}") for s in _STORAGE_SUFFIXES)
_SENSORS = tuple(tuple(f"{root}{cam}/sensor.yaml" for cam in ("cam0", "cam1")) for root in ("", "mav0/"))
_KITTI = ("calib.txt", "calib_cam_to_cam.txt")
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_YES = {"1": True, "yes": True, "true": True, "0": False, "no": False, "false": False}


def load_rig(
    *paths: str | Path,
    size: tuple[int, int] | None = None,
    unit: str = "m",
    rectified: bool = False,
    fisheye: bool = False,
) -> StereoRig:
    """The rig of a calibration.

    Args:
        *paths: one file: OpenCV's (YAML, XML, JSON), Kalibr's camchain, KITTI's ``calib.txt`` or
            ``calib_cam_to_cam.txt``, or the numbers fx, fy, cx, cy [px] and baseline in YAML. Two files: OpenCV's
            intrinsics and extrinsics, or EuRoC's ``sensor.yaml`` of the left and the right camera. Or the folder where
            they are under their usual names.
        size: width and height of the images [px], where the file names none.
        unit: of length in an OpenCV file: ``"m"``, ``"cm"`` or ``"mm"``.
        rectified: of an OpenCV file take the rectified cameras (``P1``, ``P2``).
        fisheye: the distortion in an OpenCV file is ``cv2.fisheye``'s.

    Raises:
        CalibrationError: a file is missing, unreadable or of no known form, or the rig is impossible.
        ConfigurationError: an option that is none.

    Examples:
        >>> import slam
        >>> rig = slam.load_rig("calibration.yaml")  # doctest: +SKIP
    """
    options = {"unit": unit} | ({"rectified": "yes"} if rectified else {}) | ({"fisheye": "yes"} if fisheye else {})
    files = [expanded(path, CalibrationError) for path in paths]
    if not files:
        raise CalibrationError("no calibration is named")
    if len(files) == 1 and files[0].is_dir():
        files = _in_folder(files[0])
    return read_rig(files, size, options)


def read_rig(paths: Sequence[Path], size: Size | None, options: Mapping[str, str]) -> StereoRig:
    """The rig of one or two files, see `load_rig`.

    Args:
        paths: the files.
        size: of the images; None where it is not known.
        options: those of `OPTIONS` that are given.

    Raises:
        CalibrationError, ConfigurationError: see `load_rig`.
        SequenceError: the images are of another size than the calibration is for.
    """
    unit = options.get("unit", "m")
    if unit not in _UNITS:
        raise ConfigurationError(f"unit must be one of {', '.join(_UNITS)}, got {unit!r}")
    texts = [read_calibration(path) for path in paths]
    rig, owner = _other_form(paths, texts, size)
    if rig is None:
        rectified, fisheye = flag(options, "rectified"), flag(options, "fisheye")
        rig, expected = opencv_rig(paths, size, _UNITS[unit], rectified, fisheye)
    else:
        expected = (rig.width, rig.height)
        foreign = sorted(({"rectified", "fisheye"} | ({"unit"} if unit != "m" else set())) & set(options))
        if foreign:
            raise ConfigurationError(f"option {foreign[0]!r} goes with OpenCV's files, {paths[0]} is {owner}")
    if size is not None:
        require_size(size, expected, paths[0])
    return rig


def _other_form(paths: Sequence[Path], texts: Sequence[str], size: Size | None) -> tuple[StereoRig | None, str]:
    """The rig of files that are not OpenCV's, and whose they are; None where they are OpenCV's."""
    if len(paths) == 2 and all(re.search(r"^T_BS:", text, re.MULTILINE) for text in texts):
        left, right = (euroc_camera(path) for path in paths)
        return rig_from_cameras(left, right, paths[1]), "EuRoC's"
    if len(paths) == 1 and re.search(r"^cam\d+:", texts[0], re.MULTILINE):
        cameras = kalibr_cameras(paths[0])
        return rig_from_cameras(cameras[0], cameras[1], paths[0]), "Kalibr's"
    kitti = re.search(r"^(P|P_rect_0)0[: ]", texts[0], re.MULTILINE) if len(paths) == 1 else None
    return (_kitti_rig(paths[0], kitti[1], size), "KITTI's") if kitti else (None, "")


def _kitti_rig(path: Path, prefix: str, size: Size | None) -> StereoRig:
    """The rig of KITTI's grey cameras; the file of raw drives names the size of the images."""
    rows = read_kitti(path)
    with naming(path):
        left, right = (kitti_matrix(rows, f"{prefix}{side}", (3, 4)) for side in (0, 1))
        if "S_rect_00" in rows:
            width, height = kitti_matrix(rows, "S_rect_00", (2,))
            size = int(width), int(height)
        if size is None:
            raise CalibrationError("names no image size: give size=(width, height)")
        return rig_from_projections(left, right, size)


def calibration_files(folder: Path, options: Mapping[str, str]) -> list[Path]:
    """The file, or the two files, by the option ``calibration`` (names joined by a comma) or under usual names.

    Args:
        folder: of the sequence, or of the file that it is; of a camera the working folder. Names are relative to it.
        options: those that are given.

    Raises:
        CalibrationError: there is none.
    """
    if "calibration" in options:
        files = [folder / expanded(name, CalibrationError) for name in options["calibration"].split(",")]
        for name, file in zip(options["calibration"].split(","), files):
            if not os.path.exists(file) and os.path.exists(name):  # noqa: PTH110 false for what can be no name, too
                raise CalibrationError(f"{file}: there is no such file; calibration={name} is relative to {folder}")
        return files
    found = _usual(folder, (*((name,) for name in _ONE_FILE), *_TWO_FILES))
    if not found:
        raise CalibrationError(f"{folder}: the calibration is missing: calibration.yaml, or add calibration=FILE")
    return found


def _in_folder(folder: Path) -> list[Path]:
    """The files of a folder that is given in place of them."""
    singles = (*_ONE_FILE, *_KITTI, "dso/camchain.yaml")
    found = _usual(folder, (*((name,) for name in singles), *_TWO_FILES, *_SENSORS))
    if not found:
        raise CalibrationError(f"{folder}: no calibration under one of the usual names: name the file")
    return found


def _usual(folder: Path, names: Sequence[Sequence[str]]) -> list[Path]:
    """The first of several sets of files that is complete; empty where none is."""
    sets = ([folder / name for name in names_] for names_ in names)
    return next((files for files in sets if all(file.is_file() for file in files)), [])


def flag(options: Mapping[str, str], name: str) -> bool:
    """An option that is yes or no.

    Raises:
        ConfigurationError: it is neither.
    """
    text = options.get(name, "no").lower()
    if text not in _YES:
        raise ConfigurationError(f"{name} must be yes or no, got {text!r}")
    return _YES[text]
