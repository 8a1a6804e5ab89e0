"""EuRoC's format (ASL folders): ``mav0/cam0``, ``mav0/cam1``, and what follows it, such as TUM-VI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.se3 import Array, pose, rotation_from_quaternion
from slam.geometry.stamps import increasing
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.sequences.base import RecordedSequence
from slam.sequences.calibration import ImuCamera, euroc_camera, kalibr_cameras, rig_from_cameras
from slam.sequences.faults import FaultLog
from slam.sequences.source import (
    ImagePairs,
    Listing,
    hardware_tolerance,
    image_names,
    in_order,
    in_seconds,
    number_of,
    pair_listings,
    present,
    require_size,
)
from slam.sequences.tables import read_rows, shorten, stamp_and_name
from slam.sequences.truth import LARGEST, require_truth

#: The motion capture of EuRoC's rooms is good to a millimetre (Burri et al., 2016). Its markers on the vehicle are some
#: half a metre apart, which makes 2 mrad. The camera's orientation in the vehicle is calibrated to half a degree or so.
MOCAP_NOISE = TruthNoise(rotation=0.002, translation=0.001, mounting=0.01)

_TRUTH = ("state_groundtruth_estimate0", "mocap0")  # both give the body's (IMU's) pose
_CAMCHAINS = ("camchain.yaml", "dso/camchain.yaml", "../camchain.yaml", "../dso/camchain.yaml")


def matches(folder: Path) -> bool:
    """Whether a folder looks like EuRoC's: it, or its ``mav0``, holds ``cam0`` or ``cam1`` with data in it."""
    return any((_root(folder) / cam / part).exists() for cam in ("cam0", "cam1") for part in ("data", "data.csv"))


def open_folder(folder: Path, options: dict[str, str]) -> RecordedSequence:
    """Open a sequence in EuRoC's format; `folder` holds ``mav0`` or is it.

    Raises:
        SequenceError: a camera, its list or all its images are missing, or nothing can be paired.
        CalibrationError: a calibration is missing, unreadable or impossible.
    """
    root = _root(folder)
    warnings: list[str] = []
    with FaultLog(warnings) as faults:
        left_all, right_all = (_listing(root / cam, faults) for cam in ("cam0", "cam1"))
        left, right_names = pair_listings(left_all, right_all, hardware_tolerance(left_all), "ns", faults)
        cameras, calibration = _cameras(root)
        rig = rig_from_cameras(cameras[0], cameras[1], calibration)
        left, right_names, stamps = in_seconds(left, right_names, faults)
        size = (rig.width, rig.height)
        source = ImagePairs(stamps, left.folder, left.names, right_all.folder, right_names, size)
        require_size(source.first_size(), (rig.width, rig.height), calibration)
        truth = _ground_truth(root, cameras[0].T_body_camera, faults)
    name = folder.parent.name if folder.name == "mav0" else folder.name
    return RecordedSequence(
        name, "euroc", options.get("kind", "handheld"), rig, source, truth, None, warnings, MOCAP_NOISE
    )


def _root(folder: Path) -> Path:
    """The folder that holds the cameras."""
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _listing(camera: Path, faults: FaultLog) -> Listing:
    """The images of one camera that exist, by ``data.csv`` or, where there is none, by their names."""
    if not camera.is_dir():
        reason = "a file where a folder should be" if camera.exists() else "missing, two cameras are needed"
        raise SequenceError(f"{camera}: {reason}")
    data, table = camera / "data", camera / "data.csv"
    if not table.exists():
        by_stamp = [(stamp, name) for name in image_names(data) if (stamp := number_of(name)) is not None]
        if not by_stamp:
            raise SequenceError(f"{camera}: no data.csv, and no images named by their stamps in data")
        by_stamp.sort()
        keys = np.array([stamp for stamp, _ in by_stamp], np.int64)
        return in_order(Listing(data, keys, [name for _, name in by_stamp]), str(data), faults)
    rows = [row for row in read_rows(table, stamp_and_name, faults) if row is not None]
    listing = Listing(data, np.array([s for s, _ in rows], np.int64), [n for _, n in rows])
    return present(in_order(listing, str(table), faults), str(table), faults)


def _cameras(root: Path) -> tuple[list[ImuCamera], Path]:
    """Both cameras from ``sensor.yaml`` or, where those are missing, from a Kalibr ``camchain.yaml``."""
    files = [root / cam / "sensor.yaml" for cam in ("cam0", "cam1")]
    if any(f.exists() for f in files):
        return [euroc_camera(f) for f in files], files[1]
    for name in _CAMCHAINS:
        chain = root / name
        if chain.is_file():
            return kalibr_cameras(chain), chain
    raise CalibrationError(f"{files[0]}: the calibration is missing (nor is there a Kalibr camchain.yaml)")


def _ground_truth(root: Path, T_body_camera: Array, faults: FaultLog) -> Trajectory | None:
    """The left camera's path: body poses times the camera's pose in the body."""
    for folder in _TRUTH:
        path = root / folder / "data.csv"
        if path.is_file():
            try:
                return _camera_path(path, T_body_camera, faults)
            except (TrajectoryError, SequenceError) as error:
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
    try:
        row = [float(word) for word in text.split(",")[:8]]
    except ValueError:
        raise ValueError(f"{shorten(text)} is not a row of numbers") from None
    if len(row) < 8 or not np.isfinite(row).all() or max(map(abs, row[4:])) > 2:
        raise ValueError(f"{shorten(text)} is not stamp, position and unit quaternion")
    if abs(np.linalg.norm(row[4:]) - 1) > 0.1 or max(map(abs, row[1:4])) > LARGEST or not 0 <= row[0] < 2**63:
        raise ValueError(f"{shorten(text)} is not stamp, position and unit quaternion")
    return row
