"""Recordings as files: an .npz of plain arrays, without pickled objects, with a version.

Keys: ``format``, ``version``, ``name``, ``kind``, ``rig`` and ``models`` (JSON), ``numbers``, ``stamps``,
``observed_…`` and ``added_…`` (``frame``, ``ids``, ``uv_left``, ``uv_right``), ``removed_frame``, ``removed``, where
earlier frames were corrected anew ``corrections``, and, where the true path is known, ``truth_stamps`` and
``truth_poses``. Meanings: `slam.run.replay.Recording`.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import SequenceError, SlamError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels, MotionModel
from slam.object_models import ObjectModels
from slam.run.replay import RecordedRows, Recording

_FORMAT = "surf-stereo-slam recording"
_VERSION = 2
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
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise SequenceError(f"{path}: cannot be written: {error.strerror or error}") from error


def load_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises:
        SequenceError: the file is missing, no recording, of another version, or damaged.
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    except (OSError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise SequenceError(f"{path}: cannot be read as a recording: {_one_line(error)}") from error
    try:
        return _recording(arrays)
    except KeyError as error:
        raise SequenceError(f"{path}: the recording lacks {error.args[0]!r}") from error
    except (SlamError, TypeError, ValueError) as error:
        raise SequenceError(f"{path}: {_one_line(error)}") from error


def _recording(arrays: Mapping[str, np.ndarray]) -> Recording:
    if str(arrays.get("format")) != _FORMAT:
        raise SequenceError("is no recording")
    version = int(arrays["version"])
    if version != _VERSION:
        raise SequenceError(f"is a recording of version {version}; this program reads version {_VERSION}")
    truth = None
    if "truth_stamps" in arrays:
        truth = Trajectory(_array(arrays, "truth_stamps", 1, float), _array(arrays, "truth_poses", 3, float))
    recording = Recording(
        str(arrays["name"]),
        _rig(json.loads(str(arrays["rig"]))),
        _models(json.loads(str(arrays["models"]))),
        _array(arrays, "numbers", 1, np.int64),
        _array(arrays, "stamps", 1, float),
        _rows(arrays, "observed"),
        _rows(arrays, "added"),
        _array(arrays, "removed_frame", 1, np.int64),
        _array(arrays, "removed", 1, np.int64),
        truth,
        corrections=_array(arrays, "corrections", 2, float) if "corrections" in arrays else None,
        kind=str(arrays.get("kind", "handheld")),
    )
    _check_lives(recording)
    return recording


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


def _check_lives(recording: Recording) -> None:
    """Every landmark is added before it is observed or removed, and not twice."""
    known: set[int] = set()
    for k, frame in enumerate(recording):
        for what, ids in (("observed", frame.observed.ids), ("removed", frame.removed)):
            unknown = set(ids.tolist()) - known - (set(frame.added.ids.tolist()) if what == "removed" else set())
            if unknown:
                raise SequenceError(f"frame {k}: landmark {min(unknown)} is {what} but not in the map")
        again = known.intersection(frame.added.ids.tolist())
        if again:
            raise SequenceError(f"frame {k}: landmark {min(again)} is added but in the map already")
        known.update(frame.added.ids.tolist())
        known.difference_update(frame.removed.tolist())


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


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
