"""The figures of one run: gathered frame by frame, summed up at its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from slam.compare.frames import count_one
from slam.compare.measure import object_figures
from slam.data import FrameResult, FrameStatus, IdArray
from slam.errors import TrajectoryError
from slam.evaluation.association_truth import SurfacePoints, TrueWorld
from slam.evaluation.consistency import STRETCHES, stretch_nees
from slam.evaluation.metrics import associate, relative_errors
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.alignment import Alignment
from slam.geometry.se3 import Array, inverse, nearest_rotation, rotation_angle
from slam.geometry.stamps import pair
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.rig_error import CommonError
from slam.sequences import Sequence

_TOLERANCE = 0.02  # truth may lie so far from a frame in time [s]
_RIGHT = 3.0  # a feature so near to its landmark's true place is rightly associated [px]
_SECONDS = 1.0  # of RPE by time
_SAME = 1e-6  # stamps of one frame, one of them from a file, differ by less [s]

#: Frames without a measured pose, by key of `slam.compare.measure.UNTRACKED`.
_STATUSES = {
    "frames_lost": FrameStatus.LOST,
    "frames_predicted": FrameStatus.PREDICTED,
    "frames_failed": FrameStatus.FAILED,
}

SERIES_COLUMNS = (
    "frame", "stamp", "error_x", "error_y", "error_z", "sd_x", "sd_y", "sd_z", "error_rotation",
    "nees", "nis", "nis_dof", "map_size", "tracked",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Measured:
    """A finished run in numbers.

    Attributes:
        metrics: by key of `slam.compare.measure.METRICS`, and ``object …`` figures; what cannot be said of this
            sequence is left out.
        milliseconds: median per stage and ``total`` over all frames but the first.
        series: a row per frame that has a pose, of `SERIES_COLUMNS`; errors are NaN where there is no truth or the pose
            was not measured (``tracked`` is 0).
    """

    metrics: dict[str, float]
    milliseconds: dict[str, float]
    series: Array


@dataclass
class Collector:
    """Takes in the results of a run frame by frame.

    Frames whose pose was not measured (lost, predicted, failed) are counted, and left out of accuracy and consistency.

    Args:
        sequence: what is run.
        start: number of the first frame.
        score: check associations against the truth, where there is one. (Replayed ones are the same for all.)
    """

    sequence: Sequence
    start: int = 0
    score: bool = True

    def __post_init__(self) -> None:
        world = self.sequence if self.sequence.format == "synthetic" else None
        self._truth = None if world is None else SurfacePoints(cast(TrueWorld, world))
        self._frames: list[_Frame] = []
        self._lifetimes = Lifetimes()
        self._right = self._wrong = 0

    def add(self, result: FrameResult) -> None:
        """One more frame."""
        count_one()
        number, features, report = self.start + result.index, result.features, result.report
        if self._truth is not None:
            if self.score:
                errors = self._truth.errors(number, result.matched, features.uv_left[result.matched_features])
                self._right += int((errors < _RIGHT).sum())
                self._wrong += int((errors >= _RIGHT).sum())
            self._truth.add(number, result.added, features.uv_left[result.added_features])
        self._lifetimes.add(result)
        e = result.estimate
        self._frames.append(
            _Frame(
                number,
                e.stamp,
                e.T_world_left,
                e.covariance,
                result.status,
                report.nis,
                report.dof,
                len(report.used),
                result.map_size,
                dict(result.milliseconds),
                result.located,
                result.T_map_odom,
                result.common,
            )
        )

    def finish(self, final: Trajectory, ids: IdArray, positions: Array, summary: Mapping[str, Any]) -> Measured:
        """All figures.

        Args:
            final: the path as estimated at the end.
            ids: landmarks in the map at the end (N,).
            positions: where they are (N, 3) [m].
            summary: of the run, for what it says of objects; may be empty.
        """
        frames = [f for f in self._frames if f.located]
        if not frames:
            return Measured({}, {}, np.zeros((0, len(SERIES_COLUMNS))))
        online = Trajectory(np.array([f.stamp for f in frames]), np.array([f.pose for f in frames]))
        rows = np.array([f.tracked for f in frames])
        tracked = online.select(rows)
        final = final.select(pair(final.stamps, tracked.stamps, _SAME) >= 0)
        metrics = {
            **_accuracy(tracked, final, self.sequence),
            **_loop_figures(tracked, np.array([f.T_map_odom for f in frames])[rows], self.sequence, summary),
            **_consistency(tracked, self.sequence, frames),
            **self._landmark_errors(final, ids, positions),
            **self._map_figures(),
            **object_figures(summary),
        }
        metrics = {key: float(value) for key, value in metrics.items() if np.isfinite(value)}
        return Measured(metrics, _milliseconds(self._frames), _series(online, self.sequence, frames))

    def _landmark_errors(self, final: Trajectory, ids: IdArray, positions: Array) -> dict[str, float]:
        """Distances of the map's landmarks from the surface points they are, after the alignment of the poses."""
        pairs = _common(final, self.sequence)
        if self._truth is None or pairs is None or not len(ids):
            return {}
        errors = np.linalg.norm(_align_poses(*pairs).apply(positions) - self._truth.positions(ids), axis=1)
        errors = errors[np.isfinite(errors)]
        if not len(errors):
            return {}
        return {
            "landmark_error_m": float(np.median(errors)),
            "landmark_error_90_m": float(np.quantile(errors, 0.9)),
        }

    def _map_figures(self) -> dict[str, float]:
        """Share of the frames by status, size of the map, and lifetimes."""
        frames = self._frames
        scored = self._right + self._wrong
        return {
            "association_precision": self._right / scored if scored else float("nan"),
            "tracked": float(np.mean([f.tracked for f in frames])),
            **{key: float(np.mean([f.status is status for f in frames])) for key, status in _STATUSES.items()},
            "map_size": float(np.mean([f.map_size for f in frames])),
            **self._lifetimes.figures(),
            "used_per_frame": float(np.mean([f.used for f in frames])),
        }


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


@dataclass(frozen=True, eq=False)
class _Frame:
    """What is kept of one frame."""

    number: int
    stamp: float
    pose: Array
    covariance: Array
    status: FrameStatus
    nis: float
    dof: int
    used: int
    map_size: int
    milliseconds: dict[str, float]
    located: bool
    T_map_odom: Array
    common: CommonError

    @property
    def tracked(self) -> bool:
        """Whether the pose was measured."""
        return self.located and self.status.measured


def _common(path: Trajectory, sequence: Sequence) -> tuple[Trajectory, Trajectory] | None:
    """Estimated and true path at common stamps; None where fewer than 3 poses have truth."""
    if sequence.ground_truth is None or not len(path):
        return None
    try:
        own, true = associate(path, sequence.ground_truth, _TOLERANCE, interpolated=True)
    except TrajectoryError:  # nothing overlaps: no figure, which is no fault of the run
        return None
    return (own, true) if len(own) >= 3 else None


def _align_poses(own: Trajectory, true: Trajectory) -> Alignment:
    """The rigid motion that takes an estimated path to the true one, turned by its orientations.

    Positions alone would not do: those of a camera that hardly moves leave the turn open, which moves what is far away.
    """
    turns = true.poses[:, :3, :3] @ np.swapaxes(own.poses[:, :3, :3], 1, 2)
    R = nearest_rotation(turns.mean(axis=0))
    return Alignment(R, (true.positions - own.positions @ R.T).mean(axis=0), 1.0, 3)


def _accuracy(online: Trajectory, final: Trajectory, sequence: Sequence) -> dict[str, float]:
    """ATE, RPE by distance and by time, and the distance from a GPS track."""
    first, last = evaluate(online, sequence), evaluate(final, sequence)
    names = {
        "ate_online_m": first.get("ATE RMSE [m]"),
        "ate_final_m": last.get("ATE RMSE [m]"),
        "segment_percent": first.get("segment error [%]"),
        "gps_m": first.get("GPS distance RMSE [m]"),
    }
    figures = {key: value for key, value in names.items() if value is not None}
    pairs = _common(online, sequence)
    if pairs is not None:
        figures.update(_over_a_second(*pairs))
    return figures


def _loop_figures(
    online: Trajectory, T_map_odom: Array, sequence: Sequence, summary: Mapping[str, Any]
) -> dict[str, float]:
    """Loops closed and refused, and the error of the path as the back end has it, which knows of none."""
    loops = summary.get("loops")
    if not isinstance(loops, Mapping) or not loops["closed"] + loops["refused"]:
        return {}
    odometry = Trajectory(online.stamps, inverse(T_map_odom) @ online.poses)
    error = evaluate(odometry, sequence).get("ATE RMSE [m]", np.nan)
    return {"ate_without_loops_m": error, "loops_closed": loops["closed"], "loops_refused": loops["refused"]}


def _over_a_second(own: Trajectory, true: Trajectory) -> dict[str, float]:
    """RPE over as many frames as come nearest to a second; nothing for a shorter path."""
    delta = max(1, round(_SECONDS / float(np.median(np.diff(own.stamps)))))
    if len(own) <= delta:
        return {}
    errors = relative_errors(own, true, delta)
    return {"rpe_1s_m": errors.translation_statistics.rmse, "rpe_1s_deg": errors.rotation_statistics.rmse}


def _consistency(tracked: Trajectory, sequence: Sequence, frames: list[_Frame]) -> dict[str, float]:
    """NEES from the start and over stretches of the path, scale, and NIS; accuracy is that of tracked frames."""
    known = [f for f in frames if f.tracked]
    covariances, common = np.array([f.covariance for f in known]), [f.common for f in known]
    found = consistency(tracked, covariances, sequence, common) if known else {}
    names = {"nees_per_dof": "mean NEES"}
    names.update({f"nees_{length:g}m_per_dof": f"NEES over {length:g} m" for length in STRETCHES})
    figures = {key: found[name] / found["dof"] for key, name in names.items() if name in found}
    if "scale error [%]" in found:
        figures["scale_error_percent"] = abs(found["scale error [%]"])
        figures["scale_sigma_percent"] = found["scale sigma [%]"]
    dof = sum(f.dof for f in frames)
    if dof:
        figures["nis_per_dof"] = sum(f.nis for f in frames if f.dof) / dof
    return figures


def _milliseconds(frames: list[_Frame]) -> dict[str, float]:
    """Median per stage, and of their sum, over all frames but the first, which may wait for compilers."""
    later = [f.milliseconds for f in frames[1:]] or [frames[0].milliseconds]
    stages = list(dict.fromkeys(stage for m in later for stage in m))
    medians = {stage: float(np.median([m.get(stage, 0.0) for m in later])) for stage in stages}
    return {**medians, "total": float(np.median([sum(m.values()) for m in later]))}


def _series(online: Trajectory, sequence: Sequence, frames: list[_Frame]) -> Array:
    """Error, claimed deviations, NEES and NIS of every frame, relative to the first pose: rows of `SERIES_COLUMNS`."""
    rows = np.full((len(frames), len(SERIES_COLUMNS)), np.nan)
    rows[:, 0] = [f.number for f in frames]
    rows[:, 1] = online.stamps
    covariances = np.array([f.covariance for f in frames])
    R, P = online.poses[:, :3, :3], covariances[:, 3:, 3:]
    rows[:, 5:8] = np.sqrt(np.maximum(np.diagonal(R @ P @ np.swapaxes(R, 1, 2), axis1=1, axis2=2), 0))
    rows[:, 10:14] = [(f.nis, f.dof, f.map_size, f.tracked) for f in frames]
    tracked = np.flatnonzero([f.tracked for f in frames])
    pairs = _common(online.select(tracked), sequence)
    if pairs is None:
        return rows
    own, true = pairs
    at = np.searchsorted(online.stamps, own.stamps)
    expected = own.poses[0] @ inverse(true.poses[0]) @ true.poses
    rows[at, 2:5] = own.positions - expected[:, :3, 3]
    rows[at, 8] = rotation_angle(np.swapaxes(expected[:, :3, :3], 1, 2) @ own.poses[:, :3, :3])
    if len(at) > 1 and at[0] == tracked[0]:
        noise, common = getattr(sequence, "truth_noise", TruthNoise()), [frames[row].common for row in at]
        rows[at, 9] = _nees_from_start(own, true, covariances[at], noise, common)
    return rows


def _nees_from_start(
    own: Trajectory, true: Trajectory, covariances: Array, noise: TruthNoise, common: list[CommonError]
) -> Array:
    """NEES (N,) of each pose relative to the first; NaN for the first, and where a covariance is none."""
    values = np.full(len(own), np.nan)
    first = np.zeros(len(own) - 1, np.intp)
    values[1:] = stretch_nees(own, true, covariances, noise, first, np.arange(1, len(own)), common)
    return values
