"""KITTI's recordings as downloaded: odometry, tracking, raw (synchronised drives) and KITTI-360."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import CalibrationError, SequenceError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose
from slam.geometry.trajectory import TruthNoise
from slam.sequences.base import RecordedSequence
from slam.sequences.calibration import kitti_matrix, naming, projection_offset, read_kitti, rig_from_projections, rigid
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given
from slam.sequences.images import Size, size_text
from slam.sequences.kitti_truth import Frames, drive_truth, read_gps, read_poses
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.source import numbered, pair_up, read_times
from slam.sequences.tables import date_time, read_rows

#: The data sheet of KITTI's GPS/IMU unit (OXTS RT 3003, with RTK corrections): 2 cm, 0.03° in roll and pitch, and 0.1°
#: in heading, which changes slowly. That, and how the camera stands to the unit, is left to be found.
OXTS_NOISE = TruthNoise(rotation=float(np.radians(0.03)), translation=0.02, mounting=float(np.radians(1.0)))

#: Synchronised drives have one of a hundred OXTS records a second for each frame, the nearest one [s].
_OXTS_TIME = 0.01 / np.sqrt(12)

_PAIRS = (("0", "1"), ("2", "3"))  # grey first, colour where there is no grey


class Layout(NamedTuple):
    """Where the files of a sequence are."""

    name: str
    left: Path  # folders of images
    right: Path
    cameras: tuple[str, str]  # their numbers, as the calibration writes them
    calibration: Path  # the file, where it is or should be
    times: Path  # the file, which may be missing
    poses: tuple[Path, ...] = ()  # files of poses of the reference camera; the first that is there counts
    drive: Path | None = None  # the folder of a drive of KITTI raw or KITTI-360; None for odometry and tracking


def matches_folder(folder: Path) -> bool:
    """Whether a folder looks like a KITTI odometry sequence, or like the left images of one of KITTI tracking."""
    return any((folder / f"image_{i}").exists() for i in range(4)) or _is_tracking(folder)


def matches_drive(folder: Path) -> bool:
    """Whether a folder looks like a drive of KITTI raw or KITTI-360; KITTI tracking has folders of sequences there."""
    cameras = [path for i in range(4) if (path := folder / f"image_{i:02d}").exists()]
    inside = islice(cameras[0].iterdir(), 10) if cameras and cameras[0].is_dir() else ()
    return bool(cameras) and not any(path.name.isdecimal() and path.is_dir() for path in inside)


def open_folder(folder: Path, options: Given) -> RecordedSequence:
    """Open one sequence of KITTI odometry, or of KITTI tracking.

    Raises:
        SequenceError: a camera or all its images are missing, or nothing can be paired.
        CalibrationError: the calibration is missing, unreadable or impossible.
    """
    return _open(folder, _tracking(folder) if _is_tracking(folder) else _odometry(folder), options)


def open_drive(folder: Path, options: Given) -> RecordedSequence:
    """Open one drive of KITTI raw or KITTI-360; stamps count from its first row of times. Raises as `open_folder`."""
    return _open(folder, _drive(folder), options)


def _open(folder: Path, where: Layout, options: Given) -> RecordedSequence:
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        listings = [numbered(side, faults) for side in (where.left, where.right)]
        dated = where.drive is not None and where.times.is_file() and not {"times", "fps"} & set(options)
        origin, times = (
            _dates(where.times, faults) if dated else (None, read_times(folder, options, faults, where.times))
        )
        left, source = pair_up(listings[0], listings[1], options, faults, times, by_number=True)
        assert source.size is not None
        rig, T_left_reference = _rig(folder, where, source.size, options)
        frames, gps = Frames(left.keys, source.stamps, left.folder.parent.name == "image_00"), None
        if where.drive is None:
            poses = next((path for path in where.poses if path.is_file()), None)
            truth = None if poses is None else read_poses(poses, frames, T_left_reference, faults)
        else:
            gps = read_gps(where.drive / "ego_gps_m.txt", None if times is None else times[1], faults)
            truth = drive_truth(where.drive, where.calibration.parent, origin, T_left_reference, frames, faults)
    kind = options.get("kind", "driving")
    time = 0.0 if where.drive is None or (where.drive / "oxts").is_dir() else _OXTS_TIME
    noise = replace(OXTS_NOISE, time=time, wheels=kind == "driving")
    name = "kitti" if where.drive is None else "kitti-raw"
    return RecordedSequence(where.name, name, kind, rig, source, truth, gps, warnings, noise)


def _is_tracking(folder: Path) -> bool:
    """Whether a folder is ``image_02/0000`` with ``image_03/0000`` beside it."""
    return folder.parent.name == "image_02" and (folder.parent.parent / "image_03" / folder.name).is_dir()


def _odometry(folder: Path) -> Layout:
    a, b = _choose_pair(folder, _PAIRS)
    poses = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
    left, right = (folder / f"image_{camera}" for camera in (a, b))
    return Layout(folder.name, left, right, (a, b), folder / "calib.txt", folder / "times.txt", poses)


def _tracking(folder: Path) -> Layout:
    root, name = folder.parent.parent, folder.name
    calibration = root / "calib" / f"{name}.txt"
    if not calibration.exists():  # as downloaded: data_tracking_calib/training beside data_tracking_image_2/training
        others = sorted(root.parent.parent.glob(f"*/{root.name}/calib/{name}.txt"))
        calibration = others[0] if others else calibration
    return Layout(name, folder, root / "image_03" / name, ("2", "3"), calibration, root / f"times_{name}.txt")


def _drive(folder: Path) -> Layout:
    """Of KITTI raw the calibration is in the day's folder, or in the drive's own; of KITTI-360 in ``calibration``."""
    cameras = _choose_pair(folder, tuple((f"0{a}", f"0{b}") for a, b in _PAIRS))
    is_360 = (folder / f"image_{cameras[0]}" / "data_rect").exists()
    left, right = (folder / f"image_{camera}" / ("data_rect" if is_360 else "data") for camera in cameras)
    raw = [where / "calib_cam_to_cam.txt" for where in (folder.parent, folder)]
    usual = [where / "calibration" / "perspective.txt" for where in (folder.parent.parent, folder.parent)]
    usual = [*usual, *raw] if is_360 else [*raw, *usual]
    calibration = next((path for path in usual if path.exists()), usual[0])
    return Layout(folder.name, left, right, cameras, calibration, left.parent / "timestamps.txt", drive=folder)


def _choose_pair(folder: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    """The first pair of cameras of which both folders are there.

    Raises:
        SequenceError: no pair is complete.
    """
    for left, right in pairs:
        if all((folder / f"image_{c}").is_dir() for c in (left, right)):
            return left, right
    names = [f"image_{c}" for p in pairs for c in p]
    there = [n for n in names if (folder / n).is_dir()]
    files = [n for n in names if (folder / n).is_file()]
    if files:
        raise SequenceError(f"{folder / files[0]}: a file where a folder of images should be")
    found = f"only {', '.join(there)} is there" if there else "no folder of images is there"
    wanted = " or ".join(f"image_{a} and image_{c}" for a, c in pairs)
    raise SequenceError(f"{folder}: two cameras are needed ({wanted}), {found}")


def _dates(path: Path, faults: FaultLog) -> tuple[int, tuple[Path, Array]]:
    """The first row's time [ns since 1970] and the times by frame number (T,) [s] from there on."""
    rows = read_rows(path, date_time, faults)
    origin = next(row for row in rows if row is not None)
    return origin, (path, np.array([np.nan if row is None else (row - origin) * 1e-9 for row in rows]))


def _rig(folder: Path, where: Layout, size: Size, options: Given) -> tuple[StereoRig, Array]:
    """The rig, and the pose (4, 4) of the reference camera 0 (of a drive before rectification) in the left one."""
    named = calibration_files(folder, options) if "calibration" in options else None
    if not where.calibration.exists():
        if named is None:
            raise CalibrationError(f"{where.calibration}: the calibration is missing: add calibration=FILE")
        return read_rig(named, size, options), np.eye(4)
    T: Array = np.eye(4)
    rows = read_kitti(where.calibration)
    with naming(where.calibration):
        name = "P" if where.drive is None else "P_rect_"
        P_left, P_right = (kitti_matrix(rows, f"{name}{camera}", (3, 4)) for camera in where.cameras)
        if where.drive is not None:
            _require_rectified(rows, size, where.cameras[0])
            T = rigid(pose(kitti_matrix(rows, "R_rect_00", (3, 3)), np.zeros(3)), "R_rect_00")
        T = pose(np.eye(3), projection_offset(P_left)) @ T
        return read_rig(named, size, options) if named else rig_from_projections(P_left, P_right, size), T


def _require_rectified(rows: dict[str, Array], size: Size, camera: str) -> None:
    """Raise where images are of another size than the rectified ones: perhaps those of an unrectified drive."""
    expected = kitti_matrix(rows, f"S_rect_{camera}", (2,)).astype(int)
    if tuple(expected) != size:
        text = f"images are {size_text(size)}, S_rect_{camera} says {size_text(tuple(expected))}"
        if tuple(rows.get(f"S_{camera}", ())) == size:
            text += ": this is an unrectified (extract) drive, take the rectified (sync) one"
        raise CalibrationError(text)
