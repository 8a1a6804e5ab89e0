"""What only a comparison asks of a run, frame by frame: landmarks against the truth, lifetimes, time series."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.data import FrameResult, IdArray
from slam.evaluation.association_truth import SurfacePoints
from slam.evaluation.consistency import stretch_nees
from slam.evaluation.summary import with_truth
from slam.geometry.alignment import Alignment
from slam.geometry.se3 import Array, inverse, nearest_rotation, rotation_angle
from slam.geometry.stamps import pair
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.results import figures
from slam.run.summary import RunRecord
from slam.sequences import Sequence

_RIGHT = 3.0  # a feature so near to its landmark's true place is rightly associated [px]
_SAME = 1e-6  # stamps of one frame, one of them from a file, differ by less [s]

SERIES_COLUMNS = (
    "frame", "stamp", "error_x", "error_y", "error_z", "sd_x", "sd_y", "sd_z", "error_rotation",
    "nees", "nis", "nis_dof", "map_size", "tracked",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Measured:
    """A finished run in numbers.

    Attributes:
        metrics: by key of `slam.run.results.METRICS`, and ``object …`` figures; what cannot be said of this
            sequence is left out.
        milliseconds: median per stage and ``total`` over all frames but the first.
        series: a row per frame that has a pose, of `SERIES_COLUMNS`; errors are NaN where there is no truth or the pose
            was not measured (``tracked`` is 0).
    """

    metrics: dict[str, float]
    milliseconds: dict[str, float]
    series: Array


class Collector:
    """Takes in the results of a run frame by frame.

    Args:
        sequence: what is run.
        start: number of the first frame.
        score: check associations against the truth, where there is one. (Replayed ones are the same for all.)
    """

    def __init__(self, sequence: Sequence, start: int = 0, score: bool = True) -> None:
        self.sequence, self.start, self.score = sequence, start, score
        self._truth = SurfacePoints(sequence) if sequence.format == "synthetic" else None
        self._record, self._lifetimes = RunRecord(), Lifetimes()
        self._rows: list[tuple[float, ...]] = []  # NIS, its degrees of freedom, and map size of frames with a pose
        self._sizes: list[int] = []
        self._right = self._wrong = 0

    def add(self, result: FrameResult) -> None:
        """One more frame."""
        number, features = self.start + result.index, result.features
        if self._truth is not None:
            if self.score:
                errors = self._truth.errors(number, result.matched, features.uv_left[result.matched_features])
                self._right += int((errors < _RIGHT).sum())
                self._wrong += int((errors >= _RIGHT).sum())
            self._truth.add(number, result.added, features.uv_left[result.added_features])
        self._lifetimes.add(result)
        self._record.add(number, result)
        self._sizes.append(result.map_size)
        if result.located:
            self._rows.append((number, result.report.nis, result.report.dof, result.map_size))

    def finish(self, final: Trajectory, ids: IdArray, positions: Array, summary: Mapping[str, Any]) -> Measured:
        """All figures.

        Args:
            final: the path as estimated at the end.
            ids: landmarks in the map at the end (N,).
            positions: where they are (N, 3) [m].
            summary: of the run.
        """
        online = self._record.trajectory
        tracked = online.select(np.array(self._record.measured, bool))
        final = final.select(pair(final.stamps, tracked.stamps, _SAME) >= 0)
        metrics = {**figures(summary), **self._landmark_errors(final, ids, positions), **self._lifetimes.figures()}
        if self._right + self._wrong:
            metrics["association_precision"] = self._right / (self._right + self._wrong)
        if self._sizes:
            metrics["map_size"] = float(np.mean(self._sizes))
        times = summary.get("milliseconds", {})
        milliseconds = {stage: value for stage, value in times.get("median", {}).items() if value}
        milliseconds |= {"total": times["median_total"]} if times else {}
        metrics = {key: float(value) for key, value in metrics.items() if np.isfinite(value)}
        return Measured(metrics, milliseconds, self._series(online))

    def _landmark_errors(self, final: Trajectory, ids: IdArray, positions: Array) -> dict[str, float]:
        """Distances of the map's landmarks from the surface points they are, after the alignment of the poses."""
        pairs = with_truth(final, self.sequence)
        if self._truth is None or pairs is None or not len(ids):
            return {}
        errors = np.linalg.norm(_align_poses(*pairs).apply(positions) - self._truth.positions(ids), axis=1)
        errors = errors[np.isfinite(errors)]
        if not len(errors):
            return {}
        return {"landmark_error_m": float(np.median(errors)), "landmark_error_90_m": float(np.quantile(errors, 0.9))}

    def _series(self, online: Trajectory) -> Array:
        """Error, claimed deviations, NEES and NIS of every frame, relative to the first pose."""
        record = self._record
        rows = np.full((len(online), len(SERIES_COLUMNS)), np.nan)
        if not len(rows):
            return rows
        covariances, measured = np.array(record.covariances), np.array(record.measured, bool)
        R, P = online.poses[:, :3, :3], covariances[:, 3:, 3:]
        rows[:, [0, 10, 11, 12]], rows[:, 1], rows[:, 13] = self._rows, online.stamps, measured
        rows[:, 5:8] = np.sqrt(np.maximum(np.diagonal(R @ P @ np.swapaxes(R, 1, 2), axis1=1, axis2=2), 0))
        pairs = with_truth(online.select(measured), self.sequence)
        if pairs is None:
            return rows
        own, true = pairs
        at = np.searchsorted(online.stamps, own.stamps)
        expected = own.poses[0] @ inverse(true.poses[0]) @ true.poses
        rows[at, 2:5] = own.positions - expected[:, :3, 3]
        rows[at, 8] = rotation_angle(np.swapaxes(expected[:, :3, :3], 1, 2) @ own.poses[:, :3, :3])
        if at[0] == np.flatnonzero(measured)[0]:
            noise = getattr(self.sequence, "truth_noise", TruthNoise())
            first, others = np.zeros(len(at) - 1, np.intp), np.arange(1, len(at))
            common = [record.common[row] for row in at]
            rows[at[1:], 9] = stretch_nees(own, true, covariances[at], noise, first, others, common)
        return rows


class Lifetimes:
    """How long landmarks stay in the map; those still in it have lived until the last frame."""

    def __init__(self) -> None:
        self._first: dict[int, int] = {}
        self._ended: list[int] = []
        self._last = 0

    def add(self, result: FrameResult) -> None:
        """One more frame."""
        self._last = result.index
        for i in (*result.added.tolist(), *result.returned.tolist()):
            self._first.setdefault(i, result.index)
        for i in result.erased.tolist():
            if i in self._first:  # else one of an old place, by which a kidnapped camera was found
                self._ended.append(result.index - self._first.pop(i))

    def figures(self) -> dict[str, float]:
        """Median and mean in frames; none where there was no landmark."""
        lived = [*self._ended, *(self._last - first for first in self._first.values())]
        if not lived:
            return {}
        return {"lifetime_frames": float(np.median(lived)), "lifetime_mean_frames": float(np.mean(lived))}


def _align_poses(own: Trajectory, true: Trajectory) -> Alignment:
    """The rigid motion that takes an estimated path to the true one, turned by its orientations.

    Positions alone would not do: those of a camera that hardly moves leave the turn open, which moves what is far away.
    """
    turns = true.poses[:, :3, :3] @ np.swapaxes(own.poses[:, :3, :3], 1, 2)
    R = nearest_rotation(turns.mean(axis=0))
    return Alignment(R, (true.positions - own.positions @ R.T).mean(axis=0), 1.0, 3)
