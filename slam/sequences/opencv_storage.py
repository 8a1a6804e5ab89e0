"""OpenCV's calibration files (FileStorage: YAML, XML or JSON) to a rig, whatever the names of their entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, pose, so3_exp
from slam.sequences.calibration import (
    NO_NUMBERS,
    naming,
    require_possible,
    rig_from_projections,
    rig_from_transform,
)
from slam.sequences.images import Size
from slam.sequences.yaml_files import read_calibration, read_yaml

# Names as people have them, in lower case and without anything but letters and digits; {i} is 1 or 2, {s} is left or
# right, {l} is l or r. K1, M1, cameraMatrix1, camera_matrix_left, left_camera_matrix and LEFT.K are all found.
_OF_A_SIDE = ("{n}{i}", "{n}{s}", "{s}{n}", "{n}{l}")
_MATRIX = tuple(p.replace("{n}", n) for n in ("k", "m", "cameramatrix", "mtx", "intrinsics") for p in _OF_A_SIDE)
_DISTORTION = tuple(
    p.replace("{n}", n)
    for n in ("d", "distcoeffs", "dist", "distortion", "distortioncoeffs", "distortioncoefficients")
    for p in _OF_A_SIDE
)
_PROJECTION = tuple(p.replace("{n}", n) for n in ("p", "projectionmatrix", "projection") for p in _OF_A_SIDE)
_ROTATION = ("r", "rot", "rotation", "rotationmatrix", "stereor", "rstereo")
_TRANSLATION = ("t", "trans", "translation", "translationvector", "stereot", "tstereo")
_SIZES = (("imagewidth", "imageheight"), ("width", "height"), ("leftwidth", "leftheight"))
_SIZE = ("imagesize", "size", "imgsize", "resolution")
_MODEL = ("distortionmodel", "cameramodel", "model")
_PLAIN = ("fx", "fy", "cx", "cy", "baseline")  # all that a rectified pair of equal cameras needs


def opencv_rig(
    paths: Sequence[Path], images: Size | None, unit: float = 1.0, rectified: bool = False, fisheye: bool = False
) -> tuple[StereoRig, Size]:
    """The rig of one or more files (such as intrinsics.yml and extrinsics.yml), and the image size they are for.

    The entries are two camera matrices, their distortions, and R and T as ``cv2.stereoCalibrate`` gives them
    (``h_right = R h_left + T``); or, for rectified images, the two projection matrices, or the numbers fx, fy, cx, cy
    [px] and baseline.

    Args:
        paths: the files.
        images: width and height of the images, used where the files name none; None where they are not known.
        unit: metres per unit of T, of the projections' last column, and of the baseline.
        rectified: take the projection matrices, although camera matrices may be there too.
        fisheye: the distortion is ``cv2.fisheye``'s; also where the file names such a model.

    Raises:
        CalibrationError: a file is missing or unreadable, entries are missing (all are named), or the rig is
            impossible.
    """
    entries: dict[str, Any] = {}
    for path in paths:
        entries.update(_read(path))
    with naming(paths[-1]):
        size = _size(entries) or images
        if size is None:
            raise CalibrationError("names no image size: give size=(width, height)")
        K, P = ([_find(entries, kind, side, None) is not None for side in (0, 1)] for kind in (_MATRIX, _PROJECTION))
        if not any(K + P) and any(entries.get(name) is not None for name in _PLAIN):
            return _plain_rig(entries, size, unit), size
        if rectified or (any(P) and not K[0]):
            _require({"P1": P[0], "P2": P[1]}, entries)
            left, right = (_of_side(entries, _PROJECTION, side, (3, 4)) for side in (0, 1))
            scale = np.array([1, 1, 1, unit])
            return rig_from_projections(left * scale, right * scale, size), size
        R, T = (_first(entries, names) is not None for names in (_ROTATION, _TRANSLATION))
        _require({"K1": K[0], "K2": K[1], "R": R, "T": T}, entries)
        fisheye = fisheye or str(_first(entries, _MODEL)).lower() in ("equidistant", "fisheye")
        cameras = [_camera(entries, side, size, fisheye) for side in (0, 1)]
        return rig_from_transform(cameras[0], cameras[1], _extrinsics(entries, unit)), size


def _require(there: Mapping[str, bool], entries: Mapping[str, Any]) -> None:
    """Raise CalibrationError with the names of all entries that are not there, and of those that are."""
    missing = [name for name, found in there.items() if not found]
    if missing:
        verb, known = "is" if len(missing) == 1 else "are", ", ".join(sorted(entries)) or "nothing"
        raise CalibrationError(
            f"{', '.join(missing)} {verb} missing; in it: {known}. A stereo calibration "
            "has K1, D1, K2, D2, R and T; one of rectified images P1 and P2, or fx, fy, cx, cy and baseline"
        )


def _plain_rig(entries: Mapping[str, Any], size: Size, unit: float) -> StereoRig:
    """A rectified rig of two equal cameras by five numbers; `unit` is metres per unit of the baseline.

    Raises:
        CalibrationError: numbers are missing or impossible; all of them are named.
    """
    values, wrong = {}, []
    for name in _PLAIN:
        try:
            if isinstance(entries[name], bool):
                raise TypeError(name)
            values[name] = float(entries[name])
            require_possible(np.array([values[name]]), name)
        except KeyError:
            wrong.append(f"{name} is missing")
        except NO_NUMBERS:
            wrong.append(f"{name} is no number")
        except CalibrationError as error:
            wrong.append(str(error))
        else:
            if values[name] <= 0 and name not in ("cx", "cy"):
                wrong.append(f"{name} is {values[name]:g}, which must be positive")
    if wrong:
        raise CalibrationError(f"{'; '.join(wrong)} (a rectified pair needs fx, fy, cx, cy in pixels and baseline)")
    fx, fy, cx, cy, baseline = values.values()
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return StereoRig.from_pinhole(K, size=size, baseline=unit * baseline)


def _read(path: Path) -> dict[str, Any]:
    """All entries by their names in lower case, letters and digits only; matrices as ``{rows, cols, data}`` or lists.

    The files are read by the YAML and XML libraries: OpenCV's own reader can crash on a damaged one.
    """
    text = read_calibration(path).strip()
    root = _read_xml(path, text) if text.startswith("<") else read_yaml(path)
    return {"".join(filter(str.isalnum, str(k).lower())): value for k, value in root.items()}


def _read_xml(path: Path, text: str) -> dict[str, Any]:
    """The entries of a storage in XML: texts, and the parts of matrices."""
    if "<!" in text.replace("<!--", ""):  # OpenCV writes no entities, which may stand for gigabytes
        raise CalibrationError(f"{path}: a calibration has no document type and no entities")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path}, row {error.position[0]}: no valid XML") from error
    except ValueError as error:  # a declared encoding that is none
        raise CalibrationError(f"{path}: no valid XML") from error
    return {node.tag: {part.tag: part.text or "" for part in node} if len(node) else node.text or "" for node in root}


def _first(entries: dict[str, Any], names: Sequence[str]) -> Any:
    """The first entry of several names; None where there is none."""
    return next((entries[n] for n in names if entries.get(n) is not None), None)


def _find(entries: dict[str, Any], patterns: Sequence[str], side: int, shape: tuple[int, ...] | None) -> Array | None:
    """A camera's matrix by any of its names; None where there is none.

    Raises:
        CalibrationError: it is of another shape or not finite.
    """
    words = {"i": side + 1, "s": ("left", "right")[side], "l": "lr"[side]}
    names = [p.format(**words) for p in patterns]
    name = next((n for n in names if entries.get(n) is not None), None)
    return None if name is None else _matrix(entries[name], name, shape)


def _of_side(entries: dict[str, Any], patterns: Sequence[str], side: int, shape: tuple[int, ...]) -> Array:
    """A camera's matrix that is there."""
    found = _find(entries, patterns, side, shape)
    assert found is not None  # `_require` has seen it
    return found


def _matrix(value: Any, name: str, shape: tuple[int, ...] | None) -> Array:
    """A finite matrix of the shape; flat where that is None."""
    data = value.get("data") if isinstance(value, Mapping) else value
    try:
        matrix = np.array(data.split() if isinstance(data, str) else data, dtype=float)
        matrix = matrix.reshape(-1 if shape is None else shape)
    except NO_NUMBERS:
        raise CalibrationError(f"{name} is no matrix" + (f" of shape {shape}" if shape else "")) from None
    require_possible(matrix, name)
    return matrix


def _camera(entries: dict[str, Any], side: int, size: Size, fisheye: bool) -> PinholeCamera:
    """One camera from its matrix and its distortion."""
    K = _of_side(entries, _MATRIX, side, (3, 3))
    return PinholeCamera.from_matrix(K, _find(entries, _DISTORTION, side, None), size, fisheye)


def _extrinsics(entries: dict[str, Any], unit: float) -> Array:
    """``T_right_left`` (4, 4) [m]; a rotation vector is accepted for R."""
    R, t = _first(entries, _ROTATION), _first(entries, _TRANSLATION)
    rotation = _matrix(R, "R", None)
    rotation = so3_exp(rotation) if rotation.size == 3 else _matrix(R, "R", (3, 3))
    return pose(rotation, unit * _matrix(t, "T", (3,)))


def _size(entries: dict[str, Any]) -> Size | None:
    """Width and height, where the files name them."""
    for width, height in _SIZES:
        if entries.get(width) is not None and entries.get(height) is not None:
            return int(_matrix(entries[width], width, (1,))[0]), int(_matrix(entries[height], height, (1,))[0])
    both = _first(entries, _SIZE)
    if both is None:
        return None
    numbers = _matrix(both, "image size", (2,))
    return int(numbers[0]), int(numbers[1])
