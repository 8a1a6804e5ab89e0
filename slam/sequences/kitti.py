"""KITTI's recordings as downloaded, and their true paths: odometry, tracking, raw (synchronised) and KITTI-360."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.se3 import Array, about, inverse, pose
from slam.geometry.stamps import increasing
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.sequences.base import FaultLog, RecordedSequence
from slam.sequences.calibration import array, naming, read_kitti
from slam.sequences.names import stem
from slam.sequences.options import Options
from slam.sequences.pairs import image_names, listed, open_images, told_times
from slam.sequences.rigs import calibration_files, projection_offset, read_rig, rigid
from slam.sequences.tables import Times, date_time, numbers, read_rows, require_truth

#: The data sheet of KITTI's GPS/IMU unit (OXTS RT 3003, with RTK corrections): 2 cm, 0.03° in roll and pitch, and 0.1°
#: in heading, which changes slowly. That, and how the camera stands to the unit, is left to be found.
OXTS_NOISE = TruthNoise(rotation=float(np.radians(0.03)), translation=0.02, mounting=float(np.radians(1.0)))

#: Synchronised drives have one of a hundred OXTS records a second for each frame, the nearest one [s].
_OXTS_TIME = 0.01 / np.sqrt(12)

_COUNT = re.compile(r"\d{1,18}", re.ASCII)  # the name of a record
_EARTH_RADIUS, _ECCENTRICITY = 6378137.0, 0.0818191908426  # of the earth's ellipsoid (WGS 84): equatorial [m]
_OXTS = "latitude, longitude, altitude, roll, pitch, yaw"


class Layout(NamedTuple):
    """Where the files of a sequence are."""

    name: str
    folders: list[Path]  # of left and right images
    cameras: tuple[str, str]  # their numbers
    calibrations: list[Path]  # where the calibration may be
    times: Path  # the file, which may be missing
    poses: list[Path]  # of the reference camera; the first that is there counts
    drive: Path | None = None  # the folder of a drive of KITTI raw or KITTI-360; None for odometry and tracking

    @property
    def calibration(self) -> Path | None:
        """The file, if there is one."""
        return next((path for path in self.calibrations if path.is_file()), None)


def matches_folder(folder: Path) -> bool:
    """Whether a folder looks like a KITTI odometry sequence, or like the left images of one of KITTI tracking."""
    return any((folder / f"image_{i}").exists() for i in range(4)) or _is_tracking(folder)


def matches_drive(folder: Path) -> bool:
    """Whether a folder looks like a drive of KITTI raw or KITTI-360; KITTI tracking has folders of sequences there."""
    cameras = [path for i in range(4) if (path := folder / f"image_{i:02d}").exists()]
    inside = islice(cameras[0].iterdir(), 10) if cameras and cameras[0].is_dir() else ()
    return bool(cameras) and not any(path.name.isdecimal() and path.is_dir() for path in inside)


def open_folder(folder: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open one sequence of KITTI odometry, KITTI tracking, KITTI raw or KITTI-360."""
    if matches_drive(folder):
        where = _drive(folder)
    else:
        where = _tracking(folder) if _is_tracking(folder) else _odometry(folder)
    sides = listed(where.folders, [image_names(images) for images in where.folders], faults)
    origin = None
    if where.drive is not None and where.times.is_file() and not {"times", "fps"} & set(options):
        dates = read_rows(where.times, date_time, faults)
        origin = next(date for date in dates if date is not None)
        seconds = np.array([np.nan if date is None else (date - origin) * 1e-9 for date in dates])
        times: Times | None = Times(where.times, seconds, [])
    else:
        times = told_times(folder, options, faults, where.times)
    pairs, decode, size = open_images(sides, options, faults, times, by_number=True)
    files = calibration_files(folder, options, [[path] for path in where.calibrations])
    rig = read_rig(files, size, options, where.cameras)
    by_number = dict(zip((pairs.rows[:, 0] if sides[0].stamped else pairs.keys).tolist(), pairs.stamps.tolist()))
    try:
        truth = _truth(where, origin, by_number, faults)
    except (SequenceError, CalibrationError, TrajectoryError) as error:
        faults.report("ground truth", f"{error}; there is no ground truth")
        truth = None
    kind = options.get("kind", "driving")
    time = 0.0 if where.drive is None or (where.drive / "oxts").is_dir() else _OXTS_TIME
    noise = replace(OXTS_NOISE, time=time, wheels=kind == "driving")
    format = "kitti-raw" if where.drive else "kitti"
    return RecordedSequence(where.name, format, kind, rig, pairs.stamps, decode, truth, noise)


def _is_tracking(folder: Path) -> bool:
    """Whether a folder is ``image_02/0000`` with ``image_03/0000`` beside it."""
    return folder.parent.name == "image_02" and (folder.parent.parent / "image_03" / folder.name).is_dir()


def _odometry(folder: Path) -> Layout:
    folders, cameras = _cameras(folder, "image_")
    poses = [folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"]
    return Layout(folder.name, folders, cameras, [folder / "calib.txt"], folder / "times.txt", poses)


def _tracking(folder: Path) -> Layout:
    root, name = folder.parent.parent, folder.name
    # As downloaded: data_tracking_calib/training beside data_tracking_image_2/training
    files = [root / "calib" / f"{name}.txt", *sorted(root.parent.parent.glob(f"*/{root.name}/calib/{name}.txt"))]
    return Layout(name, [folder, root / "image_03" / name], ("2", "3"), files, root / f"times_{name}.txt", [])


def _drive(folder: Path) -> Layout:
    """Of KITTI raw the calibration is in the day's folder, or in the drive's own; of KITTI-360 in ``calibration``."""
    if folder.name.endswith("_extract"):
        raise SequenceError(f"{folder}: an unrectified (extract) drive: take the rectified (sync) one")
    images, cameras = _cameras(folder, "image_0")
    inside = next((name for name in ("data_rect", "data") if (images[0] / name).exists()), "")
    raw = [where / "calib_cam_to_cam.txt" for where in (folder.parent, folder)]
    usual = [where / "calibration" / "perspective.txt" for where in (folder.parent.parent, folder.parent)]
    files = [*usual, *raw] if inside == "data_rect" else [*raw, *usual]
    poses, times = folder / "poses_cam0_oxts.txt", images[0] / "timestamps.txt"
    return Layout(folder.name, [path / inside for path in images], cameras, files, times, [poses], folder)


def _cameras(folder: Path, name: str) -> tuple[list[Path], tuple[str, str]]:
    """The folders and numbers of the first pair of cameras of which both folders are there, grey before colour."""
    for cameras in (("0", "1"), ("2", "3")):
        folders = [folder / f"{name}{camera}" for camera in cameras]
        if all(path.is_dir() for path in folders):
            return folders, cameras
    raise SequenceError(f"{folder}: two cameras are needed, folders {name}0 and {name}1 or {name}2 and {name}3")


def _reference(where: Layout) -> Array:
    """Pose (4, 4) of the reference camera 0 (of a drive before rectification) in the left one."""
    if where.calibration is None:
        return np.eye(4)
    rows, name = read_kitti(where.calibration), f"{'P_rect_0' if where.drive else 'P'}{where.cameras[0]}"
    with naming(where.calibration):
        T = pose(np.eye(3), projection_offset(array(rows.get(name), name, (3, 4))))
        if where.drive is None:
            return T
        return T @ rigid(pose(array(rows.get("R_rect_00"), "R_rect_00", (3, 3)), np.zeros(3)), "R_rect_00")


def _truth(where: Layout, origin: int | None, by_number: dict[int, float], faults: FaultLog) -> Trajectory | None:
    """The left camera's path at the frames' stamps `by_number`; `origin` is stamp zero [ns since 1970], if known."""
    grey = where.cameras[0] == "0"
    if where.drive is not None:
        drive = where.drive
        world = drive.parent.parent / "data_poses" / drive.name / "cam0_to_world.txt"
        if world.is_file() and grey:
            found = read_rows(world, partial(numbers, count=17, what="a frame and its pose"), faults)
            table = np.array(sorted(row for row in found if row and row[0] in by_number)).reshape(-1, 17)
            times = np.array([by_number[int(number)] for number in table[:, 0]])
            return require_truth(Trajectory(times, table[:, 1:].reshape(-1, 4, 4)), world)
        if (drive / "oxts").is_dir():
            day = (where.calibration or where.calibrations[0]).parent
            T_camera0_velo, T_velo_imu = (_extrinsics(day / f"calib_{n}.txt") for n in ("velo_to_cam", "imu_to_velo"))
            body = require_truth(read_oxts(drive / "oxts", origin, by_number, faults), drive / "oxts")
            poses = body.poses @ inverse(_reference(where) @ T_camera0_velo @ T_velo_imu)
            return Trajectory(body.stamps, inverse(poses[0]) @ poses)
    path = next((path for path in where.poses if path.is_file()), None)
    if path is None or (where.drive and not grey):
        return None
    given = Trajectory.read_kitti(path)
    inside = [number for number in by_number if number < len(given)]
    if len(inside) < len(by_number):
        line = f"{path}: {len(given)} poses, {len(by_number) - len(inside)} frames are beyond them"
        faults.report("ground truth", line)
    truth = require_truth(Trajectory(np.array([by_number[number] for number in inside]), given.poses[inside]), path)
    return truth if where.drive else Trajectory(truth.stamps, truth.poses @ inverse(_reference(where)))


def read_oxts(folder: Path, origin: int | None, frame_stamps: dict[int, float], faults: FaultLog) -> Trajectory:
    """Poses ``T_world_imu`` of the records ``data/NUMBER.txt``, timed by ``timestamps.txt`` or the frames."""
    stamps, rows = frame_stamps, []
    if origin is not None and (folder / "timestamps.txt").exists():
        dates = read_rows(folder / "timestamps.txt", date_time, faults)
        stamps = {number: (row - origin) * 1e-9 for number, row in enumerate(dates) if row is not None}
    for file in sorted((folder / "data").glob("*.txt")):
        number = int(stem(file.name)) if _COUNT.fullmatch(stem(file.name)) else -1
        if number not in stamps:
            continue
        try:
            rows += [[stamps[number], *record] for record in read_rows(file, _record, faults)[:1] if record]
        except SequenceError as error:
            faults.report("OXTS records left out", f"{error}; record left out")
    if not rows:
        raise SequenceError(f"{folder}: no OXTS record is readable and has a stamp")
    table = np.array(rows)
    table = table[increasing(table[:, 0])]
    return Trajectory(table[:, 0], imu_poses(table[:, 1:7]))


def imu_poses(records: Array) -> Array:
    """Poses (N, 4, 4) of records (N, 6): latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad].

    World axes are east, north, up, its origin the first position. The Mercator projection is scaled along each axis by
    the ellipsoid's radius at the first latitude, so that lengths near it are metres: KITTI's development kit takes the
    earth for a sphere of the equator's radius, so that in Karlsruhe its ways along a parallel are 0.19 % too short, and
    those along a meridian 0.10 % too long. ``R = Rz(yaw) Ry(pitch) Rx(roll)``.
    """
    latitude, longitude, altitude, roll, pitch, yaw = records.T
    flat = 1 - (_ECCENTRICITY * np.sin(np.radians(latitude[0]))) ** 2
    across = _EARTH_RADIUS / np.sqrt(flat)  # radius of curvature along the parallel
    along = across * (1 - _ECCENTRICITY**2) / flat  # and along the meridian
    shrunk = np.cos(np.radians(latitude[0]))
    east = across * shrunk * np.radians(longitude)
    north = along * shrunk * np.log(np.tan(np.radians(90 + latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    return pose(about(yaw, 2) @ about(pitch, 1) @ about(roll, 0), position - position[0])


def _record(text: str) -> list[float]:
    row = numbers(text, 6, _OXTS)
    if abs(row[0]) >= 90 or max(map(abs, (row[1], *row[3:]))) > 360:
        raise ValueError(f"{text!r:.40} is not {_OXTS}")
    return row


def _extrinsics(path: Path) -> Array:
    """The rigid motion (4, 4) of a file with rows R and T."""
    rows = read_kitti(path)
    with naming(path):
        return rigid(pose(array(rows.get("R"), "R", (3, 3)), array(rows.get("T"), "T", (3,))), "R")
