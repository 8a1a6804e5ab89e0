"""What the files of a finished run say, for its pictures."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SlamError
from slam.files import read_object, read_text
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.naming import printable
from slam.run.schema import OLD_LANDMARKS, STAGES

_NOWHERE = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class RunData:
    """What a run's folder says.

    Attributes:
        name: shown in the pictures.
        online, final: paths.
        positions: landmarks (N, 3) [m].
        covariances: (N, 3, 3) [m²].
        seen_last: which landmarks were measured in the last frame (N,).
        deviations: of the online position in world axes [m] and of the rotation [deg], (F, 4), by pose of `online`.
        measured: whether each pose of `online` was measured (F,), or is the motion model's alone.
        status: of each frame.
        milliseconds: by stage, of each frame [ms].
        truth: true path, in its own world; None where it is not known.
        sequence, backend: names.
        folder: where it was read from.
        truth_is_exact: whether the truth has no errors of its own: that of a world.
        loops: rows of `final` whose places are the same (L, 2), the later one first.
        refused: rows of `final` whose places only looked alike (L, 2), the later one first.
        keyframes: rows of `final` that are keyframes (K,).
        old: landmarks that had left the map before the end (M, 3) [m].
        bodies: where moving bodies were measured (B, 3) [m], by id.
        summary: of the run; empty where there is none.
    """

    name: str
    online: Trajectory
    final: Trajectory
    positions: Array
    covariances: Array
    seen_last: np.ndarray
    deviations: Array
    measured: np.ndarray
    status: list[str]
    milliseconds: dict[str, Array]
    truth: Trajectory | None = None
    sequence: str = ""
    backend: str = ""
    folder: Path = Path()
    truth_is_exact: bool = True
    loops: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))
    refused: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))
    keyframes: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    old: Array = field(default_factory=lambda: _NOWHERE)
    bodies: Mapping[str, Array] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path, name: str) -> RunData:
        """Read the files of a finished run.

        Raises:
            SlamError: the folder does not hold a finished run.
        """
        if not folder.exists():
            raise SlamError(f"{folder}: there is no such folder")
        if not (folder / "landmarks.csv").exists():
            raise SlamError(f"{folder}: not the folder of a finished run: there is no landmarks.csv")
        try:
            return cls._read(folder, name)
        except (KeyError, IndexError, ValueError, TypeError, OverflowError, csv.Error) as error:
            raise SlamError(f"{folder}: not the folder of a finished run: {error}") from error

    @classmethod
    def _read(cls, folder: Path, name: str) -> RunData:
        landmarks, frames = _rows(folder / "landmarks.csv"), _rows(folder / "frames.csv")
        upper = _numbers(landmarks, ("cxx", "cxy", "cxz", "cyy", "cyz", "czz"))
        last_seen = _numbers(landmarks, ("last_seen",))[:, 0]
        truth, final = folder / "truth.txt", Trajectory.read_tum(folder / "trajectory_final.txt")
        located = [row for row in frames if row["sd_x"]]
        config = read_object(folder / "config.json")
        return cls(
            printable(name),
            Trajectory.read_tum(folder / "trajectory.txt"),
            final,
            _numbers(landmarks, ("x", "y", "z")),
            upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3),
            last_seen == int(frames[-1]["frame"]),
            _numbers(located, ("sd_x", "sd_y", "sd_z", "sd_rotation")) * [1, 1, 1, np.degrees(1)],
            np.array([row["status"] in ("started", "tracked") for row in located], bool),
            [row["status"] for row in frames],
            {stage: _numbers(frames, (f"ms_{stage}",))[:, 0] for stage in STAGES},
            Trajectory.read_tum(truth) if truth.exists() else None,
            printable(str(config["sequence"])),
            printable(str(config["backend"])),
            folder,
            config["format"] == "synthetic",
            _pairs(frames, final, "loop"),
            _pairs(frames, final, "refused"),
            _keyframes(frames, final),
            _numbers(_rows(folder / OLD_LANDMARKS), ("x", "y", "z")) if (folder / OLD_LANDMARKS).exists() else _NOWHERE,
            _bodies(folder),
            read_object(folder / "summary.json") if (folder / "summary.json").exists() else {},
        )


def _pairs(frames: list[dict[str, str]], final: Trajectory, column: str) -> np.ndarray:
    """Rows of the final path (L, 2) of the frames that a column names a place for, and of that place."""
    stamps = {row["frame"]: float(row["stamp"]) for row in frames}
    pairs = [(stamps[row["frame"]], stamps[row[column]]) for row in frames if (row.get(column) or "").isdigit()]
    return _rows_at(final, np.array(pairs).reshape(-1, 2))


def _keyframes(frames: list[dict[str, str]], final: Trajectory) -> np.ndarray:
    """Rows of the final path (K,) that are keyframes."""
    return _rows_at(final, np.array([float(row["stamp"]) for row in frames if row.get("keyframe") == "1"]))


def _rows_at(final: Trajectory, stamps: Array) -> np.ndarray:
    """Rows of the final path at stamps."""
    return np.searchsorted(final.stamps, stamps - 1e-9).clip(0, max(len(final) - 1, 0))


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(read_text(path), newline="")))


def read_objects(folder: Path) -> list[tuple[float, str, list[float]]]:
    """Stamp [s], id and position [m] of every row of objects.csv.

    Raises:
        SlamError: the file is missing or damaged.
    """
    path = folder / "objects.csv"
    try:
        return [(float(row["stamp"]), row["id"], [float(row[c]) for c in "xyz"]) for row in _rows(path)]
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise SlamError(f"{path}: no list of objects: {error}") from error


def _bodies(folder: Path) -> dict[str, Array]:
    """Where each body was, by its id."""
    found: dict[str, list[list[float]]] = {}
    for _, name, position in read_objects(folder) if (folder / "objects.csv").exists() else ():
        found.setdefault(name, []).append(position)
    return {name: np.array(positions) for name, positions in found.items()}


def _numbers(rows: list[dict[str, str]], columns: tuple[str, ...]) -> Array:
    """Columns of a table as numbers (N, C); NaN for an empty cell."""
    return np.array([[float(row[c] or "nan") for c in columns] for row in rows]).reshape(-1, len(columns))
