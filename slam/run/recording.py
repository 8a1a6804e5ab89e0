"""Recordings as files: an .npz of plain arrays, without pickled objects, with a version.

Keys: ``format``, ``version``, ``name``, ``kind``, ``rig`` and ``models`` (JSON), ``numbers``, ``stamps``,
``observed_…`` and ``added_…`` (``frame``, ``ids``, ``uv_left``, ``uv_right``), ``removed_frame``, ``removed``, where
earlier frames were corrected again ``corrections``, and, where the true path is known, ``truth_stamps`` and
``truth_poses``. ``…frame`` are rows of ``stamps``, ascending; ``corrections`` are the parameters of the correction that
each frame's pixels have (F, n). Meanings: `slam.run.recorded.Recording`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slam.archives import array, json_text, unpack
from slam.calibration.correction import Revision, RigCorrection
from slam.calibration.model import RigModel
from slam.data import Observations
from slam.errors import SequenceError, SlamError
from slam.files import read_bytes, whole_file
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels, MotionModel, ObjectModels, models_for
from slam.run.recorded import RecordedFrame, Recording

_FORMAT = "surf-stereo-slam recording"
_VERSION = 2
_LARGEST = 2**32  # bytes of a file

#: Arrays of a file with their numbers of dimensions, of whole numbers and of others; the last ones may be missing.
_WHOLE = {"numbers": 1, "removed_frame": 1, "removed": 1, "observed_frame": 1, "observed_ids": 1, "added_frame": 1,
          "added_ids": 1}  # fmt: skip
_REAL = {"stamps": 1, "observed_uv_left": 2, "observed_uv_right": 2, "added_uv_left": 2, "added_uv_right": 2,
         "corrections": 2, "truth_stamps": 1, "truth_poses": 3}  # fmt: skip
_OPTIONAL = ("corrections", "truth_stamps", "truth_poses")


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
    revisions = [f.revision for f in frames]
    first = next((revision for revision in revisions if revision is not None), None)
    if first is not None:  # of each frame, the correction in force
        rows = [first.before.parameters]
        for revision in revisions:
            rows.append(rows[-1] if revision is None else revision.after.parameters)
        arrays["corrections"] = np.array(rows[1:])
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


def _recording(arrays: dict[str, np.ndarray]) -> Recording:
    if str(arrays.get("format", "")) != _FORMAT:
        raise SequenceError("is no recording")
    version = arrays["version"]
    if version.ndim or version.dtype.kind not in "iu" or version != _VERSION:
        raise SequenceError(f"is a recording of version {version}; this program reads version {_VERSION}")
    for key, dimensions in (_WHOLE | _REAL).items():
        if key in _OPTIONAL and key not in arrays:
            continue
        found, whole = arrays[key], key in _WHOLE
        if found.ndim != dimensions or found.dtype.kind not in ("iu" if whole else "f"):
            raise SequenceError(f"{key} is of type {found.dtype} with {found.ndim} dimensions")
        arrays[key] = found.astype(np.int64 if whole else float)
    texts = {"name": arrays["name"], "rig": arrays["rig"], "models": arrays["models"], "kind": arrays.get("kind")}
    for key, text in texts.items():
        if text is not None and (text.ndim or text.dtype.kind != "U"):
            raise SequenceError(f"{key} is no text")
    tree = json_text(str(texts["rig"]), "rig", SequenceError)
    left, right = (
        PinholeCamera(**{**tree[side], "distortion": tuple(tree[side]["distortion"])}) for side in ("left", "right")
    )
    rig = StereoRig(left, right, np.array(tree["R"], float), np.array(tree["b"], float))
    tree = json_text(str(texts["models"]), "models", SequenceError)
    nested = {"motion": MotionModel(**tree["motion"]), "objects": ObjectModels(**tree.get("objects", {}))}
    kind = "handheld" if texts["kind"] is None else str(texts["kind"])
    models_for(kind)
    truth = Trajectory(arrays["truth_stamps"], arrays["truth_poses"]) if "truth_stamps" in arrays else None
    frames = _frames(arrays, rig)
    return Recording(str(texts["name"]), rig, EstimatorModels(**{**tree, **nested}), frames, truth, kind=kind)


def _frames(arrays: Mapping[str, np.ndarray], rig: StereoRig) -> tuple[RecordedFrame, ...]:
    """What was given in each frame."""
    numbers, stamps = arrays["numbers"], arrays["stamps"]
    if len(numbers) != len(stamps):
        raise SequenceError("stamps must be finite and increase, with a number each")
    none = Observations.empty()
    observed, added = (
        [
            Observations(*cells) if len(cells[0]) else none
            for cells in _by_frame(arrays, what, (f"{what}_ids", f"{what}_uv_left", f"{what}_uv_right"))
        ]
        for what in ("observed", "added")
    )
    removed = [cells[0] for cells in _by_frame(arrays, "removed", ("removed",))]
    revisions = _revisions(arrays, len(stamps), rig)
    return tuple(map(RecordedFrame, numbers.tolist(), stamps.tolist(), observed, added, removed, revisions))


def _by_frame(arrays: Mapping[str, np.ndarray], what: str, keys: tuple[str, ...]) -> Iterator[tuple[np.ndarray, ...]]:
    """Arrays of rows of all frames, taken apart by frame."""
    count, frame = len(arrays["stamps"]), arrays[f"{what}_frame"]
    if len(frame) and (frame[0] < 0 or frame[-1] >= count or (np.diff(frame) < 0).any()):
        raise SequenceError(f"frames of {what} must ascend from 0 to {count - 1}")
    if any(arrays[key].shape not in ((len(frame),), (len(frame), 2)) for key in keys):
        raise SequenceError(f"arrays of {what} differ in length")
    for a, b in pairwise(np.searchsorted(frame, np.arange(count + 1)).tolist()):
        yield tuple(arrays[key][a:b] for key in keys)


def _revisions(arrays: Mapping[str, np.ndarray], count: int, rig: StereoRig) -> list[Revision | None]:
    """How frames before each one are corrected again; None where they are not."""
    if "corrections" not in arrays:
        return [None] * count
    rows, model = arrays["corrections"], RigModel(rig)
    if rows.shape != (count, len(model.names)) or not np.isfinite(rows).all():
        raise SequenceError("corrections must be finite, with a row for each stamp")
    every = [RigCorrection(model, row) for row in rows]
    changed = [False, *(rows[1:] != rows[:-1]).any(axis=1).tolist()][:count]
    return [Revision(every[k - 1], every[k]) if new else None for k, new in enumerate(changed)]
