"""Writing a world as an EuRoC folder with its truth, so that other programs can run on it."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError
from slam.files import write_png
from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import Array, angles, inverse
from slam.geometry.stamps import frame_range
from slam.geometry.trajectory import Trajectory
from slam.worlds.sequence import WorldSequence

#: Steps per metre of the depth images, by kind of motion: 16 bits then reach 32 m or 256 m.
DEPTH_STEPS = {"handheld": 2000, "driving": 256}

#: Folder in which a recording is written.
FOLDER = "mav0"

OBJECT_COLUMNS = (
    "stamp", "id", "x", "y", "z", "roll", "pitch", "yaw",
    "motion_x", "motion_y", "motion_z", "motion_roll", "motion_pitch", "motion_yaw",
)  # fmt: skip
LANDMARK_COLUMNS = ("id", "x", "y", "z", "object", "size")


def write_euroc(
    sequence: object, folder: str | Path, start: int = 0, stop: int | None = None,
    progress: Callable[[int], None] | None = None, truth_images: bool = True,
) -> Path:  # fmt: skip
    """Render frames `start` up to, but without, `stop` of a world into ``folder/mav0``; returns that folder.

    ``cam0`` and ``cam1`` hold the images, their lists and calibrations; the body is the left camera.
    ``state_groundtruth_estimate0/data.csv`` holds its path. Beside them, for the left image of each frame, are
    ``depth0/data`` (16-bit PNG, steps per metre in its ``sensor.yaml``, 0 where nothing is or it is too far) and
    ``objects0/data`` (16-bit PNG, object of each pixel, 0 for the still world), and for all frames ``objects.csv``
    (object poses; motion since the frame before, in world axes, angles in radians) and ``landmarks.csv`` (id, place
    at the first frame written, object, size). `progress` is told the number of frames done after each.

    Raises:
        SequenceError: the sequence is no world, the range is empty, or the folder holds a recording already or
            cannot be written.
    """
    sequence = require_world(sequence)
    first, last = frame_range(start, stop, len(sequence))
    root = Path(folder) / FOLDER
    if os.path.lexists(root):
        raise SequenceError(f"{root}: exists already; choose another folder")
    try:
        _write_tables(sequence, root, range(first, last))
        _write_images(sequence, root, range(first, last), progress, truth_images)
    except OSError as error:
        raise SequenceError(f"{root}: cannot be written: {error.strerror or error}") from error
    return root


def require_world(sequence: object) -> WorldSequence:
    """The sequence, if it is a world; else raises SequenceError."""
    if not isinstance(sequence, WorldSequence):
        name = getattr(sequence, "name", sequence)
        raise SequenceError(f"{name}: only synthetic worlds can be rendered, this is a recording")
    return sequence


def _write_tables(sequence: WorldSequence, root: Path, frames: range) -> None:
    """Calibrations and tables, before the images, so that a folder cut short is still readable."""
    import yaml

    rig, rate, truth = sequence.rig, float(sequence.values["rate"]), sequence.ground_truth
    for folder, node in (
        ("cam0", _camera_node(rig.left, np.eye(4), rate)),
        ("cam1", _camera_node(rig.right, inverse(rig.T_right_left), rate)),
        ("depth0", {"sensor_type": "depth", "steps_per_metre": DEPTH_STEPS[sequence.kind]}),
    ):
        (root / folder).mkdir(parents=True)
        (root / folder / "sensor.yaml").write_text(yaml.safe_dump(node, sort_keys=False), encoding="utf-8")
    (root / "state_groundtruth_estimate0").mkdir()
    path = Trajectory(truth.stamps[list(frames)], truth.poses[list(frames)])
    path.write_euroc(root / "state_groundtruth_estimate0" / "data.csv")
    objects, marks, landmarks = [], [], sequence.landmarks
    for k in frames:
        now, before = sequence.objects(k), sequence.objects(max(k - 1, frames[0]))
        for i, T, T_before in zip(now.ids, now.T_world_object, before.T_world_object):
            motion = T @ inverse(T_before)
            values = (*T[:3, 3], *angles(T[:3, :3]), *motion[:3, 3], *angles(motion[:3, :3]))
            objects.append([f"{sequence.stamps[k]:.9f}", str(int(i)), *(f"{v:.9g}" for v in values)])
    places = landmarks.world_positions(sequence.world.T_world_body(sequence.source(frames[0])))
    for i, (place, body, size) in enumerate(zip(places, landmarks.object, landmarks.size)):
        marks.append([str(i), *(f"{x:.9g}" for x in place), str(int(body)), f"{size:.6g}"])
    for name, columns, rows in (("objects", OBJECT_COLUMNS, objects), ("landmarks", LANDMARK_COLUMNS, marks)):
        with (root / f"{name}.csv").open("w", encoding="ascii", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([columns, *rows])
    (root / "world.txt").write_text(f"synthetic:{sequence.name}\n", encoding="utf-8")


def _write_images(
    sequence: WorldSequence, root: Path, frames: range, progress: Callable[[int], None] | None, truth_images: bool
) -> None:
    """Images with their lists, which grow with them."""
    names, steps = ("cam0", "cam1", "depth0", "objects0")[: 4 if truth_images else 2], DEPTH_STEPS[sequence.kind]
    with ExitStack() as stack:
        tables = []
        for name in names:
            (root / name / "data").mkdir(parents=True)
            tables.append(stack.enter_context((root / name / "data.csv").open("w", encoding="ascii")))
            tables[-1].write("#timestamp [ns],filename\n")
        for done, k in enumerate(frames, start=1):
            frame = sequence.frame(k)
            images, nanoseconds = [frame.left, frame.right], round(frame.stamp * 1e9)
            if truth_images:
                depth = np.rint(sequence.depth(k) * steps)
                images.append(np.where(depth < 65536, depth, 0).astype(np.uint16))
                images.append(sequence.object_ids(k).astype(np.uint16))
            for name, table, image in zip(names, tables, images):
                if image is not None:
                    write_png(root / name / "data" / f"{nanoseconds}.png", image)
                    table.write(f"{nanoseconds},{nanoseconds}.png\n")
                    table.flush()
            if progress is not None:
                progress(done)


def _camera_node(camera: PinholeCamera, T_body_camera: Array, rate: float) -> dict[str, Any]:
    """A camera as EuRoC's ``sensor.yaml`` has it."""
    return {
        "sensor_type": "camera",
        "comment": "rendered",
        "T_BS": {"cols": 4, "rows": 4, "data": T_body_camera.ravel().tolist()},
        "rate_hz": rate,
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [float(x) for x in (camera.fu, camera.fv, camera.u0, camera.v0)],
        "distortion_model": "equidistant" if camera.model == "equidistant" else "radial-tangential",
        "distortion_coefficients": [float(x) for x in camera.distortion or (0.0, 0.0, 0.0, 0.0)],
    }
