"""KITTI raw: a ``…_sync`` drive with ``image_00/data``, its calibration in the day's folder above."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, pose
from slam.geometry.trajectory import Trajectory
from slam.sequences.base import RecordedSequence
from slam.sequences.calibration import (
    kitti_matrix,
    naming,
    projection_offset,
    read_kitti,
    rig_from_projections,
)
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given
from slam.sequences.images import Size
from slam.sequences.kitti import OXTS_NOISE, choose_pair, read_poses
from slam.sequences.names import MOST_FRAMES
from slam.sequences.oxts import read_oxts
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.source import RATE, Listing, numbered, pair_up, read_times, times_file
from slam.sequences.tables import date_time, numbers, read_rows, shorten
from slam.sequences.truth import require_truth

#: Synchronised drives have one of a hundred OXTS records a second for each frame, the nearest one [s].
_OXTS_TIME = 0.01 / np.sqrt(12)

_DATA = ("data", "data_rect")  # KITTI raw, KITTI-360

_PAIRS = (("00", "01"), ("02", "03"))  # grey first, colour where there is no grey


def matches(folder: Path) -> bool:
    """Whether a folder looks like a drive of KITTI raw or KITTI-360; KITTI tracking has folders of sequences there."""
    cameras = [path for i in range(4) if (path := folder / f"image_{i:02d}").exists()]
    return bool(cameras) and not any(path.name.isdecimal() and path.is_dir() for path in _inside(cameras[0]))


def _inside(folder: Path) -> list[Path]:
    return list(islice(folder.iterdir(), 10)) if folder.is_dir() else []


def open_folder(folder: Path, options: Given) -> RecordedSequence:
    """Open one drive; stamps count from its first row of times.

    Raises:
        SequenceError: a camera or all its images are missing, or nothing can be paired.
        CalibrationError: the calibration is missing, unreadable or impossible.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        cameras = choose_pair(folder, _PAIRS)
        data = next((name for name in _DATA if (folder / f"image_{cameras[0]}" / name).exists()), _DATA[0])
        left_all, right_all = (numbered(folder / f"image_{c}" / data, faults) for c in cameras)
        path = times_file(folder, options, left_all.folder.parent / "timestamps.txt")
        origin, known = (None, read_times(path, faults)) if "times" in options else _times(path, faults)
        left, source = pair_up(left_all, right_all, options, faults, known, by_number=True)
        stamps, size = source.stamps, source.first_size()
        calibration = _calibration(folder)
        named = calibration_files(folder, options) if "calibration" in options else None
        if named is None and not calibration.exists():
            raise CalibrationError(f"{calibration}: the calibration is missing: add calibration=FILE")
        rig: StereoRig | None = None
        T_left_reference: Array = np.eye(4)
        if calibration.exists():
            rig, T_left_reference = _rig(calibration, cameras, size)
        if named is not None:
            rig = read_rig(named, size, options)
        assert rig is not None  # one of the two is there
        gps = _gps(folder / "ego_gps_m.txt", None if known is None else known[1], faults)
        truth = _ground_truth(folder, calibration.parent, origin, T_left_reference, left, stamps, faults)
    kind = options.get("kind", "driving")
    time = 0.0 if (folder / "oxts").is_dir() else _OXTS_TIME
    noise = replace(OXTS_NOISE, time=time, wheels=kind == "driving")
    return RecordedSequence(
        folder.name, "kitti-raw", kind, rig, replace(source, size=size), truth, gps, warnings, noise
    )


def _calibration(folder: Path) -> Path:
    """In the drive's own folder, or in the day's above it; of KITTI-360 in ``calibration`` beside ``data_2d_raw``."""
    perspective = folder.parent.parent / "calibration" / "perspective.txt"
    usual = folder / "calib_cam_to_cam.txt"
    places = (usual, folder.parent / usual.name, perspective, folder.parent / "calibration" / perspective.name)
    return next((path for path in places if path.exists()), folder.parent / usual.name)


def _times(path: Path | None, faults: FaultLog) -> tuple[int | None, tuple[Path, Array] | None]:
    """The first row's time [ns since 1970] and the times by frame number (T,) [s] from there on; None without file."""
    if path is None:
        return None, None
    rows = read_rows(path, date_time, faults)
    origin = next(row for row in rows if row is not None)
    return origin, (path, np.array([np.nan if row is None else (row - origin) * 1e-9 for row in rows]))


def _rig(path: Path, cameras: tuple[str, str], size: Size) -> tuple[StereoRig, Array]:
    """The rig of the rectified cameras, and ``T_left_camera0`` (4, 4) from unrectified camera 0 to the left one."""
    rows = read_kitti(path)
    with naming(path):
        P_left, P_right = (kitti_matrix(rows, f"P_rect_{c}", (3, 4)) for c in cameras)
        expected = kitti_matrix(rows, f"S_rect_{cameras[0]}", (2,))
        if tuple(expected) != size:
            raise CalibrationError(_wrong_size(rows, expected, size, cameras[0]))
        R_rect = kitti_matrix(rows, "R_rect_00", (3, 3))
        T = pose(np.eye(3), projection_offset(P_left)) @ pose(_rotation(R_rect, "R_rect_00"), np.zeros(3))
        return rig_from_projections(P_left, P_right, size), T


def _wrong_size(rows: dict[str, Array], expected: Array, size: Size, camera: str) -> str:
    """Images of another size: perhaps those of an unrectified drive."""
    text = f"images are {size[0]}x{size[1]}, S_rect_{camera} says {expected[0]:.0f}x{expected[1]:.0f}"
    if tuple(rows.get(f"S_{camera}", ())) == size:
        text += ": this is an unrectified (extract) drive, take the rectified (sync) one"
    return text


def _gps(path: Path, times: Array | None, faults: FaultLog) -> Array | None:
    """The positions-only track (N, 4): stamp [s], forward, right, third [m]; rows are ``frame forward right third``."""
    if not path.exists():
        return None
    try:
        rows = [row for row in read_rows(path, _gps_row, faults) if row is not None]
    except SequenceError as error:
        faults.report("GPS", f"{error}; there is no GPS track")
        return None
    table = np.array(rows).reshape(-1, 4)
    if times is None:
        table[:, 0] /= RATE
        return table
    table = table[table[:, 0] < len(times)]
    table[:, 0] = times[table[:, 0].astype(int)]
    return table[np.isfinite(table[:, 0])]


def _gps_row(text: str) -> list[float]:
    """Frame number and three coordinates [m]."""
    row = numbers(text, 4, "frame, forward, right, third", exactly=True)
    if row[0] < 0 or row[0] != int(row[0]) or max(map(abs, row)) > MOST_FRAMES:
        raise ValueError(f"{shorten(text)} is not frame, forward, right, third")
    return row


def _ground_truth(
    folder: Path,
    day: Path,
    origin: int | None,
    T_left_camera0: Array,
    left: Listing,
    stamps: Array,
    faults: FaultLog,
) -> Trajectory | None:
    """The left camera's path by the drive's OXTS records; the world is the left camera's first frame there.

    Without them ``poses_cam0_oxts.txt`` serves: poses of camera 0, rows of 12 as in KITTI odometry, one a frame.
    """
    world = folder.parent.parent / "data_poses" / folder.name / "cam0_to_world.txt"
    if world.is_file() and left.folder.parent.name == "image_00":  # KITTI-360
        return _poses_360(world, dict(zip(left.keys.tolist(), stamps.tolist())), faults)
    if not (folder / "oxts").is_dir():
        path = folder / "poses_cam0_oxts.txt"
        known = path.is_file() and left.folder.parent.name == "image_00"
        return read_poses(path, left, stamps, np.eye(4), faults) if known else None
    try:
        T_left_imu = T_left_camera0 @ _extrinsics(day / "calib_velo_to_cam.txt")
        T_left_imu = T_left_imu @ _extrinsics(day / "calib_imu_to_velo.txt")
        body = read_oxts(folder / "oxts", origin, dict(zip(left.keys.tolist(), stamps.tolist())), faults)
        require_truth(body, folder / "oxts")
    except (SequenceError, CalibrationError, TrajectoryError) as error:
        faults.report("ground truth", f"{error}; there is no ground truth")
        return None
    poses = body.poses @ inverse(T_left_imu)
    return Trajectory(body.stamps, inverse(poses[0]) @ poses)


def _poses_360(path: Path, stamps: dict[int, float], faults: FaultLog) -> Trajectory | None:
    """KITTI-360's path of the rectified left camera: rows of a frame's number and 16 numbers of its pose."""
    try:
        rows = [row for row in read_rows(path, _row_of_360, faults) if row is not None and row[0] in stamps]
        table = np.array(sorted(rows)).reshape(-1, 17)
        times = np.array([stamps[int(number)] for number in table[:, 0]])
        return require_truth(Trajectory(times, table[:, 1:].reshape(-1, 4, 4)), path)
    except (SequenceError, TrajectoryError) as error:
        faults.report("ground truth", f"{error}; there is no ground truth")
        return None


def _row_of_360(text: str) -> list[float]:
    return numbers(text, 17, "a frame and its pose", exactly=True)


def _extrinsics(path: Path) -> Array:
    """The rigid motion (4, 4) of a file with rows R and T."""
    rows = read_kitti(path)
    with naming(path):
        return pose(_rotation(kitti_matrix(rows, "R", (3, 3)), "R"), kitti_matrix(rows, "T", (3,)))


def _rotation(R: Array, name: str) -> Array:
    """The matrix (3, 3), where it is a rotation.

    Raises:
        CalibrationError: it is none.
    """
    if np.abs(R).max() > 1.01 or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CalibrationError(f"{name} is not a rotation: {R.tolist()}")
    return R
