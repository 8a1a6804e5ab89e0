"""What a run gave its back end, as data and as a file; given again: `slam.run.replay`.

A file is an .npz of plain arrays, without pickled objects, with a version.

Keys: ``header`` (JSON: ``format``, ``version``, ``name``, ``kind``, ``rig``, ``models``), ``numbers`` and ``stamps`` of
the frames (F), ``rows`` (M, 3) of whole numbers: the row of ``stamps``, what it is (0 observed, 1 added, 2 removed),
and the landmark's id, in the order in which they were given; ``pixels`` (M, 4): uL, vL, uR, vR. Where frames were
corrected again, ``corrections``: the parameters of the correction that each frame's pixels have (F, n). Where the true
path is known, ``truth_stamps`` and ``truth_poses``. Meanings: `Recording`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from slam.calibration.model import Revision, RigCorrection, RigModel
from slam.checks import FARTHEST_PIXEL, LATEST_STAMP, MOST_ID
from slam.data import FrameResult, IdArray, Observations
from slam.errors import MeasurementError, SequenceError, SlamError
from slam.files import Kind, json_text, read_bytes, require_arrays, unpack, whole_file
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.models import EstimatorModels, models_for
from slam.settings import with_changes

_HEADER = {"format": "surf-stereo-slam recording", "version": 3}
_LARGEST = 2**32  # bytes of a file

_FAR = 1e9  # guard: of other numbers
_ARRAYS = {
    "numbers": Kind(np.int64, "f", 0, MOST_ID), "stamps": Kind(np.float64, "f", -LATEST_STAMP, LATEST_STAMP),
    "rows": Kind(np.int64, "m3", 0, MOST_ID),
    "pixels": Kind(np.float64, "m4", -FARTHEST_PIXEL, FARTHEST_PIXEL, "unknown"),
}  # fmt: skip
_OPTIONAL = {
    "corrections": Kind(np.float64, "fn", -_FAR, _FAR), "truth_poses": Kind(np.float64, "t44", -_FAR, _FAR),
    "truth_stamps": Kind(np.float64, "t", -LATEST_STAMP, LATEST_STAMP),
}  # fmt: skip


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file is whole or not there.

    Raises:
        SequenceError: the file cannot be written.
    """
    r, rows, pixels = recording, [np.zeros((0, 3), np.int64)], [np.zeros((0, 4))]
    for k, frame in enumerate(r):
        for what, given in enumerate((frame.observed, frame.added)):
            rows.append(np.column_stack([np.full((len(given), 2), (k, what)), given.ids]))
            pixels.append(np.column_stack([given.uv_left, given.uv_right]))
        gone = len(frame.removed)
        rows.append(np.column_stack([np.full((gone, 2), (k, 2)), frame.removed]))
        pixels.append(np.full((gone, 4), np.nan))
    rig = {"left": asdict(r.rig.left), "right": asdict(r.rig.right), "R": r.rig.R.tolist(), "b": r.rig.b.tolist()}
    header = _HEADER | {"name": r.name, "kind": r.kind, "rig": rig, "models": asdict(r.models)}
    header["truth_noise"] = asdict(r.truth_noise)
    arrays: dict[str, Any] = {"header": json.dumps(header), "numbers": np.array([f.number for f in r], np.int64)}
    arrays |= {"stamps": r.stamps, "rows": np.concatenate(rows), "pixels": np.concatenate(pixels)}
    revisions = [frame.revision for frame in r]
    if first := next(filter(None, revisions), None):  # of each frame, the correction in force
        parameters = [first.before.parameters]
        for revision in revisions:
            parameters.append(parameters[-1] if revision is None else revision.after.parameters)
        arrays["corrections"] = np.array(parameters[1:])
    if r.ground_truth is not None:
        arrays.update(truth_stamps=r.ground_truth.stamps, truth_poses=r.ground_truth.poses)
    with whole_file(path, SequenceError) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises:
        SequenceError: the file is missing, no recording, of another version, or damaged.
    """
    content = read_bytes(path, _LARGEST, expected="a recording, which `slam run --record FILE.npz` leaves")
    if content.startswith(b"surf-stereo-slam map"):
        raise SequenceError(f"{path}: a saved map, which a run starts in with --map, no recording")
    arrays = unpack(content, str(path), error=SequenceError)
    try:
        return _recording(arrays)
    except KeyError as error:
        raise SequenceError(f"{path}: the recording lacks {error.args[0]!r}") from error
    except (SlamError, TypeError, ValueError, OverflowError, AttributeError, IndexError) as error:
        raise SequenceError(f"{path}: {error}") from error


def _recording(arrays: dict[str, np.ndarray]) -> Recording:
    header = json_text(str(arrays.get("header", "{}")), "header", SequenceError)
    if not isinstance(header, dict) or header.get("format") != _HEADER["format"]:
        raise SequenceError("is no recording")
    if header["version"] != _HEADER["version"]:
        raise SequenceError(f"is a recording of version {header['version']}; this one reads {_HEADER['version']}")
    kinds = _ARRAYS | {name: kind for name, kind in _OPTIONAL.items() if name in arrays}
    require_arrays(arrays, kinds, "recording", SequenceError)
    tree, models = header["rig"], with_changes(EstimatorModels(), header["models"])
    left, right = (PinholeCamera(**{**tree[s], "distortion": tuple(tree[s]["distortion"])}) for s in ("left", "right"))
    rig = StereoRig(left, right, np.array(tree["R"], float), np.array(tree["b"], float))
    models_for(header["kind"])
    if not isinstance(header["name"], str):
        raise SequenceError("its name is no text")
    truth = Trajectory(arrays["truth_stamps"], arrays["truth_poses"]) if "truth_stamps" in arrays else None
    frames = _frames(arrays, rig)
    noise = TruthNoise(**header.get("truth_noise", {}))
    return Recording(header["name"], rig, models, frames, truth, noise, kind=header["kind"])


def _frames(arrays: Mapping[str, np.ndarray], rig: StereoRig) -> tuple[RecordedFrame, ...]:
    numbers, stamps, rows, pixels = (arrays[key] for key in ("numbers", "stamps", "rows", "pixels"))
    count = len(stamps)
    place = 3 * rows[:, 0] + rows[:, 1]
    if (rows[:, 1] > 2).any() or (rows[:, 0] >= count).any() or (np.diff(place) < 0).any():
        raise SequenceError(f"frames of rows must ascend from 0 to {count - 1}")
    revisions: list[Revision | None] = [None] * count
    if "corrections" in arrays:
        corrections, model = arrays["corrections"], RigModel(rig)
        if corrections.shape[1] != len(model.names):
            raise SequenceError(f"corrections must have {len(model.names)} columns")
        every = [RigCorrection(model, row) for row in corrections]
        for k in np.flatnonzero((corrections[1:] != corrections[:-1]).any(axis=1)).tolist():
            revisions[k + 1] = Revision(every[k], every[k + 1])
    ends = np.searchsorted(place, np.arange(3 * count + 1)).tolist()
    frames = []
    for k, (a, b, c, d) in enumerate(zip(ends[:-1:3], ends[1::3], ends[2::3], ends[3::3])):
        seen, new = (Observations(rows[i:j, 2], pixels[i:j, :2], pixels[i:j, 2:]) for i, j in ((a, b), (b, c)))
        frames.append(RecordedFrame(int(numbers[k]), float(stamps[k]), seen, new, rows[c:d, 2], revisions[k]))
    return tuple(frames)


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
        """From what a step of the system did; `number` defaults to the step's, counted from its first."""
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
        truth_noise: how far it may be off.
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
    truth_noise: TruthNoise = field(default_factory=TruthNoise)
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


def _require_fits(frame: RecordedFrame, known: set[int]) -> set[int]:
    """Raise where ids are none, or a frame does not fit the map before it; the map after it."""
    for rows in (frame.observed, frame.added):
        if len(rows) and (rows.ids.min() < 0 or rows.ids.max() > MOST_ID):
            raise MeasurementError(f"recording: ids of landmarks must go from 0 to {MOST_ID}")
    seen, new, gone = (set(ids.tolist()) for ids in (frame.observed.ids, frame.added.ids, frame.removed))
    if len(seen) + len(new) + len(gone) < len(frame.observed) + len(frame.added) + len(frame.removed):
        raise MeasurementError(f"frame {frame.number}: a landmark stands twice in observed, added or removed")
    for wrong, words in (
        (seen - known, "is observed but not in the map"),
        (new & known, "is added but in the map already"),
        (gone - known - new, "is removed but not in the map"),
    ):
        if wrong:
            raise MeasurementError(f"frame {frame.number}: landmark {min(wrong)} {words}")
    return (known | new) - gone
