"""EuRoC's format (ASL folders): ``mav0/cam0``, ``mav0/cam1``, and what follows it, such as TUM-VI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.se3 import Array, pose, rotation_from_quaternion
from slam.geometry.stamps import increasing
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.sequences.base import RecordedSequence
from slam.sequences.calibration import naming
from slam.sequences.calibration_keys import body_pose, read_entries
from slam.sequences.faults import FaultLog
from slam.sequences.given import Given
from slam.sequences.rigs import calibration_files, read_rig
from slam.sequences.source import Listing, by_names, image_names, in_order, number_of, pair_up, present, read_times
from slam.sequences.tables import LARGEST, numbers, read_rows, require_truth, shorten, stamp_and_name

#: The motion capture of EuRoC's rooms is good to a millimetre (Burri et al., 2016). Its markers on the vehicle are some
#: half a metre apart, which makes 2 mrad. The camera's orientation in the vehicle is calibrated to half a degree or so,
#: its place to a centimetre, and its clock against the camera's to half an exposure.
MOCAP_NOISE = TruthNoise(rotation=0.002, translation=0.001, mounting=0.01, lever=0.01, clock=0.01)

_CAMERAS = ("cam0", "cam1")
_TRUTH = ("state_groundtruth_estimate0", "mocap0")  # both give the body's (IMU's) pose
_CAMCHAINS = ("camchain.yaml", "dso/camchain.yaml", "../camchain.yaml", "../dso/camchain.yaml")


def matches_folder(folder: Path) -> bool:
    """Whether a folder looks like EuRoC's: it, or its ``mav0``, holds ``cam0`` or ``cam1`` with data in it."""
    return any((_root(folder) / cam / part).exists() for cam in _CAMERAS for part in ("data", "data.csv"))


def open_folder(folder: Path, options: Given) -> RecordedSequence:
    """Open a sequence in EuRoC's format; `folder` holds ``mav0`` or is it.

    Raises:
        SequenceError: a camera, its list or all its images are missing, or nothing can be paired.
        CalibrationError: a calibration is missing, unreadable or impossible.
    """
    root = _root(folder)
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        left, right = _listings(root, faults)
        _, source = pair_up(left, right, options, faults, read_times(folder, options, faults))
        own, missing = _calibration(root), f"{root / 'cam0' / 'sensor.yaml'}: the calibration is missing"
        missing += " (nor is there a Kalibr camchain.yaml): add calibration=FILE"
        named = "calibration" in options or not own
        rig = read_rig(calibration_files(folder, options, missing) if named else own, source.size, options)
        truth = _ground_truth(root, own, faults)
    name = folder.parent.name if folder.name == "mav0" else folder.name
    kind = options.get("kind", "handheld")
    return RecordedSequence(name, "euroc", kind, rig, source, truth, None, warnings, MOCAP_NOISE)


def _root(folder: Path) -> Path:
    """The folder that holds the cameras."""
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _listings(root: Path, faults: FaultLog) -> list[Listing]:
    """The images of both cameras that exist, by ``data.csv`` or, where there is none, by their names."""
    cameras = [root / cam for cam in _CAMERAS]
    for camera in cameras:
        if not camera.is_dir():
            reason = "a file where a folder should be" if camera.exists() else "missing, two cameras are needed"
            raise SequenceError(f"{camera}: {reason}")
    tables = [camera / "data.csv" for camera in cameras]
    if all(table.exists() for table in tables):
        return [_listed(table, faults) for table in tables]
    folders = [camera / "data" for camera in cameras]
    names = [[name for name in image_names(folder) if number_of(name) is not None] for folder in folders]
    for camera, own in zip(cameras, names):
        if not own:
            raise SequenceError(f"{camera}: no data.csv, and no images named by their stamps in data")
    return by_names(folders, names, faults)


def _listed(table: Path, faults: FaultLog) -> Listing:
    """The images that a ``data.csv`` lists."""
    rows = [row for row in read_rows(table, stamp_and_name, faults) if row is not None]
    listing = Listing(table.parent / "data", np.array([s for s, _ in rows], np.int64), [n for _, n in rows], True)
    return present(in_order(listing, str(table), faults), str(table), faults)


def _calibration(root: Path) -> list[Path]:
    """Both ``sensor.yaml`` or, where those are missing, a Kalibr ``camchain.yaml``; empty for neither."""
    files = [root / cam / "sensor.yaml" for cam in _CAMERAS]
    if any(file.exists() for file in files):
        return files
    return next(([root / name] for name in _CAMCHAINS if (root / name).is_file()), [])


def _ground_truth(root: Path, calibration: list[Path], faults: FaultLog) -> Trajectory | None:
    """The left camera's path: body poses times the camera's pose in the body."""
    for path in (root / folder / "data.csv" for folder in _TRUTH):
        if path.is_file():
            try:
                if not calibration:
                    raise SequenceError(f"{path}: no sensor.yaml says where the camera is on the body")
                with naming(calibration[0]):
                    T_body_camera = body_pose(read_entries(calibration, None), 0)
                return _camera_path(path, T_body_camera, faults)
            except (TrajectoryError, SequenceError, CalibrationError) as error:
                faults.report("ground truth", f"{error}; there is no ground truth")
    return None


def _camera_path(path: Path, T_body_camera: Array, faults: FaultLog) -> Trajectory:
    """Read body poses, leave out rows that run backwards in time, and take them to the camera."""
    rows = np.array([row for row in read_rows(path, _pose_row, faults) if row is not None])
    rows = rows[increasing(rows[:, 0])]
    bodies = pose(rotation_from_quaternion(rows[:, [5, 6, 7, 4]]), rows[:, 1:4])
    return require_truth(Trajectory(rows[:, 0] * 1e-9, bodies @ T_body_camera), path)


def _pose_row(text: str) -> list[float]:
    """Stamp [ns], position [m] and quaternion (w, x, y, z) of a row; further columns do not count."""
    what = "stamp, position and unit quaternion"
    row = numbers(text, 8, what, ",")
    far = max(map(abs, row[1:4])) > LARGEST or max(map(abs, row[4:])) > 2
    if far or abs(np.linalg.norm(row[4:]) - 1) > 0.1 or not 0 <= row[0] < 2**63:
        raise ValueError(f"{shorten(text)} is not {what}")
    return row
