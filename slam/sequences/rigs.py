"""Rigs by calibration files of any form: read as `slam.load_rig`, found in folders, and written."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.files import expanded, write_text
from slam.geometry.rig import StereoRig
from slam.sequences.calibration import is_kitti, naming
from slam.sequences.calibration_keys import read_entries, rig_of
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
_FISHEYE = "equidistant"


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


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write a rig, as recorded, with the entries of ``cv2.stereoCalibrate`` [m]; SlamError where that fails."""
    import cv2

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
