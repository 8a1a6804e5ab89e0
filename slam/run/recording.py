"""Recordings as files: an .npz of plain arrays, without pickled objects, with a version.

Keys: ``format``, ``version``, ``name``, ``kind``, ``rig`` and ``models`` (JSON), ``numbers``, ``stamps``,
``observed_…`` and ``added_…`` (``frame``, ``ids``, ``uv_left``, ``uv_right``), ``removed_frame``, ``removed``, where
earlier frames were corrected again ``corrections``, and, where the true path is known, ``truth_stamps`` and
``truth_poses``. ``…frame`` are rows of ``stamps``, ascending; ``corrections`` are the parameters of the correction that
each frame's pixels have (F, n). Meanings: `slam.run.recorded.Recording`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slam.archives import array, json_text, unpack
from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.model import RigModel
from slam.data import IdArray, Observations
from slam.errors import SequenceError, SlamError
from slam.files import read_bytes, whole_file
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels, MotionModel, models_for
from slam.object_models import ObjectModels
from slam.run.recorded import RecordedFrame, Recording

_FORMAT = "surf-stereo-slam recording"
_VERSION = 2
_LARGEST = 2**32  # bytes of a file


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file is whole or not there.

    Raises:
        SequenceError: the file cannot be written.
    """
    r, frames = recording, recording.frames
    rig = {"left": asdict(r.rig.left), "right": asdict(r.rig.right), "R": r.rig.R.tolist(), "b": r.rig.b.tolist()}
    arrays: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "name": r.name,
        "kind": r.kind,
        "rig": json.dumps(rig),
        "models": json.dumps(asdict(r.models)),
        "numbers": np.array([f.number for f in frames], np.int64),
        "stamps": r.stamps,
        "removed_frame": np.repeat(np.arange(len(frames)), [len(f.removed) for f in frames]),
        "removed": np.concatenate([np.zeros(0, np.int64), *(np.asarray(f.removed, np.int64) for f in frames)]),
    }
    for what in ("observed", "added"):
        every = [getattr(f, what) for f in frames]
        arrays[f"{what}_frame"] = np.repeat(np.arange(len(every)), [len(o) for o in every])
        for key in ("ids", "uv_left", "uv_right"):
            parts = [getattr(o, key) for o in (Observations.empty(), *every)]
            arrays[f"{what}_{key}"] = np.concatenate(parts)
    corrections = _corrections(frames)
    if corrections is not None:
        arrays["corrections"] = corrections
    if r.ground_truth is not None:
        arrays.update(truth_stamps=r.ground_truth.stamps, truth_poses=r.ground_truth.poses)
    with whole_file(path, SequenceError) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises:
        SequenceError: the file is missing, no recording, of another version, or damaged.
    """
    members = unpack(read_bytes(path, _LARGEST), str(path), SequenceError)
    arrays = {name.removesuffix(".npy"): array(data, name, str(path), SequenceError) for name, data in members.items()}
    try:
        return _recording(arrays)
    except KeyError as error:
        raise SequenceError(f"{path}: the recording lacks {error.args[0]!r}") from error
    except (SlamError, TypeError, ValueError, OverflowError, AttributeError, IndexError) as error:
        raise SequenceError(f"{path}: {error}") from error


def _corrections(frames: Sequence[RecordedFrame]) -> Array | None:
    """Parameters of the correction in force in each frame (F, n); None where there never was a revision."""
    first = next((f.revision for f in frames if f.revision is not None), None)
    if first is None:
        return None
    rows = [first.before.parameters]
    for frame in frames:
        rows.append(rows[-1] if frame.revision is None else frame.revision.after.parameters)
    return np.array(rows[1:])


def _recording(arrays: Mapping[str, np.ndarray]) -> Recording:
    if str(arrays.get("format", "")) != _FORMAT:
        raise SequenceError("is no recording")
    version = arrays["version"]
    if version.ndim or version.dtype.kind not in "iu" or version != _VERSION:
        raise SequenceError(f"is a recording of version {version}; this program reads version {_VERSION}")
    truth = None
    if "truth_stamps" in arrays:
        truth = Trajectory(_array(arrays, "truth_stamps", 1, float), _array(arrays, "truth_poses", 3, float))
    rig = _rig(json_text(_word(arrays, "rig"), "rig", SequenceError))
    models = _models(json_text(_word(arrays, "models"), "models", SequenceError))
    kind = _word(arrays, "kind") if "kind" in arrays else "handheld"
    models_for(kind)
    return Recording(_word(arrays, "name"), rig, models, _frames(arrays, rig), truth, kind=kind)


def _frames(arrays: Mapping[str, np.ndarray], rig: StereoRig) -> tuple[RecordedFrame, ...]:
    """What was given in each frame."""
    numbers, stamps = _array(arrays, "numbers", 1, np.int64), _array(arrays, "stamps", 1, float)
    if len(numbers) != len(stamps):
        raise SequenceError("stamps must be finite and increase, with a number each")
    none = Observations.empty()
    observed, added = (
        [
            Observations(*cells) if len(cells[0]) else none
            for cells in _by_frame(arrays, len(stamps), what, ("ids", "uv_left", "uv_right"))
        ]
        for what in ("observed", "added")
    )
    removed = [cells[0] for cells in _by_frame(arrays, len(stamps), "removed", ("",))]
    revisions = _revisions(arrays, len(stamps), rig)
    return tuple(map(RecordedFrame, numbers.tolist(), stamps.tolist(), observed, added, removed, revisions))


def _by_frame(
    arrays: Mapping[str, np.ndarray], count: int, what: str, keys: Sequence[str]
) -> list[tuple[np.ndarray, ...]]:
    """Arrays of rows of all frames, taken apart by frame."""
    frame: IdArray = _array(arrays, f"{what}_frame", 1, np.int64)
    if len(frame) and (frame[0] < 0 or frame[-1] >= count or (np.diff(frame) < 0).any()):
        raise SequenceError(f"frames of {what} must ascend from 0 to {count - 1}")
    columns = []
    for key in keys:
        pixels = key.startswith("uv")
        name = f"{what}_{key}" if key else what
        columns.append(_array(arrays, name, 2 if pixels else 1, float if pixels else np.int64))
        if columns[-1].shape != ((len(frame), 2) if pixels else (len(frame),)):
            raise SequenceError(f"arrays of {what} differ in length")
    ends = np.searchsorted(frame, np.arange(count + 1)).tolist()
    return [tuple(column[a:b] for column in columns) for a, b in pairwise(ends)]


def _revisions(arrays: Mapping[str, np.ndarray], count: int, rig: StereoRig) -> list[Revision | None]:
    """How frames before each one are corrected again; None where they are not."""
    if "corrections" not in arrays:
        return [None] * count
    rows, model = _array(arrays, "corrections", 2, float), RigModel(rig)
    if rows.shape != (count, len(model.names)) or not np.isfinite(rows).all():
        raise SequenceError("corrections must be finite, with a row for each stamp")
    every = [RigCorrection(model, row) for row in rows]
    changed = [False, *(rows[1:] != rows[:-1]).any(axis=1).tolist()][:count]
    return [Revision(every[k - 1], every[k]) if new else None for k, new in enumerate(changed)]


def _word(arrays: Mapping[str, np.ndarray], key: str) -> str:
    """A text of the file."""
    value = arrays[key]
    if value.ndim or value.dtype.kind != "U":
        raise SequenceError(f"{key} is no text")
    return str(value)


def _array(arrays: Mapping[str, np.ndarray], key: str, dimensions: int, kind: type) -> np.ndarray:
    """An array of the file with the right number of dimensions and type."""
    array = arrays[key]
    if array.ndim != dimensions or array.dtype.kind not in ("iu" if kind is np.int64 else "f"):
        raise SequenceError(f"{key} is of type {array.dtype} with {array.ndim} dimensions")
    return array.astype(kind)


def _rig(tree: dict[str, Any]) -> StereoRig:
    left, right = (
        PinholeCamera(**{**tree[side], "distortion": tuple(tree[side]["distortion"])}) for side in ("left", "right")
    )
    return StereoRig(left, right, np.array(tree["R"], float), np.array(tree["b"], float))


def _models(tree: dict[str, Any]) -> EstimatorModels:
    nested = {"motion": MotionModel(**tree["motion"]), "objects": ObjectModels(**tree.get("objects", {}))}
    return EstimatorModels(**{**tree, **nested})
