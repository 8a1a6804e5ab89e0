"""EuRoC's format (ASL folders): ``mav0/cam0``, ``mav0/cam1``, and what follows it, such as TUM-VI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import CalibrationError, SequenceError, TrajectoryError
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.sequences.base import FaultLog, RecordedSequence
from slam.sequences.calibration import naming, read_entries
from slam.sequences.names import stem
from slam.sequences.options import Options
from slam.sequences.pairs import Listing, image_names, in_order, listed, open_images, told_times
from slam.sequences.rigs import EUROC, body_pose, calibration_files, files_in, first_complete, read_rig
from slam.sequences.tables import MOST_NANOSECONDS, read_rows, require_truth

#: The motion capture of EuRoC's rooms is good to a millimetre (Burri et al., 2016). Its markers on the vehicle are some
#: half a metre apart, which makes 2 mrad. The camera's orientation in the vehicle is calibrated to half a degree or so,
#: its place to a centimetre, and its clock against the camera's to half an exposure.
MOCAP_NOISE = TruthNoise(rotation=0.002, translation=0.001, mounting=0.01, lever=0.01, clock=0.01)

_CAMERAS = ("cam0", "cam1")
_TRUTH = ("state_groundtruth_estimate0", "mocap0")  # both give the body's (IMU's) pose


def matches_folder(folder: Path) -> bool:
    """Whether a folder looks like EuRoC's: it, or its ``mav0``, holds ``cam0`` or ``cam1`` with data in it."""
    return any((_root(folder) / cam / part).exists() for cam in _CAMERAS for part in ("data", "data.csv"))


def open_folder(folder: Path, options: Options, faults: FaultLog) -> RecordedSequence:
    """Open a sequence in EuRoC's format; `folder` holds ``mav0`` or is it."""
    root = _root(folder)
    times = told_times(folder, options, faults)
    cameras = [root / cam for cam in _CAMERAS]
    for camera in cameras:
        if not camera.is_dir():
            reason = "a file where a folder should be" if camera.exists() else "missing, two cameras are needed"
            raise SequenceError(f"{camera}: {reason}")
    if all((camera / "data.csv").exists() for camera in cameras):
        sides = [_table(camera / "data.csv", faults) for camera in cameras]
    else:
        inside = [camera / "data" for camera in cameras]
        sides = listed(inside, [image_names(images) for images in inside], faults)
    pairs, decode, size = open_images(sides, options, faults, times)
    own = files_in(root, EUROC)
    rig = read_rig(calibration_files(folder, options, own), size, options)
    truth = _ground_truth(root, first_complete(own), faults)
    name = folder.parent.name if folder.name == "mav0" else folder.name
    kind = options.get("kind", "handheld")
    return RecordedSequence(name, "euroc", kind, rig, pairs.stamps, decode, truth, MOCAP_NOISE)


def _root(folder: Path) -> Path:
    """The folder that holds the cameras."""
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _table(table: Path, faults: FaultLog) -> Listing:
    """The images that a ``data.csv`` lists and that exist; another ending (``.jpg`` for ``.png``) is accepted."""
    rows = [row for row in read_rows(table, _stamp_and_name, faults) if row is not None]
    folder = table.parent / "data"
    there = image_names(folder)
    known = {stem(name): name for name in there} | {name: name for name in there}
    found = [known.get(name) or known.get(stem(name), "") for _, name in rows]
    missing = [name for (_, name), own in zip(rows, found) if not own]
    if len(missing) == len(rows):
        raise SequenceError(f"{folder}: none of the {len(rows)} images listed in {table} is there")
    if missing:
        line = f"{table}: {len(missing)} of {len(rows)} listed images are missing (first: {missing[0]})"
        faults.report("listed images", line)
    listing = in_order(Listing(folder, np.array([s for s, _ in rows], np.int64), found, True), str(table), faults)
    return listing.select(np.flatnonzero([bool(name) for name in listing.names]))


def _stamp_and_name(text: str) -> tuple[int, str]:
    """A row of ``data.csv``: nanoseconds and file name; the name defaults to the stamp."""
    stamp, name = (cell.strip() for cell in f"{text},".split(",")[:2])
    try:
        value = int(stamp)
    except ValueError:
        raise ValueError(f"{stamp!r:.40} is not a time in whole nanoseconds") from None
    if not 0 <= value <= MOST_NANOSECONDS:
        raise ValueError(f"{stamp!r:.40} is no possible time in nanoseconds")
    return value, name or f"{stamp}.png"


def _ground_truth(root: Path, calibration: list[Path], faults: FaultLog) -> Trajectory | None:
    """The left camera's path: body poses times the camera's pose in the body."""
    path = next((path for name in _TRUTH if (path := root / name / "data.csv").is_file()), None)
    if path is None:
        return None
    try:
        if not calibration:
            raise SequenceError(f"{path}: no sensor.yaml says where the camera is on the body")
        with naming(calibration[0]):
            T_body_camera = body_pose(read_entries(calibration, None), 0)
        bodies = Trajectory.read_euroc(path)
        poses = bodies.poses if T_body_camera is None else bodies.poses @ T_body_camera
        return require_truth(Trajectory(bodies.stamps, poses), path)
    except (TrajectoryError, SequenceError, CalibrationError) as error:
        faults.report("ground truth", f"{error}; there is no ground truth")
        return None
