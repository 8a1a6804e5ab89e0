"""True paths of KITTI's recordings: files of poses, OXTS records (latitude, longitude, angles), and GPS positions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.euler import about
from slam.geometry.se3 import Array, inverse, pose
from slam.geometry.stamps import IntArray, increasing
from slam.geometry.trajectory import Trajectory
from slam.sequences.calibration import kitti_matrix, naming, read_kitti, rigid
from slam.sequences.faults import FaultLog
from slam.sequences.names import MOST_FRAMES
from slam.sequences.source import RATE, number_of
from slam.sequences.tables import date_time, numbers, read_rows, require_truth, shorten

_EARTH_RADIUS = 6378137.0  # [m], equatorial, as the data set's development kit has it
_OXTS, _GPS = "latitude, longitude, altitude, roll, pitch, yaw", "frame, forward, right, third"


class Frames(NamedTuple):
    """The frames of a sequence: their numbers and stamps [s] (N,), and whether the left camera is the reference."""

    numbers: IntArray
    stamps: Array
    of_reference: bool


@contextmanager
def _optional(what: str, faults: FaultLog) -> Iterator[None]:
    """Report a fault of a file that a sequence can do without."""
    try:
        yield
    except (SequenceError, CalibrationError, TrajectoryError) as error:
        faults.report(what, f"{error}; there is no {what}")


def read_poses(path: Path, frames: Frames, T_left_reference: Array, faults: FaultLog) -> Trajectory | None:
    """Poses of the left camera from rows of 12, one for each frame number; a fault of the file is reported."""
    with _optional("ground truth", faults):
        table = Trajectory.read_kitti(path)
        inside = frames.numbers < len(table)
        if not inside.all():
            line = f"{path}: {len(table)} poses, {int((~inside).sum())} frames are beyond them"
            faults.report("ground truth", line)
        truth = require_truth(Trajectory(frames.stamps[inside], table.poses[frames.numbers[inside]]), path)
        return Trajectory(truth.stamps, truth.poses @ inverse(T_left_reference))
    return None


def drive_truth(
    drive: Path, day: Path, origin: int | None, T_left_camera0: Array, frames: Frames, faults: FaultLog
) -> Trajectory | None:
    """The left camera's path by the drive's OXTS records; the world is the left camera's first frame there.

    KITTI-360 has poses of the rectified left camera. Without either ``poses_cam0_oxts.txt`` serves: poses of camera 0,
    rows of 12 as in KITTI odometry, one a frame. `day` is the folder of the calibrations, `origin` the time of stamp
    zero [ns since 1970], None where it is not known, `T_left_camera0` of the camera 0 before rectification.
    """
    stamps = dict(zip(frames.numbers.tolist(), frames.stamps.tolist()))
    world = drive.parent.parent / "data_poses" / drive.name / "cam0_to_world.txt"
    with _optional("ground truth", faults):
        if world.is_file() and frames.of_reference:
            rows = [row for row in read_rows(world, _pose_row, faults) if row and row[0] in stamps]
            table = np.array(sorted(rows)).reshape(-1, 17)
            times = np.array([stamps[int(number)] for number in table[:, 0]])
            return require_truth(Trajectory(times, table[:, 1:].reshape(-1, 4, 4)), world)
        if (drive / "oxts").is_dir():
            T_camera0_velo, T_velo_imu = (_extrinsics(day / f"calib_{n}.txt") for n in ("velo_to_cam", "imu_to_velo"))
            body = require_truth(read_oxts(drive / "oxts", origin, stamps, faults), drive / "oxts")
            poses = body.poses @ inverse(T_left_camera0 @ T_camera0_velo @ T_velo_imu)
            return Trajectory(body.stamps, inverse(poses[0]) @ poses)
    path = drive / "poses_cam0_oxts.txt"
    known = path.is_file() and frames.of_reference and not (drive / "oxts").is_dir()
    return read_poses(path, frames, np.eye(4), faults) if known else None


def read_gps(path: Path, times: Array | None, faults: FaultLog) -> Array | None:
    """The positions-only track (N, 4): stamp [s], forward, right, third [m]; rows are ``frame forward right third``."""
    if not path.exists():
        return None
    with _optional("GPS track", faults):
        table = np.array([row for row in read_rows(path, _gps_row, faults) if row is not None]).reshape(-1, 4)
        if times is None:
            table[:, 0] /= RATE
            return table
        table = table[table[:, 0] < len(times)]
        table[:, 0] = times[table[:, 0].astype(int)]
        return table[np.isfinite(table[:, 0])]
    return None


def read_oxts(folder: Path, origin: int | None, frame_stamps: dict[int, float], faults: FaultLog) -> Trajectory:
    """Poses ``T_world_imu`` of the records ``data/NUMBER.txt``; the world's origin is the first record's position.

    Stamps come from ``timestamps.txt`` [s since `origin`, ns since 1970]; where it or `origin` is missing, a record
    has the stamp of the frame of its number. SequenceError where no record is readable and has a stamp.
    """
    numbered = [(number_of(file.name), file) for file in sorted((folder / "data").glob("*.txt"))]
    if all(number is None for number, _ in numbered):
        raise SequenceError(f"{folder / 'data'}: no OXTS records")
    stamps, rows = frame_stamps, []
    if origin is not None and (folder / "timestamps.txt").exists():
        dates = read_rows(folder / "timestamps.txt", date_time, faults)
        stamps = {number: (row - origin) * 1e-9 for number, row in enumerate(dates) if row is not None}
    for number, file in numbered:
        if number is not None:
            try:
                record = read_rows(file, _record, faults)[0]
            except SequenceError as error:
                faults.report("OXTS records left out", f"{error}; record left out")
                continue
            if record is not None and number in stamps:
                rows.append([stamps[number], *record])
    if not rows:
        raise SequenceError(f"{folder}: no OXTS record is readable and has a stamp")
    table = np.array(rows)
    table = table[increasing(table[:, 0])]
    return Trajectory(table[:, 0], imu_poses(table[:, 1:7]))


def imu_poses(records: Array) -> Array:
    """Poses (N, 4, 4) of records (N, 6): latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad].

    World axes are east, north, up, its origin the first position. The Mercator projection is scaled by the cosine of
    the first latitude, so that lengths near it are metres; ``R = Rz(yaw) Ry(pitch) Rx(roll)``.
    """
    latitude, longitude, altitude, roll, pitch, yaw = records.T
    scale = _EARTH_RADIUS * np.cos(np.radians(latitude[0]))
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.radians(90 + latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    return pose(about(yaw, 2) @ about(pitch, 1) @ about(roll, 0), position - position[0])


def _pose_row(text: str) -> list[float]:
    """Frame number, and the 16 numbers of a pose."""
    return numbers(text, 17, "a frame and its pose", exactly=True)


def _record(text: str) -> list[float]:
    """The first six numbers of an OXTS record."""
    row = numbers(text, 6, _OXTS)
    if abs(row[0]) >= 90 or max(map(abs, (row[1], *row[3:]))) > 360:
        raise ValueError(f"{shorten(text)} is not {_OXTS}")
    return row


def _gps_row(text: str) -> list[float]:
    """Frame number and three coordinates [m]."""
    row = numbers(text, 4, _GPS, exactly=True)
    if row[0] < 0 or row[0] != int(row[0]) or max(map(abs, row)) > MOST_FRAMES:
        raise ValueError(f"{shorten(text)} is not {_GPS}")
    return row


def _extrinsics(path: Path) -> Array:
    """The rigid motion (4, 4) of a file with rows R and T."""
    rows = read_kitti(path)
    with naming(path):
        return rigid(pose(kitti_matrix(rows, "R", (3, 3)), kitti_matrix(rows, "T", (3,))), "R")
