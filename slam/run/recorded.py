"""What a run gave its back end, as data. Files: `slam.run.recording`; given again: `slam.run.replay`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.model import RigModel
from slam.checks import FARTHEST_PIXEL, LATEST_STAMP, MOST_ID
from slam.data import FrameResult, IdArray, Observations
from slam.errors import MeasurementError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels
from slam.tracks.table import LandmarkTable


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """What a back end was given in one frame.

    Attributes:
        number: of the frame in its sequence.
        stamp: time [s].
        observed: landmarks of the map, as measured.
        added: landmarks that joined the map, at their first sight.
        removed: ids of those that left it (R,).
        revision: before the frame, the pixels of all earlier ones were corrected again; None where they were not.
    """

    number: int
    stamp: float
    observed: Observations
    added: Observations
    removed: IdArray
    revision: Revision | None = None

    @classmethod
    def of(cls, result: FrameResult, number: int | None = None) -> RecordedFrame:
        """From what a step of the system did; `number` defaults to the step's."""
        f, seen, new = result.features, result.matched_features, result.added_features
        return cls(
            result.index if number is None else number,
            f.stamp,
            Observations(result.matched, f.uv_left[seen], f.uv_right[seen]),
            Observations(result.added, f.uv_left[new], f.uv_right[new]),
            result.erased,
            result.revision if isinstance(result.revision, Revision) else None,
        )


@dataclass(frozen=True, eq=False)
class RecordedRows:
    """Observations of many frames, a row each.

    Attributes:
        frame: row of the recording's stamps (M,), ascending.
        ids: landmark ids (M,).
        uv_left, uv_right: pixels (M, 2), `uv_right` NaN where there is no stereo match.
    """

    frame: IdArray
    ids: IdArray
    uv_left: Array
    uv_right: Array

    def __len__(self) -> int:
        return len(self.ids)

    def at(self, k: int) -> Observations:
        """Those of frame k."""
        rows = slice(*np.searchsorted(self.frame, [k, k + 1]))
        return Observations(self.ids[rows], self.uv_left[rows], self.uv_right[rows])

    @classmethod
    def of(cls, frames: Sequence[Observations]) -> RecordedRows:
        """Of each frame's observations."""
        none = Observations.empty()
        every = [none, *frames]
        return cls(
            np.repeat(np.arange(len(frames)), [len(o) for o in frames]),
            np.concatenate([o.ids for o in every]),
            np.concatenate([o.uv_left for o in every]),
            np.concatenate([o.uv_right for o in every]),
        )


@dataclass(frozen=True, eq=False)
class Recording:
    """All that a back end was given in a run, and what it takes to give it to another one.

    Attributes:
        name: of the sequence.
        rig: the cameras.
        models: noise, priors and motion that the run assumed.
        numbers: of the frames in their sequence (F,).
        stamps: times (F,) [s], increasing.
        observed: measurements of landmarks that the map had.
        added: first measurements of those that joined it.
        removed_frame, removed: row of `stamps`, ascending, and id of each landmark that left the map (R,).
        ground_truth: the left camera's true path, where it is known.
        corrections: parameters of the correction that each frame's pixels have, and all earlier frames' with it (F, n),
            see `slam.calibration`; None where nothing was ever corrected again.
        kind: of motion, which chooses a back end's default options.

    Raises:
        MeasurementError: arrays do not fit each other, stamps do not increase, or a value is not finite.
    """

    name: str
    rig: StereoRig
    models: EstimatorModels
    numbers: IdArray
    stamps: Array
    observed: RecordedRows
    added: RecordedRows
    removed_frame: IdArray
    removed: IdArray
    ground_truth: Trajectory | None = None
    warnings: list[str] = field(default_factory=list)
    corrections: Array | None = None
    kind: str = "handheld"

    format: ClassVar[str] = "recording"

    def __post_init__(self) -> None:
        count = len(self.stamps)
        if self.numbers.shape != (count,) or not np.isfinite(self.stamps).all() or (np.diff(self.stamps) <= 0).any():
            raise MeasurementError("recording: stamps must be finite and increase, with a number each")
        if count and np.abs(self.stamps).max() > LATEST_STAMP:
            raise MeasurementError(f"recording: a stamp is beyond {LATEST_STAMP:g} s")
        if self.corrections is not None:
            shape = count, len(RigModel(self.rig).names)
            if self.corrections.shape != shape or not np.isfinite(self.corrections).all():
                raise MeasurementError("recording: corrections must be finite, with a row for each stamp")
        if self.removed.shape != self.removed_frame.shape:
            raise MeasurementError("recording: removed and removed_frame differ in length")
        frames = {"observed": self.observed.frame, "added": self.added.frame, "removed": self.removed_frame}
        for what, frame in frames.items():
            if len(frame) and (frame[0] < 0 or frame[-1] >= count or (np.diff(frame) < 0).any()):
                raise MeasurementError(f"recording: frames of {what} must ascend from 0 to {count - 1}")
        for what, rows in (("observed", self.observed), ("added", self.added)):
            _check_rows(what, rows)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[RecordedFrame]:
        return (self.frame(k) for k in range(len(self)))

    def frame(self, k: int) -> RecordedFrame:
        """What was given in frame k."""
        gone = self.removed[slice(*np.searchsorted(self.removed_frame, [k, k + 1]))]
        number, stamp = int(self.numbers[k]), float(self.stamps[k])
        return RecordedFrame(number, stamp, self.observed.at(k), self.added.at(k), gone, self._revision(k))

    def _revision(self, k: int) -> Revision | None:
        """How frames before k are corrected again; None where they are not."""
        if self.corrections is None or not k or (self.corrections[k] == self.corrections[k - 1]).all():
            return None
        model = RigModel(self.rig)
        before, after = (RigCorrection(model, self.corrections[i]) for i in (k - 1, k))
        return Revision(before, after)

    def map_size(self, k: int) -> int:
        """Number of landmarks in the map after frame k."""
        added, removed = np.searchsorted(self.added.frame, k + 1), np.searchsorted(self.removed_frame, k + 1)
        return int(added - removed)

    def landmarks(self, frames: int) -> LandmarkTable:
        """The map after the first so many frames: how often each landmark was given, and when; no appearance."""
        ids, frame = (
            np.concatenate([getattr(rows, name) for rows in (self.added, self.observed)]) for name in ("ids", "frame")
        )
        ids, frame = ids[frame < frames], frame[frame < frames]
        unique, place, seen = np.unique(ids, return_inverse=True, return_counts=True)
        last = np.zeros(len(unique), np.int64)
        np.maximum.at(last, place, frame)
        kept = ~np.isin(unique, self._gone(frames))
        unique, seen, last = unique[kept], seen[kept], last[kept]
        none = np.zeros(len(unique), np.int64)
        descriptors = np.zeros((len(unique), 0), np.float32)
        return LandmarkTable(unique, descriptors, none.astype(np.int8), seen, seen, none, last)

    def _gone(self, frames: int) -> IdArray:
        """Ids of landmarks that left the map in the first so many frames, and did not come back after that."""
        left = dict(zip(self.removed[self.removed_frame < frames].tolist(), self.removed_frame.tolist()))
        came = self.added.frame < frames
        back = {i for i, k in zip(self.added.ids[came].tolist(), self.added.frame.tolist()) if k > left.get(i, k)}
        return np.array(sorted(set(left) - back), np.int64)

    @classmethod
    def of(
        cls,
        frames: Iterable[RecordedFrame],
        rig: StereoRig,
        models: EstimatorModels,
        name: str = "",
        ground_truth: Trajectory | None = None,
    ) -> Recording:
        """Of what was given frame by frame."""
        every = list(frames)
        return cls(
            name,
            rig,
            models,
            np.array([f.number for f in every], np.int64),
            np.array([f.stamp for f in every], float),
            RecordedRows.of([f.observed for f in every]),
            RecordedRows.of([f.added for f in every]),
            np.repeat(np.arange(len(every)), [len(f.removed) for f in every]),
            np.concatenate([np.zeros(0, np.int64), *(np.asarray(f.removed, np.int64) for f in every)]),
            ground_truth,
            corrections=_corrections(every),
        )


def _corrections(frames: Sequence[RecordedFrame]) -> Array | None:
    """Parameters of the correction in force in each frame (F, n); None where there never was a revision."""
    revisions = [f.revision for f in frames]
    first = next((r for r in revisions if r is not None), None)
    if first is None:
        return None
    rows = [first.before.parameters]
    for revision in revisions:
        rows.append(rows[-1] if revision is None else revision.after.parameters)
    return np.array(rows[1:])


def _check_rows(what: str, rows: RecordedRows) -> None:
    count = len(rows)
    if rows.frame.shape != (count,) or rows.uv_left.shape != (count, 2) or rows.uv_right.shape != (count, 2):
        raise MeasurementError(f"recording: arrays of {what} differ in length")
    if not np.isfinite(rows.uv_left).all():
        raise MeasurementError(f"recording: a left pixel of {what} is not finite")
    if (np.abs(rows.uv_left) > FARTHEST_PIXEL).any() or (np.abs(rows.uv_right) > FARTHEST_PIXEL).any():
        raise MeasurementError(f"recording: a pixel of {what} is far outside of any image")
    if count and (rows.ids.min() < 0 or rows.ids.max() > MOST_ID):
        raise MeasurementError(f"recording: ids of landmarks must go from 0 to {MOST_ID}")
    order = np.lexsort((rows.ids, rows.frame))
    frame, ids = rows.frame[order], rows.ids[order]
    twice = np.flatnonzero((np.diff(frame) == 0) & (np.diff(ids) == 0))
    if len(twice):
        raise MeasurementError(f"recording: landmark {ids[twice[0]]} stands twice in {what} of frame {frame[twice[0]]}")


def record(
    results: Iterable[FrameResult],
    rig: StereoRig,
    models: EstimatorModels,
    name: str = "",
    ground_truth: Trajectory | None = None,
) -> Recording:
    """What the back end was given in a run.

    Args:
        results: of all steps, from the first one on.
        rig: the cameras.
        models: noise, priors and motion that the run assumed.
        name: of the sequence.
        ground_truth: the left camera's true path, where it is known.
    """
    return Recording.of((RecordedFrame.of(result) for result in results), rig, models, name, ground_truth)
