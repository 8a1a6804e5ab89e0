"""What a run gave its back end, as data. Files: `slam.run.recording`; given again: `slam.run.replay`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from slam.calibration.model import Revision
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
class Recording:
    """All that a back end was given in a run, and what it takes to give it to another one.

    Attributes:
        name: of the sequence.
        rig: the cameras.
        models: noise, priors and motion that the run assumed.
        frames: what was given, frame by frame; their stamps increase.
        ground_truth: the left camera's true path, where it is known.
        kind: of motion, which chooses a back end's default options.

    Raises:
        MeasurementError: stamps do not increase, a value is not finite or far too large, or a landmark is observed or
            removed that is not in the map, or added that is.
    """

    name: str
    rig: StereoRig
    models: EstimatorModels
    frames: tuple[RecordedFrame, ...]
    ground_truth: Trajectory | None = None
    warnings: list[str] = field(default_factory=list)
    kind: str = "handheld"

    format: ClassVar[str] = "recording"

    def __post_init__(self) -> None:
        stamps = self.stamps
        if not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
            raise MeasurementError("recording: stamps must be finite and increase, with a number each")
        if len(stamps) and np.abs(stamps).max() > LATEST_STAMP:
            raise MeasurementError(f"recording: a stamp is beyond {LATEST_STAMP:g} s")
        known: set[int] = set()
        for frame in self.frames:
            known = _require_fits(frame, known)

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[RecordedFrame]:
        return iter(self.frames)

    @cached_property
    def stamps(self) -> Array:
        """Times of the frames (F,) [s]."""
        return np.array([frame.stamp for frame in self.frames], float)

    @cached_property
    def map_sizes(self) -> IdArray:
        """Number of landmarks in the map after each frame (F,)."""
        return np.cumsum([len(f.added) - len(f.removed) for f in self.frames], dtype=np.int64)

    @cached_property
    def first(self) -> int | None:
        """The first frame that adds landmarks; None where none does."""
        return next((k for k, frame in enumerate(self.frames) if len(frame.added)), None)

    def landmarks(self, frames: int) -> LandmarkTable:
        """The map after the first so many frames: how often each landmark was given, and when; no appearance."""
        seen, last, known = Counter[int](), dict[int, int](), set[int]()
        for k, frame in enumerate(self.frames[:frames]):
            given = [*frame.observed.ids.tolist(), *frame.added.ids.tolist()]
            seen.update(given)
            last.update(dict.fromkeys(given, k))
            known = (known | set(frame.added.ids.tolist())) - set(frame.removed.tolist())
        ids = np.array(sorted(known), np.int64)
        counts, latest = (np.array([by_id[i] for i in ids.tolist()], np.int64) for by_id in (seen, last))
        none, descriptors = np.zeros(len(ids), np.int64), np.zeros((len(ids), 0), np.float32)
        return LandmarkTable(ids, descriptors, none.astype(np.int8), counts, counts, none, latest)


def _require_fits(frame: RecordedFrame, known: set[int]) -> set[int]:
    """Raise where pixels or ids are none, or a frame does not fit the map before it; the map after it."""
    for what, rows in (("observed", frame.observed), ("added", frame.added)):
        if not np.isfinite(rows.uv_left).all():
            raise MeasurementError(f"recording: a left pixel of {what} is not finite")
        if (np.abs(rows.uv_left) > FARTHEST_PIXEL).any() or (np.abs(rows.uv_right) > FARTHEST_PIXEL).any():
            raise MeasurementError(f"recording: a pixel of {what} is far outside of any image")
        if len(rows) and (rows.ids.min() < 0 or rows.ids.max() > MOST_ID):
            raise MeasurementError(f"recording: ids of landmarks must go from 0 to {MOST_ID}")
    every = [ids.tolist() for ids in (frame.observed.ids, frame.added.ids, frame.removed)]
    seen, new, gone = map(set, every)
    for ids, own, what in zip(every, (seen, new, gone), ("observed", "added", "removed")):
        if len(own) < len(ids):
            raise MeasurementError(f"frame {frame.number}: a landmark stands twice in {what}")
    for wrong, words in (
        (seen - known, "is observed but not in the map"),
        (new & known, "is added but in the map already"),
        (gone - known - new, "is removed but not in the map"),
    ):
        if wrong:
            raise MeasurementError(f"frame {frame.number}: landmark {min(wrong)} {words}")
    return (known | new) - gone


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
    return Recording(name, rig, models, tuple(map(RecordedFrame.of, results)), ground_truth)
