"""OXTS records of KITTI raw: latitude, longitude, altitude and angles to poses, by the Mercator projection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.geometry.euler import about
from slam.geometry.se3 import Array, pose
from slam.geometry.stamps import increasing
from slam.geometry.trajectory import Trajectory
from slam.sequences.faults import FaultLog
from slam.sequences.source import number_of
from slam.sequences.tables import date_time, numbers, read_rows, shorten

_EARTH_RADIUS = 6378137.0  # [m], equatorial, as the data set's development kit has it


def read_oxts(folder: Path, origin: int | None, frame_stamps: dict[int, float], faults: FaultLog) -> Trajectory:
    """Poses ``T_world_imu`` of the records ``data/NUMBER.txt``; the world's origin is the first record's position.

    Stamps come from ``timestamps.txt`` [s since `origin`, ns since 1970]; where it or `origin` is missing, a record
    has the stamp of the frame of its number.

    Raises:
        SequenceError: there are no records, or none is readable and has a stamp.
    """
    files = sorted((folder / "data").glob("*.txt")) if (folder / "data").is_dir() else []
    numbered = [(number, f) for f in files if (number := number_of(f.name)) is not None]
    if not numbered:
        raise SequenceError(f"{folder / 'data'}: no OXTS records")
    stamps = _stamps(folder / "timestamps.txt", origin, frame_stamps, faults)
    rows = []
    for number, file in numbered:
        record = _record(file, faults)
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
    R = about(yaw, 2) @ about(pitch, 1) @ about(roll, 0)
    return pose(R, position - position[0])


def _record(file: Path, faults: FaultLog) -> list[float] | None:
    """The first six numbers of one record; None and a line where it is unreadable."""
    try:
        return read_rows(file, _six_numbers, faults)[0]
    except SequenceError as error:
        faults.report("OXTS records left out", f"{error}; record left out")
        return None


def _six_numbers(text: str) -> list[float]:
    """The first six numbers of a row."""
    what = "latitude, longitude, altitude, roll, pitch, yaw"
    row = numbers(text, 6, what)
    if abs(row[0]) >= 90 or max(map(abs, (row[1], *row[3:]))) > 360:
        raise ValueError(f"{shorten(text)} is not {what}")
    return row


def _stamps(path: Path, origin: int | None, frame_stamps: dict[int, float], faults: FaultLog) -> dict[int, float]:
    """Stamps [s] by record number."""
    if origin is None or not path.exists():
        return frame_stamps
    rows = read_rows(path, date_time, faults)
    return {number: (row - origin) * 1e-9 for number, row in enumerate(rows) if row is not None}
