"""What the files of a finished run say, for its pictures."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SlamError, one_line
from slam.evaluation.consistency import by_mounting
from slam.evaluation.metrics import associate
from slam.evaluation.summary import rotation_errors
from slam.evaluation.truth_error import interpolated, truth_covariances
from slam.files import read_object, read_text
from slam.geometry.se3 import Array, adjoint, inverse, transform
from slam.geometry.trajectory import Trajectory, TruthNoise, alignment
from slam.run.schema import OLD_LANDMARKS, STAGES

_TURNED = np.radians(1.0)  # how far the axes of a recorded truth are turned against the camera's, about


@dataclass(frozen=True, eq=False)
class RunData:
    """What a run's folder says."""

    name: str  # shown in the pictures
    online: Trajectory
    final: Trajectory
    ids: np.ndarray  # of landmarks (N,)
    positions: Array  # of landmarks (N, 3) [m]
    covariances: Array  # of these (N, 3, 3) [m²]
    seen_last: np.ndarray  # which landmarks were measured in the last frame (N,)
    deviations: Array  # of the online position [m] and of the rotation [deg], all axes together, (F, 2), by pose
    measured: np.ndarray  # whether each pose of `online` was measured (F,), or is the motion model's alone
    status: list[str]  # of each frame
    milliseconds: dict[str, Array]  # by stage, of each frame [ms]
    truth: Trajectory | None  # in its own world; None where it is not known
    sequence: str
    backend: str
    folder: Path
    truth_noise: TruthNoise  # how far the truth may be off
    truth_is_exact: bool  # whether the truth has no errors of its own: that of a world
    loops: np.ndarray  # rows of `final` whose places are the same (L, 2), the later one first
    refused: np.ndarray  # rows of `final` whose places only looked alike (L, 2), the later one first
    old: Array  # landmarks that had left the map before the end (M, 3) [m]
    bodies: Mapping[str, Array]  # where each moving body was measured (B, 3) [m], by id
    summary: Mapping[str, Any]  # of the run; empty where there is none

    @classmethod
    def read(cls, folder: Path, name: str) -> RunData:
        """Read the files of a finished run; raises SlamError: the folder does not hold a finished run."""
        if not folder.exists():
            raise SlamError(f"{folder}: there is no such folder")
        if not (folder / "landmarks.csv").exists():
            below = " ".join(sorted(str(path.parent) for path in folder.glob("*/landmarks.csv")))
            hint = f"; below it are some: {below}" if below else ": there is no landmarks.csv"
            raise SlamError(f"{folder}: not the folder of a finished run{hint}")
        try:
            return cls._read(folder, name)
        except (KeyError, IndexError, ValueError, TypeError, OverflowError, csv.Error) as error:
            raise SlamError(f"{folder}: not the folder of a finished run: {error}") from error

    @classmethod
    def _read(cls, folder: Path, name: str) -> RunData:
        landmarks, frames = _rows(folder / "landmarks.csv"), _rows(folder / "frames.csv")
        old = _rows(folder / OLD_LANDMARKS) if (folder / OLD_LANDMARKS).exists() else []
        objects = _rows(folder / "objects.csv")
        upper = _numbers(landmarks, "cxx", "cxy", "cxz", "cyy", "cyz", "czz")
        located = [row for row in frames if row["sd_x"]]
        sd = _numbers(located, "sd_x", "sd_y", "sd_z", "sd_rotation")
        config, stamps = read_object(folder / "config.json"), {row["frame"]: float(row["stamp"]) for row in frames}
        final, truth = Trajectory.read_tum(folder / "trajectory_final.txt"), folder / "truth.txt"

        def pairs(column: str) -> np.ndarray:
            found = [(stamps[row["frame"]], stamps[row[column]]) for row in frames if (row[column] or "").isdigit()]
            rows = np.searchsorted(final.stamps, np.array(found, float).reshape(-1, 2) - 1e-9)
            return rows.clip(0, max(len(final) - 1, 0))

        summary = read_object(folder / "summary.json") if (folder / "summary.json").exists() else {}
        noise: dict[str, Any] = {key: float(value) for key, value in summary.get("truth", {}).items()}
        return cls(
            name=one_line(name),
            online=Trajectory.read_tum(folder / "trajectory.txt"),
            final=final,
            ids=_numbers(landmarks, "id")[:, 0].astype(np.int64),
            positions=_numbers(landmarks, *"xyz"),
            covariances=upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3),
            seen_last=_numbers(landmarks, "last_seen")[:, 0] == int(frames[-1]["frame"]),
            deviations=np.column_stack([np.linalg.norm(sd[:, :3], axis=1), np.degrees(sd[:, 3])]),
            measured=np.array([row["status"] in ("started", "tracked") for row in located], bool),
            status=[row["status"] for row in frames],
            milliseconds={stage: _numbers(frames, f"ms_{stage}")[:, 0] for stage in STAGES},
            truth=Trajectory.read_tum(truth) if truth.exists() else None,
            sequence=one_line(str(config["sequence"])),
            backend=one_line(str(config["backend"])),
            folder=folder,
            truth_noise=TruthNoise(**noise),
            truth_is_exact=config["format"] == "synthetic",
            loops=pairs("loop"),
            refused=pairs("refused"),
            old=_numbers(old, *"xyz"),
            bodies={
                body: _numbers([row for row in objects if row["id"] == body], *"xyz")
                for body in dict.fromkeys(row["id"] for row in objects)
            },
            summary=summary,
        )

    @property
    def centre(self) -> Array:
        """The middle of the online path (3,)."""
        return np.asarray(self.online.positions.mean(axis=0))

    @property
    def extent(self) -> float:
        """How far the path reaches [m]; of the scene where the camera hardly moved, or was lost."""
        distance = np.linalg.norm(self.positions - self.centre, axis=1)
        scene = 0.5 * float(np.median(distance)) if len(distance) else 0.0
        return max(float(np.ptp(self.online.positions, axis=0).max()), scene, 1.0)

    @property
    def reach(self) -> float:
        """Distance from the middle of the path up to which landmarks are shown [m]."""
        return 2.0 * self.extent + 3.0


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(read_text(path), newline="")))


def _numbers(rows: list[dict[str, str]], *columns: str) -> Array:
    """Columns of a table as numbers (N, C); NaN for an empty cell."""
    return np.array([[float(row[c] or "nan") for c in columns] for row in rows]).reshape(-1, len(columns))


def _paired(run: RunData) -> tuple[Trajectory, Trajectory]:
    """The online and the true path at common stamps, without poses of the truth that were not measured."""
    assert run.truth is not None
    own, true = associate(run.online, run.truth)
    rows = np.flatnonzero(~interpolated(true, run.truth_noise))
    return (own.select(rows), true.select(rows)) if len(rows) else (own, true)


def place_of_truth(run: RunData) -> Array:
    """Pose (4, 4) of the true path's world in the run's, in which both paths begin at the same position.

    An exact one is turned by the first pose. A recorded one is turned so that the whole paths fit: an error of its
    first orientation by some tenths of a degree would look like an error of the path that grows with the distance.
    """
    own, true = _paired(run)
    T = own.poses[0] @ inverse(true.poses[0])
    if not run.truth_is_exact:
        T[:3, :3] = alignment(true, own)[:3, :3]
    T[:3, 3] = own.positions[0] - T[:3, :3] @ true.positions[0]
    return T


def pose_errors(run: RunData) -> tuple[Array, Array, Array, Array]:
    """Time since the start (N,) [s], and of the online pose errors, the σ that is claimed, and the expected one.

    Of these (N, 2) the columns are the distance from the true position [m], see `place_of_truth`, and the angle of the
    rotation's error [deg]. Without a truth the errors are zero. A σ is that of all axes together; the expected one has
    that of the truth, too, as the NEES from the start has it.

    Errors count from the first pose whose truth was measured, and a claimed σ from the path's first pose. Where these
    differ, the σ since the former, which a run does not write, is the claimed one give or take that pose's own at most.
    """
    if run.truth is None:
        stamps = run.online.stamps
        return stamps - stamps[0], np.zeros((len(stamps), 2)), run.deviations, run.deviations
    own, true = _paired(run)
    off = np.linalg.norm(own.positions - transform(place_of_truth(run), true.positions), axis=1)
    turned = np.linalg.norm(rotation_errors(own, true, 0.0 if run.truth_is_exact else _TURNED), axis=1)
    first, last = np.zeros(len(own), np.intp), np.arange(len(own))
    A = adjoint(inverse(inverse(own.poses[first]) @ own.poses))
    P, J = truth_covariances(true, run.truth_noise, first, last, A), by_mounting(true, run.truth_noise, first, last, A)
    J = J[:, 3:, 3:]  # of positions, by the sensor's place and its clock; a constant turn is taken from the errors
    P[:, 3:, 3:] += J @ np.swapaxes(J, 1, 2)
    of_truth = np.column_stack([np.trace(P[:, i : i + 3, i : i + 3], axis1=1, axis2=2) for i in (3, 0)])
    claimed = run.deviations[np.searchsorted(run.online.stamps, own.stamps)]
    sigma = np.sqrt(claimed**2 + np.maximum(of_truth, 0.0) * [1, np.degrees(1) ** 2])
    return own.stamps - run.online.stamps[0], np.column_stack([off, np.degrees(turned)]), claimed, sigma


def well_known(run: RunData) -> np.ndarray:
    """Rows of landmarks that are well known and near the path, most recent last: others spoil a picture's scale."""
    size = np.sqrt(np.trace(run.covariances, axis1=1, axis2=2)) if len(run.positions) else np.zeros(0)
    distance = np.linalg.norm(run.positions - run.centre, axis=1)
    return np.flatnonzero((size < 0.2 * run.extent) & (distance < run.reach))
