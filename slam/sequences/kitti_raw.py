"""KITTI raw: a ``…_sync`` drive with ``image_00/data``, its calibration in the day's folder above."""

from __future__ import annotations

from dataclasses import replace
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
from slam.sequences.images import Size
from slam.sequences.kitti import OXTS_NOISE, RATE, choose_pair, read_poses
from slam.sequences.oxts import read_oxts
from slam.sequences.source import MOST_FRAMES, ImagePairs, Listing, numbered, pair_listings, stamped
from slam.sequences.tables import date_time, read_rows, shorten
from slam.sequences.truth import require_truth

#: Synchronised drives have one of a hundred OXTS records a second for each frame, the nearest one [s].
_OXTS_TIME = 0.01 / np.sqrt(12)

_PAIRS = (("00", "01"), ("02", "03"))  # grey first, colour where there is no grey


def matches(folder: Path) -> bool:
    """Whether a folder looks like a drive of KITTI raw."""
    return any((folder / f"image_{i:02d}").exists() for i in range(4))


def open_folder(folder: Path, options: dict[str, str]) -> RecordedSequence:
    """Open one drive; stamps count from its first row of times.

    Raises:
        SequenceError: a camera or all its images are missing, or nothing can be paired.
        CalibrationError: ``calib_cam_to_cam.txt`` is missing, unreadable or impossible.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        cameras = choose_pair(folder, "image_{}", _PAIRS)
        left_all, right_all = (numbered(folder / f"image_{c}" / "data", faults) for c in cameras)
        left, right_names = pair_listings(left_all, right_all, 0, "frames", faults)
        path = left.folder.parent / "timestamps.txt"
        origin, times = _times(path, faults)
        stamps: Array = left.keys / RATE
        if times is not None:
            keep, stamps = stamped(left.keys, times, path, faults)
            left, right_names = left.select(keep), [right_names[i] for i in keep]
        source = ImagePairs(stamps, left.folder, left.names, right_all.folder, right_names)
        size = source.first_size()
        day = _day(folder)
        rig, T_left_reference = _rig(day / "calib_cam_to_cam.txt", cameras, size)
        gps = _gps(folder / "ego_gps_m.txt", times, faults)
        truth = _ground_truth(folder, day, origin, T_left_reference, left, stamps, faults)
    source = ImagePairs(stamps, left.folder, left.names, right_all.folder, right_names, size)
    kind = options.get("kind", "driving")
    time = 0.0 if (folder / "oxts").is_dir() else _OXTS_TIME
    noise = replace(OXTS_NOISE, time=time, wheels=kind == "driving")
    return RecordedSequence(folder.name, "kitti-raw", kind, rig, source, truth, gps, warnings, noise)


def _day(folder: Path) -> Path:
    """Where the calibration is: in the drive's own folder, or in the day's above it."""
    return folder if (folder / "calib_cam_to_cam.txt").exists() else folder.parent


def _times(path: Path, faults: FaultLog) -> tuple[int | None, Array | None]:
    """The first row's time [ns since 1970] and the times by frame number (T,) [s] from there on; None without file."""
    if not path.exists():
        faults.assume(f"{path} is missing: {RATE:g} frames per second assumed")
        return None, None
    rows = read_rows(path, date_time, faults)
    origin = next(row for row in rows if row is not None)
    return origin, np.array([np.nan if row is None else (row - origin) * 1e-9 for row in rows])


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
    try:
        row = [float(word) for word in text.split()]
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a row of numbers") from None
    if len(row) != 4 or not np.isfinite(row).all() or not 0 <= row[0] <= MOST_FRAMES or row[0] != int(row[0]):
        raise ValueError(f"{shorten(text)} is not frame, forward, right, third")
    if max(map(abs, row)) > MOST_FRAMES:
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
