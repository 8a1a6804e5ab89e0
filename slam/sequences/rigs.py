"""Rigs by calibration files of any form that a reader of sequences knows: `slam.load_rig`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from slam.errors import CalibrationError, ConfigurationError
from slam.files import expanded
from slam.geometry.rig import StereoRig
from slam.sequences.calibration import naming
from slam.sequences.calibration_forms import is_kitti
from slam.sequences.calibration_keys import read_entries, rig_of
from slam.sequences.given import CALIBRATION_OPTIONS, flag, metres_per_unit
from slam.sequences.images import Size
from slam.sequences.source import require_size

OPTIONS = CALIBRATION_OPTIONS

_SUFFIXES = (".yaml", ".yml", ".xml", ".json", ".conf")
_STEMS = ("calibration", "calib", "stereo", "camchain")
_PAIRS = (("intrinsics", "extrinsics"), ("left", "right"))
_USUAL = (
    *((stem + s,) for stem in _STEMS for s in _SUFFIXES),
    *((a + s, b + s) for a, b in _PAIRS for s in _SUFFIXES[:2]),
)
_KITTI = ("calib.txt", "calib_cam_to_cam.txt")
_SENSORS = tuple((f"{root}cam0/sensor.yaml", f"{root}cam1/sensor.yaml") for root in ("", "mav0/"))


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
        folder, kitti = files[0], [(name,) for name in _KITTI]
        files = _first(folder, [*_USUAL, *kitti, ("dso/camchain.yaml",), *_SENSORS])
        if not files:
            raise CalibrationError(f"{folder}: no calibration under one of the usual names: name the file")
    rig = read_rig(files, size, options)
    return StereoRig(*rig.as_recorded) if rig.turns else rig  # refused, unless the images are turned, too


def read_rig(paths: Sequence[Path], size: Size | None, options: Mapping[str, str]) -> StereoRig:
    """The rig of one or two files, see `load_rig`; of cameras above each other, that of turned images.

    Args:
        paths: the files.
        size: of the images; None where it is not known.
        options: those of `OPTIONS` that are given.

    Raises:
        CalibrationError, ConfigurationError: see `load_rig`.
        SequenceError: the images are of another size than the calibration is for.
    """
    unit = metres_per_unit(options)
    entries = read_entries(paths, size)
    rectified, fisheye = flag(options, "rectified"), flag(options, "fisheye")
    given = {"rectified", "fisheye"} | ({"unit"} if unit != 1 else set())
    foreign = sorted((given & set(options)) - set(entries.options))
    if foreign:
        raise ConfigurationError(f"option {foreign[0]!r} does nothing with {paths[0]}, which is {entries.form}")
    with naming(paths[-1]):
        rig = rig_of(entries, size, unit, rectified, fisheye)
    if size is not None:
        require_size(size, rig, paths[0])
    return rig


def calibration_files(folder: Path, options: Mapping[str, str], missing: str = "") -> list[Path]:
    """The file, or the two files, by the option ``calibration`` (names joined by a comma) or under usual names.

    Args:
        folder: of the sequence, or of the file that it is; of a camera the working folder. Names are relative to it.
        options: those that are given.
        missing: what is said where there is none.

    Raises:
        CalibrationError: there is none.
    """
    if "calibration" in options:
        names = options["calibration"].split(",")
        files = [folder / expanded(name, CalibrationError) for name in names]
        for name, file in zip(names, files):
            if not os.path.exists(file) and os.path.exists(name):  # noqa: PTH110 false for what can be no name, too
                raise CalibrationError(f"{file}: there is no such file; calibration={name} is relative to {folder}")
        return files
    files = _first(folder, _USUAL)
    texts = [folder / name for name in _KITTI if (folder / name).is_file()]
    files = files or [file for file in texts if is_kitti(file)][:1]
    if not files:
        there = f" ({texts[0].name} is not of KITTI's form)" if texts else ""
        usual = f"{folder}: the calibration is missing{there}: calibration.yaml, or add calibration=FILE"
        raise CalibrationError(missing or usual)
    return files


def _first(folder: Path, names: Sequence[Sequence[str]]) -> list[Path]:
    """The first of several sets of files that is complete; empty where none is."""
    sets = ([folder / name for name in names_] for names_ in names)
    return next((files for files in sets if all(file.is_file() for file in files)), [])
