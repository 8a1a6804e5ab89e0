"""Recordings as files: an .npz of plain arrays, without pickled objects, with a version.

Keys: ``format``, ``version``, ``name``, ``kind``, ``rig`` and ``models`` (JSON), ``numbers``, ``stamps``,
``observed_…`` and ``added_…`` (``frame``, ``ids``, ``uv_left``, ``uv_right``), ``removed_frame``, ``removed``, where
earlier frames were corrected again ``corrections``, and, where the true path is known, ``truth_stamps`` and
``truth_poses``. Meanings: `slam.run.recorded.Recording`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from slam.archives import array, json_text, unpack
from slam.errors import SequenceError, SlamError
from slam.files import read_bytes, whole_file
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels, MotionModel, models_for
from slam.object_models import ObjectModels
from slam.run.recorded import RecordedRows, Recording

_FORMAT = "surf-stereo-slam recording"
_VERSION = 2
_LARGEST = 2**32  # bytes of a file
_OBSERVED, _ADDED, _REMOVED = 0, 1, 2
_ROWS = ("frame", "ids", "uv_left", "uv_right")


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file is whole or not there.

    Raises:
        SequenceError: the file cannot be written.
    """
    r = recording
    arrays: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "name": r.name,
        "kind": r.kind,
        "rig": json.dumps(_rig_tree(r.rig)),
        "models": json.dumps(asdict(r.models)),
        "numbers": r.numbers,
        "stamps": r.stamps,
        "removed_frame": r.removed_frame,
        "removed": r.removed,
    }
    for what, rows in (("observed", r.observed), ("added", r.added)):
        arrays.update({f"{what}_{key}": getattr(rows, key) for key in _ROWS})
    if r.corrections is not None:
        arrays["corrections"] = r.corrections
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


def _recording(arrays: Mapping[str, np.ndarray]) -> Recording:
    if str(arrays.get("format", "")) != _FORMAT:
        raise SequenceError("is no recording")
    version = arrays["version"]
    if version.ndim or version.dtype.kind not in "iu" or version != _VERSION:
        raise SequenceError(f"is a recording of version {version}; this program reads version {_VERSION}")
    truth = None
    if "truth_stamps" in arrays:
        truth = Trajectory(_array(arrays, "truth_stamps", 1, float), _array(arrays, "truth_poses", 3, float))
    recording = Recording(
        _word(arrays, "name"),
        _rig(json_text(_word(arrays, "rig"), "rig", SequenceError)),
        _models(json_text(_word(arrays, "models"), "models", SequenceError)),
        _array(arrays, "numbers", 1, np.int64),
        _array(arrays, "stamps", 1, float),
        _rows(arrays, "observed"),
        _rows(arrays, "added"),
        _array(arrays, "removed_frame", 1, np.int64),
        _array(arrays, "removed", 1, np.int64),
        truth,
        corrections=_array(arrays, "corrections", 2, float) if "corrections" in arrays else None,
        kind=_word(arrays, "kind") if "kind" in arrays else "handheld",
    )
    models_for(recording.kind)
    require_lives(recording)
    return recording


def _word(arrays: Mapping[str, np.ndarray], key: str) -> str:
    """A text of the file."""
    value = arrays[key]
    if value.ndim or value.dtype.kind != "U":
        raise SequenceError(f"{key} is no text")
    return str(value)


def _rows(arrays: Mapping[str, np.ndarray], what: str) -> RecordedRows:
    return RecordedRows(
        _array(arrays, f"{what}_frame", 1, np.int64),
        _array(arrays, f"{what}_ids", 1, np.int64),
        _array(arrays, f"{what}_uv_left", 2, float),
        _array(arrays, f"{what}_uv_right", 2, float),
    )


def _array(arrays: Mapping[str, np.ndarray], key: str, dimensions: int, kind: type) -> np.ndarray:
    """An array of the file with the right number of dimensions and type."""
    array = arrays[key]
    if array.ndim != dimensions or array.dtype.kind not in ("iu" if kind is np.int64 else "f"):
        raise SequenceError(f"{key} is of type {array.dtype} with {array.ndim} dimensions")
    return array.astype(kind)


def require_lives(recording: Recording) -> None:
    """Check that every landmark is added before it is observed or removed, and not twice.

    Each landmark's events are put in order (observed, added, removed within a frame): additions and removals must take
    turns, and what comes before an observation must be an addition.

    Raises:
        SequenceError: one is not.
    """
    r = recording
    parts = ((r.observed.frame, r.observed.ids), (r.added.frame, r.added.ids), (r.removed_frame, r.removed))
    frame, ids = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    what = np.repeat([_OBSERVED, _ADDED, _REMOVED], [len(part[0]) for part in parts])
    order = np.lexsort((what, frame, ids))
    frame, ids, what = frame[order], ids[order], what[order]
    row = np.arange(len(ids))
    changes = np.where(what == _OBSERVED, -1, row)  # row of the last change at or before each
    before = np.concatenate([[-1], np.maximum.accumulate(changes)[:-1]]) if len(row) else row
    same = (before >= 0) & (ids[before] == ids)
    in_map = same & (what[before] == _ADDED)
    bad = np.where(what == _ADDED, in_map, ~in_map)
    if bad.any():
        k = int(np.argmin(np.where(bad, frame, np.iinfo(np.int64).max)))
        said = {_OBSERVED: "is observed but not in the map", _ADDED: "is added but in the map already"}
        wrong = said.get(int(what[k]), "is removed but not in the map")
        raise SequenceError(f"frame {frame[k]}: landmark {ids[k]} {wrong}")


def _rig_tree(rig: StereoRig) -> dict[str, Any]:
    return {"left": asdict(rig.left), "right": asdict(rig.right), "R": rig.R.tolist(), "b": rig.b.tolist()}


def _rig(tree: dict[str, Any]) -> StereoRig:
    return StereoRig(
        _camera(tree["left"]), _camera(tree["right"]), np.array(tree["R"], float), np.array(tree["b"], float)
    )


def _camera(tree: dict[str, Any]) -> PinholeCamera:
    return PinholeCamera(**{**tree, "distortion": tuple(tree["distortion"])})


def _models(tree: dict[str, Any]) -> EstimatorModels:
    nested = {"motion": MotionModel(**tree["motion"]), "objects": ObjectModels(**tree.get("objects", {}))}
    return EstimatorModels(**{**tree, **nested})
