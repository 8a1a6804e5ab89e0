"""KITTI odometry: ``sequences/06`` with ``image_0``, ``image_1``, ``calib.txt``, ``times.txt``; ``poses/06.txt``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.errors import SequenceError, TrajectoryError
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
from slam.sequences.images import Size
from slam.sequences.source import ImagePairs, Listing, numbered, pair_listings, stamped
from slam.sequences.tables import read_rows, seconds
from slam.sequences.truth import require_truth

#: The data sheet of KITTI's GPS/IMU unit (OXTS RT 3003, with RTK corrections): 2 cm, 0.03° in roll and pitch, and 0.1°
#: in heading, which changes slowly. That, and how the camera stands to the unit, is left to be found.
OXTS_NOISE = TruthNoise(rotation=float(np.radians(0.03)), translation=0.02, mounting=float(np.radians(1.0)))

#: Frames per second where there is no times.txt.
RATE = 10.0

_PAIRS = (("0", "1"), ("2", "3"))  # grey first, colour where there is no grey


def matches(folder: Path) -> bool:
    """Whether a folder looks like a KITTI odometry sequence."""
    return any((folder / f"image_{i}").exists() for i in range(4))


def open_folder(folder: Path, options: dict[str, str]) -> RecordedSequence:
    """Open one KITTI odometry sequence.

    Raises:
        SequenceError: a camera or all its images are missing, or nothing can be paired.
        CalibrationError: ``calib.txt`` is missing, unreadable or impossible.
    """
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        cameras = choose_pair(folder, "image_{}", _PAIRS)
        left_all, right_all = (numbered(folder / f"image_{c}", faults) for c in cameras)
        left, right_names = pair_listings(left_all, right_all, 0, "frames", faults)
        times = _times(folder / "times.txt", faults)
        stamps: Array = left.keys / RATE
        if times is not None:
            keep, stamps = stamped(left.keys, times, folder / "times.txt", faults)
            left, right_names = left.select(keep), [right_names[i] for i in keep]
        source = ImagePairs(stamps, left.folder, left.names, right_all.folder, right_names)
        size = source.first_size()
        rig, T_reference_left = _rig(folder / "calib.txt", cameras, size)
        truth = _ground_truth(folder, left, stamps, T_reference_left, faults)
    source = ImagePairs(stamps, left.folder, left.names, right_all.folder, right_names, size)
    kind = options.get("kind", "driving")
    noise = replace(OXTS_NOISE, wheels=kind == "driving")
    return RecordedSequence(folder.name, "kitti", kind, rig, source, truth, None, warnings, noise)


def choose_pair(folder: Path, pattern: str, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    """The first pair of cameras of which both folders are there.

    Raises:
        SequenceError: no pair is complete.
    """
    for left, right in pairs:
        if all((folder / pattern.format(c)).is_dir() for c in (left, right)):
            return left, right
    names = [pattern.format(c) for p in pairs for c in p]
    there = [n for n in names if (folder / n).is_dir()]
    files = [n for n in names if (folder / n).is_file()]
    if files:
        raise SequenceError(f"{folder / files[0]}: a file where a folder of images should be")
    found = f"only {', '.join(there)} is there" if there else "no folder of images is there"
    wanted = " or ".join(f"{pattern.format(a)} and {pattern.format(c)}" for a, c in pairs)
    raise SequenceError(f"{folder}: two cameras are needed ({wanted}), {found}")


def _times(path: Path, faults: FaultLog) -> Array | None:
    """Times by frame number (T,), NaN for unreadable rows; None for 10 frames per second where there is no file."""
    if not path.exists():
        faults.assume(f"{path} is missing: {RATE:g} frames per second assumed")
        return None
    rows = read_rows(path, seconds, faults)
    return np.array([np.nan if row is None else row for row in rows])


def _rig(path: Path, cameras: tuple[str, str], size: Size) -> tuple[StereoRig, Array]:
    """The rig, and the left camera's pose (4, 4) in the frame of reference (camera 0), which the poses are of."""
    rows = read_kitti(path)
    with naming(path):
        P_left, P_right = (kitti_matrix(rows, f"P{c}", (3, 4)) for c in cameras)
        return rig_from_projections(P_left, P_right, size), pose(np.eye(3), -projection_offset(P_left))


def _ground_truth(
    folder: Path, left: Listing, stamps: Array, T_reference_left: Array, faults: FaultLog
) -> Trajectory | None:
    """Poses by frame number, from ``poses.txt`` inside or ``poses/NAME.txt`` beside ``sequences``."""
    candidates = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    path = next((p for p in candidates if p.is_file()), None)
    return None if path is None else read_poses(path, left, stamps, T_reference_left, faults)


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
