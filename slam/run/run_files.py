"""The files that a run leaves. Rows go to disk frame by frame, so that a run killed half way keeps what it had done."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam.atlas.atlas import Atlas
from slam.data import Estimate, FrameResult
from slam.errors import SlamError
from slam.files import RowFile, reason, remove_file, write_text
from slam.geometry.se3 import Array, angles, transform
from slam.geometry.trajectory import tum_line
from slam.object_data import MovingObject
from slam.run.schema import FILES, FRAME_TABLE, LANDMARK_TABLE, OBJECT_TABLE, OLD_LANDMARKS, OLD_TABLE, STAGES, header

_ROWS = ("trajectory.txt", "frames.csv", "objects.csv")  # grow frame by frame

_NUMBER = r"\s+(?:-?\d[-+.\deE]*|null)"
_NUMBERS = re.compile(rf"\[{_NUMBER}(?:,{_NUMBER})*\s+\]")  # as json indents them; no text holds a line break


class RunFiles(ExitStack):
    """Writer of a run's folder; a context manager that closes the files.

    The folder is made where there is none. Files of an earlier run are overwritten. Each method raises SlamError where
    a file cannot be written: a whole one is then as it was, and of rows those before stay.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        with ExitStack() as opened, naming_folder(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for name in set(FILES).difference(_ROWS):
                remove_file(folder / name)
            self._trajectory, self._frames, self._objects = (
                opened.enter_context(closing(RowFile(folder / name))) for name in _ROWS
            )
            self._frames.write(csv_rows([header(FRAME_TABLE)]))
            self._objects.write(csv_rows([header(OBJECT_TABLE)]))
            self.enter_context(opened.pop_all())

    def write_frame(self, number: int, result: FrameResult, loop: int | str = "", refused: int | str = "") -> None:
        """Append one frame, `number` in its sequence, to trajectory.txt, frames.csv and objects.csv.

        `loop` is the number of the frame whose place it shows again, where it closed a loop, or ``map``; `refused` the
        same of a place that it only seemed to show again.
        """
        e, r, features = result.estimate, result.report, result.features
        sigmas, upper = [float("nan")] * 4, [""] * 21
        if result.located:
            R, P = e.T_world_left[:3, :3], e.covariance
            position = np.sqrt(np.maximum(np.diag(R @ P[3:, 3:] @ R.T), 0))
            sigmas = [*position, float(np.sqrt(max(np.trace(P[:3, :3]), 0.0)))]
            upper = [f"{x:.9g}" for x in P[np.triu_indices(6)]]
        row = [
            number, f"{e.stamp:.9f}", result.status.value, result.reason,
            len(features), int(features.has_stereo.sum()), result.predicted,
            len(result.matched), len(r.used), len(r.rejected),
            len(result.added), len(result.erased), result.map_size, int(result.keyframe), loop, refused,
            csv_number(features.threshold), csv_number(r.nis), r.dof, *map(csv_number, sigmas), *upper,
            *(f"{result.milliseconds.get(stage, 0.0):.3f}" for stage in STAGES),
        ]  # fmt: skip
        things = csv_rows(_object_row(number, thing) for thing in result.objects)
        with naming_folder(self.folder):
            self._frames.write(csv_rows([row]))
            self._objects.write(things)
            self._trajectory.write(tum_line(e.stamp, e.T_world_left) if result.located else "")

    def write_landmarks(
        self, estimate: Estimate, seen: Mapping[int, int], last_seen: Mapping[int, int], atlas: Atlas | None
    ) -> None:
        """Write landmarks.csv, and landmarks_old.csv where there is an `atlas`.

        `seen` and `last_seen` say by id in how many frames each was measured, and in which the last time.
        """
        rows: list[Sequence[Any]] = [header(LANDMARK_TABLE)]
        upper = np.triu_indices(3)
        for i, position, covariance in zip(estimate.ids.tolist(), estimate.positions, estimate.covariances):
            values = (f"{x:.9g}" for x in (*position, *covariance[upper]))
            rows.append([i, *values, seen.get(i, 0), last_seen.get(i, "")])
        write_text(self.folder / "landmarks.csv", csv_rows(rows))
        if atlas is None:
            return
        found: dict[int, Array] = {}  # as the last keyframe of this run has them
        for keyframe, T in zip(atlas.keyframes[atlas.prior_count :], atlas.poses_in_map[atlas.prior_count :]):
            left = np.flatnonzero(~np.isin(keyframe.landmarks, [-1, *estimate.ids]))
            at = transform(T, np.asarray(keyframe.points, float)[left])
            found.update(zip(np.asarray(keyframe.landmarks)[left].tolist(), at))
        lines = ([i, *(f"{x:.9g}" for x in found[i])] for i in sorted(found))
        write_text(self.folder / OLD_LANDMARKS, csv_rows([header(OLD_TABLE), *lines]))


def write_json(path: Path, tree: dict[str, Any]) -> None:
    """Write a JSON file at once or not at all; numbers that JSON cannot hold become null.

    Each list of numbers stands on one line: a matrix has a line for each row. Raises SlamError where it cannot be
    written.
    """

    def on_one_line(found: re.Match[str]) -> str:
        return "[" + ", ".join(found[0][1:-1].replace(",", " ").split()) + "]"

    write_text(path, _NUMBERS.sub(on_one_line, json.dumps(_finite(tree), indent=2)) + "\n")


@contextmanager
def naming_folder(folder: Path) -> Iterator[None]:
    """Turn what the system says of a failed write into a SlamError."""
    try:
        yield
    except OSError as error:
        raise SlamError(f"cannot write to {folder}: {reason(error)}") from error
    except ValueError as error:  # a NUL in the name
        raise SlamError(f"cannot write to {folder}: no possible file name") from error


def csv_rows(rows: Iterable[Sequence[Any]]) -> str:
    """Rows of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _object_row(number: int, thing: MovingObject) -> list[Any]:
    """A row of `slam.run.schema.OBJECT_TABLE` for a body in frame `number`."""
    e = thing.estimate
    places = [[*T[:3, 3], *angles(T[:3, :3])] for T in (e.T_world_object, thing.motion)]
    numbers = [*places[0], *e.velocity[3:], *e.velocity[:3], *places[1], *e.covariance[np.triu_indices(6)]]
    seen = f"{thing.measured_at:.9f}" if np.isfinite(thing.measured_at) else ""
    flags = [int(thing.moving), int(e.measured), seen, f"{thing.existence:.6f}"]
    return [number, f"{e.stamp:.9f}", thing.id, *flags, *(f"{x:.9g}" for x in numbers)]


def csv_number(value: float) -> str:
    """A number for a CSV cell; empty where it is not finite."""
    return f"{value:.9g}" if np.isfinite(value) else ""


def _finite(tree: Any) -> Any:
    """The tree with numbers that JSON cannot hold as null."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    if isinstance(tree, np.generic):
        tree = tree.item()
    return None if isinstance(tree, float) and not np.isfinite(tree) else tree
