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


def opencv_rig(
    paths: Sequence[Path], images: Size | None, unit: float = 1.0, rectified: bool = False, fisheye: bool = False
) -> tuple[StereoRig, Size]:
    """The rig of one or more files (such as intrinsics.yml and extrinsics.yml), and the image size they are for.

    The entries are two camera matrices, their distortions, and R and T as ``cv2.stereoCalibrate`` gives them
    (``h_right = R h_left + T``); or, for rectified images, the two projection matrices.

    Args:
        paths: the files.
        images: width and height of the images, used where the files name none; None where they are not known.
        unit: metres per unit of T and of the projections' last column.
        rectified: take the projection matrices, although camera matrices may be there too.
        fisheye: the distortion is ``cv2.fisheye``'s; also where the file names such a model.

    Raises:
        CalibrationError: a file is missing or unreadable, an entry is missing, or the rig is impossible.
    """
    entries: dict[str, Any] = {}
    for path in paths:
        entries.update(_read(path))
    with naming(paths[-1]):
        size = _size(entries) or images
        if size is None:
            raise CalibrationError("names no image size: give size=(width, height)")
        P = [_find(entries, _PROJECTION, side, (3, 4)) for side in (0, 1)]
        has_matrices = _find(entries, _MATRIX, 0, (3, 3)) is not None
        if rectified or (not has_matrices and P[0] is not None):
            if P[0] is None or P[1] is None:
                raise CalibrationError("no projection matrices (P1, P2) in it")
            scale = np.array([1, 1, 1, unit])
            return rig_from_projections(P[0] * scale, P[1] * scale, size), size
        fisheye = fisheye or str(_first(entries, _MODEL)).lower() in ("equidistant", "fisheye")
        cameras = [_camera(entries, side, size, fisheye) for side in (0, 1)]
        return rig_from_transform(cameras[0], cameras[1], _extrinsics(entries, unit)), size


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
    K = _find(entries, _MATRIX, side, (3, 3))
    if K is None:
        names = ", ".join(sorted(entries)) or "nothing"
        raise CalibrationError(f"no camera matrix of the {('left', 'right')[side]} camera in it (K1, K2), but {names}")
    return PinholeCamera.from_matrix(K, _find(entries, _DISTORTION, side, None), size, fisheye)


def _extrinsics(entries: dict[str, Any], unit: float) -> Array:
    """``T_right_left`` (4, 4) [m]; a rotation vector is accepted for R."""
    R, t = _first(entries, _ROTATION), _first(entries, _TRANSLATION)
    if R is None or t is None:
        raise CalibrationError("R and T, how the cameras stand to each other, are missing")
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
