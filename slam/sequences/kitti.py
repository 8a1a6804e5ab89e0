"""KITTI odometry: ``sequences/06`` with ``image_0``, ``image_1``, ``calib.txt``, ``times.txt``; ``poses/06.txt``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose
from slam.geometry.trajectory import Trajectory, TruthNoise
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
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.source import Listing, numbered, pair_up, read_times, times_file
from slam.sequences.truth import require_truth

#: The data sheet of KITTI's GPS/IMU unit (OXTS RT 3003, with RTK corrections): 2 cm, 0.03° in roll and pitch, and 0.1°
#: in heading, which changes slowly. That, and how the camera stands to the unit, is left to be found.
OXTS_NOISE = TruthNoise(rotation=float(np.radians(0.03)), translation=0.02, mounting=float(np.radians(1.0)))

_PAIRS = (("0", "1"), ("2", "3"))  # grey first, colour where there is no grey


class _Layout(NamedTuple):
    """Where the files of a sequence are: of the images, the calibration and the times; the first that is there of
    `poses` has the truth. The cameras are numbers.
    """

    name: str
    left: Path
    right: Path
    cameras: tuple[str, str]
    calibration: Path
    times: Path
    poses: tuple[Path, ...]


def matches(folder: Path) -> bool:
    """Whether a folder looks like a KITTI odometry sequence, or like the left images of one of KITTI tracking."""
    return any((folder / f"image_{i}").exists() for i in range(4)) or _is_tracking(folder)


def _is_tracking(folder: Path) -> bool:
    """Whether a folder is ``image_02/0000`` with ``image_03/0000`` beside it."""
    return folder.parent.name == "image_02" and (folder.parent.parent / "image_03" / folder.name).is_dir()


def _layout(folder: Path) -> _Layout:
    """Where the files are, of KITTI odometry or of KITTI tracking."""
    if not _is_tracking(folder):
        a, b = choose_pair(folder, _PAIRS)
        poses = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
        left, right = (folder / f"image_{camera}" for camera in (a, b))
        return _Layout(folder.name, left, right, (a, b), folder / "calib.txt", folder / "times.txt", poses)
    root, name = folder.parent.parent, folder.name
    calibration = root / "calib" / f"{name}.txt"
    if not calibration.exists():  # as downloaded: data_tracking_calib/training beside data_tracking_image_2/training
        others = sorted(root.parent.parent.glob(f"*/{root.name}/calib/{name}.txt"))
        calibration = others[0] if others else calibration
    right = root / "image_03" / name
    return _Layout(name, folder, right, ("2", "3"), calibration, root / f"times_{name}.txt", ())


def open_folder(folder: Path, options: Given) -> RecordedSequence:
    """Open one sequence of KITTI odometry, or of KITTI tracking.

    Raises:
        SequenceError: a camera or all its images are missing, or nothing can be paired.
        CalibrationError: ``calib.txt`` is missing, unreadable or impossible.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        where = _layout(folder)
        left_all, right_all = (numbered(side, faults) for side in (where.left, where.right))
        path = times_file(folder, options, where.times)
        left, source = pair_up(left_all, right_all, options, faults, read_times(path, faults), by_number=True)
        size = source.first_size()
        rig, T_reference_left = _rig(folder, where, size, options)
        poses = next((path for path in where.poses if path.is_file()), None)
        truth = None if poses is None else read_poses(poses, left, source.stamps, T_reference_left, faults)
    kind = options.get("kind", "driving")
    noise = replace(OXTS_NOISE, wheels=kind == "driving")
    return RecordedSequence(where.name, "kitti", kind, rig, replace(source, size=size), truth, None, warnings, noise)


def choose_pair(folder: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str]:
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


def _rig(folder: Path, where: _Layout, size: Size, options: Given) -> tuple[StereoRig, Array]:
    """The rig, and the left camera's pose (4, 4) in the frame of reference (camera 0), which the poses are of."""
    named = calibration_files(folder, options) if "calibration" in options else None
    if named and not where.calibration.exists():
        return read_rig(named, size, options), np.eye(4)
    if not where.calibration.exists():
        raise CalibrationError(f"{where.calibration}: the calibration is missing: add calibration=FILE")
    rows = read_kitti(where.calibration)
    with naming(where.calibration):
        P_left, P_right = (kitti_matrix(rows, f"P{c}", (3, 4)) for c in where.cameras)
        T_reference_left = pose(np.eye(3), -projection_offset(P_left))
        rig = read_rig(named, size, options) if named else rig_from_projections(P_left, P_right, size)
        return rig, T_reference_left


def read_poses(
    path: Path, left: Listing, stamps: Array, T_reference_left: Array, faults: FaultLog
) -> Trajectory | None:
    """Poses of the left camera from rows of 12, one for each frame number; a fault of the file is reported."""
    try:
        table = Trajectory.read_kitti(path)
        inside = left.keys < len(table)
        if not inside.all():
            line = f"{path}: {len(table)} poses, {int((~inside).sum())} frames are beyond them"
            faults.report("ground truth", line)
        truth = Trajectory(stamps[inside], table.poses[left.keys[inside]])
        require_truth(truth, path)
        return Trajectory(truth.stamps, truth.poses @ T_reference_left)
    except TrajectoryError as error:
        faults.report("ground truth", f"{error}; there is no ground truth")
        return None
