"""The files that a run leaves. Rows go to disk frame by frame, so that a run killed half way keeps what it had done."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from slam.data import Estimate, FrameResult
from slam.errors import SlamError
from slam.geometry.euler import angles
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory, tum_line
from slam.landmarks import LandmarkRows
from slam.object_data import MovingObject
from slam.run.schema import FRAME_TABLE, LANDMARK_TABLE, OBJECT_TABLE, STAGES, header

FRAME_COLUMNS, LANDMARK_COLUMNS, OBJECT_COLUMNS = map(header, (FRAME_TABLE, LANDMARK_TABLE, OBJECT_TABLE))


class RunFiles:
    """Writer of a run's folder; a context manager that closes the files.

    Args:
        folder: made if it does not exist; files of an earlier run in it are overwritten.

    Raises:
        SlamError: the folder or a file in it cannot be made or written; so do all methods.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with self._writing():
            folder.mkdir(parents=True, exist_ok=True)
            for stale in ("trajectory_final.txt", "truth.txt", "landmarks.csv", "summary.json", "summary.png"):
                (folder / stale).unlink(missing_ok=True)
            self._trajectory = self._open("trajectory.txt")
            self._frames = self._open("frames.csv")
            self._objects = self._open("objects.csv")
        self._frame_rows = csv.writer(self._frames, lineterminator="\n")
        self._frame_rows.writerow(FRAME_COLUMNS)
        self._object_rows = csv.writer(self._objects, lineterminator="\n")
        self._object_rows.writerow(OBJECT_COLUMNS)
        self._objects.flush()

    def __enter__(self) -> RunFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._writing(), ExitStack() as stack:
            for file in (self._trajectory, self._frames, self._objects):
                stack.callback(file.close)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """A fault of the disk as one line."""
        try:
            yield
        except OSError as error:
            raise SlamError(f"cannot write to {self.folder}: {error.strerror or error}") from error

    def _open(self, name: str) -> TextIO:
        return (self.folder / name).open("w", encoding="utf-8", newline="")

    def write_frame(self, number: int, result: FrameResult) -> None:
        """Append one frame, `number` in its sequence, to trajectory.txt, frames.csv and objects.csv."""
        with self._writing():
            self._write_frame(number, result)

    def _write_frame(self, number: int, result: FrameResult) -> None:
        e, r = result.estimate, result.report
        if result.located:
            self._trajectory.write(tum_line(e.stamp, e.T_world_left))
        row: list[Any] = [number, f"{e.stamp:.9f}", result.status.value, result.reason]
        features = result.features
        row += [len(features), int(features.has_stereo.sum()), result.predicted]
        row += [len(result.matched), len(r.used), len(r.rejected)]
        row += [len(result.added), len(result.erased), result.map_size]
        deviations = _deviations(e) if result.located else [float("nan")] * 4
        row += [_number(features.threshold), _number(r.nis), r.dof, *map(_number, deviations)]
        row += [f"{result.milliseconds.get(stage, 0.0):.3f}" for stage in STAGES]
        self._frame_rows.writerow(row)
        self._object_rows.writerows(_object_row(number, thing) for thing in result.objects)
        for file in (self._trajectory, self._frames, self._objects):
            file.flush()

    def write_final(
        self, trajectory: Trajectory, estimate: Estimate, landmarks: LandmarkRows | None, numbers: list[int]
    ) -> None:
        """Write trajectory_final.txt and landmarks.csv; `numbers` are the frames' numbers by step."""
        with self._writing():
            trajectory.write_tum(self.folder / "trajectory_final.txt")
        with self._writing(), self._open("landmarks.csv") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(LANDMARK_COLUMNS)
            if landmarks is None:
                return
            upper = np.triu_indices(3)
            for i, position, covariance in zip(estimate.ids, estimate.positions, estimate.covariances):
                at = int(landmarks.rows(np.array([i]))[0])
                values = (f"{x:.9g}" for x in (*position, *covariance[upper]))
                step = int(landmarks.last_seen[at])
                last = numbers[step] if step >= 0 else ""  # empty: known from the start, and not seen yet
                rows.writerow([int(i), *values, int(landmarks.seen[at]), last])

    def write_truth(self, trajectory: Trajectory) -> None:
        """Write truth.txt, the true path at the frames' stamps."""
        with self._writing():
            trajectory.write_tum(self.folder / "truth.txt")

    def write_json(self, name: str, tree: dict[str, Any]) -> None:
        """Write a JSON file at once or not at all."""
        with self._writing():
            write_json(self.folder / name, tree)


def write_json(path: Path, tree: dict[str, Any]) -> None:
    """Write a JSON file at once or not at all; numbers that JSON cannot hold become null."""
    temporary = path.with_suffix(".json.part")
    temporary.write_text(json.dumps(_finite(tree), indent=2) + "\n", encoding="utf-8")
    temporary.replace(path)


def _object_row(number: int, thing: MovingObject) -> list[Any]:
    """A row of `slam.run.schema.OBJECT_TABLE` for a body in frame `number`."""
    e = thing.estimate
    numbers = [*_pose_numbers(e.T_world_object), *e.velocity[3:], *e.velocity[:3]]
    numbers += [*_pose_numbers(thing.motion), *e.covariance[np.triu_indices(6)]]
    flags = [int(thing.moving), int(e.measured)]
    return [number, f"{e.stamp:.9f}", thing.id, *flags, *(f"{x:.9g}" for x in numbers)]


def _pose_numbers(T: Array) -> list[float]:
    """x, y, z [m], roll, pitch, yaw [rad]."""
    return [*map(float, T[:3, 3]), *map(float, angles(T[:3, :3]))]


def _deviations(estimate: Estimate) -> list[float]:
    """Standard deviations of the position in world axes [m], and of the rotation all axes together [rad]."""
    R, P = estimate.T_world_left[:3, :3], estimate.covariance
    position = np.diag(R @ P[3:, 3:] @ R.T)
    return [*np.sqrt(np.maximum(position, 0)), float(np.sqrt(max(np.trace(P[:3, :3]), 0.0)))]


def _number(value: float) -> str:
    """A number for a CSV cell; empty where it is not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""


def _finite(tree: Any) -> Any:
    """The tree with numbers that JSON cannot hold as null."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    if isinstance(tree, np.generic):
        tree = tree.item()
    return None if isinstance(tree, float) and not np.isfinite(tree) else tree
