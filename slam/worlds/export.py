"""Writing a world as an EuRoC folder with its true path, so that other programs can run on it."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.files import write_png
from slam.geometry.camera import PinholeCamera
from slam.geometry.se3 import Array, inverse
from slam.geometry.stamps import frame_range
from slam.geometry.trajectory import Trajectory
from slam.worlds.sequence import WorldSequence

#: Folder in which a recording is written.
FOLDER = "mav0"


def write_euroc(
    sequence: object, folder: str | Path, start: int = 0, stop: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:  # fmt: skip
    """Render frames `start` up to, but without, `stop` of a world into ``folder/mav0``; returns that folder.

    ``cam0`` and ``cam1`` hold the images, their lists and calibrations; the body is the left camera.
    ``state_groundtruth_estimate0/data.csv`` holds its path, ``world.txt`` the text that opens the world again.
    `progress` is told the number of frames done after each.

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
        _write(sequence, root, range(first, last), progress)
    except OSError as error:
        raise SequenceError(f"{root}: cannot be written: {error.strerror or error}") from error
    return root


def require_world(sequence: object) -> WorldSequence:
    """The sequence, if it is a world; else raises SequenceError."""
    if not isinstance(sequence, WorldSequence):
        name = getattr(sequence, "name", sequence)
        raise SequenceError(f"{name}: only synthetic worlds can be rendered, this is a recording")
    return sequence


def _write(sequence: WorldSequence, root: Path, frames: range, progress: Callable[[int], None] | None) -> None:
    """Calibrations and path come before the images, and lists grow with them: a folder cut short is still readable."""
    rig, poses = sequence.rig, (np.eye(4), inverse(sequence.rig.T_right_left))
    cameras, truth = [root / "cam0", root / "cam1"], sequence.ground_truth
    for folder, camera, T_body_camera in zip(cameras, (rig.left, rig.right), poses):
        (folder / "data").mkdir(parents=True)
        text = _camera_text(camera, T_body_camera, float(sequence.values["rate"]))
        (folder / "sensor.yaml").write_text(text, encoding="utf-8")
    state = root / "state_groundtruth_estimate0"
    state.mkdir()
    Trajectory(truth.stamps[frames], truth.poses[frames]).write_euroc(state / "data.csv")
    (root / "world.txt").write_text(f"synthetic:{sequence.name}\n", encoding="utf-8")
    with ExitStack() as stack:
        tables = [stack.enter_context((folder / "data.csv").open("w", encoding="ascii")) for folder in cameras]
        for table in tables:
            table.write("#timestamp [ns],filename\n")
        for done, k in enumerate(frames, start=1):
            frame = sequence.frame(k)
            stamp = round(frame.stamp * 1e9)
            for folder, table, image in zip(cameras, tables, (frame.left, frame.right)):
                if image is not None:
                    write_png(folder / "data" / f"{stamp}.png", image)
                    table.write(f"{stamp},{stamp}.png\n")
                    table.flush()
            if progress is not None:
                progress(done)


def _camera_text(camera: PinholeCamera, T_body_camera: Array, rate: float) -> str:
    import yaml

    node = {
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
    return yaml.safe_dump(node, sort_keys=False)
