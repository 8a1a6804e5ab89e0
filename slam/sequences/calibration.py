"""Calibration files of all forms as nested entries, and the matrices in them.

Files may be hostile: YAML is bounded in depth and read without aliases and tags, XML without entities.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from slam.errors import CalibrationError
from slam.files import read_text
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, pose
from slam.sequences.images import Size, size_text

#: What making an array of numbers raises where the values are none: text, ragged lists, numbers of 400 digits.
NO_NUMBERS = (ValueError, TypeError, OverflowError)

_ZED_SIZES = {"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "SVGA": (960, 600),
              "VGA": (672, 376)}  # fmt: skip
_KITTI = re.compile(r"^(P|P_rect_0)0[: ]", re.MULTILINE)
_NO_TEXT = (".npz", ".npy", ".pkl", ".mat")  # of NumPy, Python and MATLAB
_DEEPEST = 32  # of nested entries
_MOST = 1e9  # numbers of a calibration are smaller than this; larger ones overflow in what is made of them
_LIMIT = 4 * 2**20  # most bytes of a file: OpenCV's sample programs keep all corners of all images in it


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the file's name before the message of a calibration fault."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def read_calibration(path: Path) -> str:
    """A calibration file's text; CalibrationError where it is missing, cannot be read, or is too large for one."""
    if not path.exists():
        raise CalibrationError(f"{path}: the calibration is missing")
    return read_text(path, _LIMIT, CalibrationError)


def array(value: Any, name: str, shape: tuple[int, ...] | None) -> Array:
    """A finite array of the shape, flat where that is None; CalibrationError where it is none, or too large.

    Numbers may be texts. OpenCV's matrices are ``{rows, cols, data}``.
    """
    data = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array(data.split() if isinstance(data, str) and shape != () else data, dtype=float)
        numbers = numbers.reshape(-1 if shape is None else shape)
    except NO_NUMBERS:
        what = "no number" if shape == () else "no matrix" + (f" of shape {shape}" if shape else "")
        raise CalibrationError(f"{name} is {what}") from None
    if not np.isfinite(numbers).all():
        raise CalibrationError(f"{name} is not finite: {numbers.tolist()}")
    if np.abs(numbers).max(initial=0) > _MOST:
        raise CalibrationError(f"{name} is impossibly large: {numbers.tolist()}")
    return numbers


def rigid(T: Array, name: str) -> Array:
    """The rigid motion (4, 4); CalibrationError where its rotation is none."""
    R = T[:3, :3]
    if np.abs(R).max() > 1.01 or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CalibrationError(f"{name} is not a rigid motion: its rotation is {R.tolist()}")
    return T


def read_kitti(path: Path) -> dict[str, Array]:
    """The rows ``name: numbers`` of a file of KITTI's, colons or none; CalibrationError where there are none."""
    rows: dict[str, Array] = {}
    for line in read_calibration(path).splitlines():
        name, _, rest = line.replace(":", " ", 1).strip().partition(" ")
        try:
            rows[name] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    if not rows:
        raise CalibrationError(f"{path}: no calibration in this file")
    return rows


def kitti_matrix(rows: Mapping[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """One finite matrix of a KITTI calibration; CalibrationError where it is missing or none."""
    if name not in rows:
        raise CalibrationError(f"{name} is missing")
    return array(rows[name], name, shape)


def rig_from_projections(P_left: Array, P_right: Array, size: tuple[int, int]) -> StereoRig:
    """The rig of two rectified projections ``P = K [I | t]`` (3, 4) from one frame of reference."""
    b = projection_offset(P_right) - projection_offset(P_left)
    b[np.abs(b) < 1e-3 * np.abs(b).max()] = 0  # across the baseline: rounding of the file
    left, right = (PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *size) for P in (P_left, P_right))
    return StereoRig.side_by_side(left, right, np.eye(3), b)


def projection_offset(P: Array) -> Array:
    """``K⁻¹ p₄`` (3,) [m], the frame of reference's place in this camera's axes; CalibrationError for no such P."""
    K = P[:, :3]
    zeros = np.abs([K[0, 1], K[1, 0], K[2, 0], K[2, 1]]).max()
    if not (K[0, 0] > 0 and K[1, 1] > 0) or K[2, 2] != 1 or zeros > 0:
        raise CalibrationError(f"not a rectified projection matrix: {P.tolist()}")
    return np.asarray(np.linalg.solve(K, P[:, 3]), np.float64)


def read_form(path: Path, images: Size | None) -> tuple[Mapping[str, Any], str]:
    """What a file holds, and whose form it is where its entries do not tell; CalibrationError where it is no rig's."""
    if path.suffix.lower() in _NO_TEXT:
        raise CalibrationError(f"{path}: no text: write K1, D1, K2, D2, R and T with cv2.FileStorage (docs/guide.md)")
    text = read_calibration(path).strip()
    if text.startswith("<"):
        return _read_xml(path, text), ""
    with naming(path):
        if text.startswith("[") and "[STEREO]" in text.upper():
            return _read_zed(text, images), "ZED's"
        if kitti := _KITTI.search(text):
            rows = read_kitti(path)
            return {f"P{i}": rows.get(f"{kitti[1]}{i}") for i in (0, 1)} | {"size": rows.get("S_rect_00")}, "KITTI's"
    root = read_yaml(path)
    if {"evidence", "residual_scale", "self_calibration"} & set(root):
        what = "errors of a rig, as `slam calibrate` or a run found them, not a rig: see --calibration"
        raise CalibrationError(f"{path}: {what}")
    if "cameraData" in root:
        with naming(path):
            return _read_depthai(root), "depthai's"
    cameras = {side: path.parent / str(root.get(f"cam{at}_calib", "")) for at, side in enumerate(("left", "right"))}
    if all(file.is_file() for file in cameras.values()):  # VINS-Fusion's, with a file for each camera
        return {**root, **{side: read_yaml(file) for side, file in cameras.items()}}, ""
    return root, ""


def is_kitti(path: Path) -> bool:
    """Whether a file is of KITTI's form; CalibrationError where it cannot be read."""
    return _KITTI.search(read_calibration(path)) is not None


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping in a YAML (or JSON) file, all values as texts; CalibrationError where there is none, or too much.

    OpenCV's dialect has ``%YAML:1.0`` in its first line, ``.Nan`` and ``.Inf``, and a mark on matrices.
    """
    import yaml

    text = read_calibration(path)
    if text.startswith("%YAML:"):
        text = "\n" + text.partition("\n")[2]  # rows keep their numbers
    text = re.sub(r"(?i)(?<!\w)\.(nan|inf)\b", r"\1", text)
    depth, loader = 0, getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    try:
        for event in yaml.parse(text, loader):  # aliases may stand for gigabytes
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST or isinstance(event, yaml.AliasEvent):
                what = "nested too deeply" if depth > _DEEPEST else "no aliases are read"
                row = event.start_mark.line + 1  # type: ignore[union-attr]
                raise CalibrationError(f"{path}, row {row}: {what} in a calibration")
        root = next(yaml.load_all(text, loader), None)  # of messages that ROS prints, a line ends each
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", row {mark.line + 1}" if mark else ""
        raise CalibrationError(f"{path}{where}: no valid YAML") from error
    if not isinstance(root, Mapping):
        raise CalibrationError(f"{path}: no calibration in this file")
    return root


def _read_xml(path: Path, text: str) -> dict[str, Any]:
    """The entries of a storage in XML: texts, and the parts of matrices."""
    if "<!" in text.replace("<!--", ""):  # OpenCV writes no entities, which may stand for gigabytes
        raise CalibrationError(f"{path}: a calibration has no document type and no entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: a declared encoding that is none
        row = f", row {error.position[0]}" if isinstance(error, ElementTree.ParseError) else ""
        raise CalibrationError(f"{path}{row}: no valid XML") from error
    return {node.tag: {part.tag: part.text or "" for part in node} if len(node) else node.text or "" for node in root}


def _read_zed(text: str, images: Size | None) -> dict[str, Any]:
    """ZED's file as it comes from its maker [mm], for one of its resolutions: that of the images."""
    parser = ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"no valid file of a ZED: {error}") from error
    there = [name for name in _ZED_SIZES if parser.has_section(f"LEFT_CAM_{name}")]
    name = next((n for n in there if images is None or _ZED_SIZES[n] == images), None)
    if name is None or (images is None and len(there) > 1):
        sizes = ", ".join(size_text(_ZED_SIZES[n]) for n in there) or "none that is known"
        given = f"another size than {size_text(images)}" if images else "several sizes: give size=(width, height)"
        raise CalibrationError(f"it is a ZED's, for images of {given}; it has {sizes}")
    stereo = parser["STEREO"]
    keys = (*((key, key) for key in ("baseline", "ty", "tz")), *((f"{key}_{name}", key) for key in ("rx", "cv", "rz")))
    try:
        baseline, ty, tz, *turn = (float(stereo.get(own, stereo.get(key, "0"))) for own, key in keys)
    except ValueError as error:
        raise CalibrationError(f"[STEREO]: {error}") from error
    sides = {side: dict(parser[f"{side}_CAM_{name}"]) for side in ("LEFT", "RIGHT") if f"{side}_CAM_{name}" in parser}
    return sides | {"R": turn, "T": [-0.001 * baseline, 0.001 * ty, 0.001 * tz], "size": list(_ZED_SIZES[name])}


def _read_depthai(root: Mapping[str, Any]) -> dict[str, Any]:
    """A depthai calibration [cm]: the cameras of its stereo pair, and the motion from one to the other."""
    T, named = None, {}
    try:
        cameras = {int(socket): camera for socket, camera in root["cameraData"]}
        pair = root.get("stereoRectificationData")
        pair = pair if isinstance(pair, Mapping) else {}
        sockets = [int(pair.get(f"{side}CameraSocket", default)) for side, default in (("left", 1), ("right", 2))]
        for side, (own, other) in (("left", sockets), ("right", sockets[::-1])):
            camera, extrinsics = cameras[own], cameras[own]["extrinsics"]
            named[side] = {key: camera.get(key) for key in ("intrinsicMatrix", "distortionCoeff", "width", "height")}
            named[side]["camera_model"] = "fisheye" if camera.get("cameraType") == "1" else "pinhole"
            if int(extrinsics["toCameraSocket"]) == other and T is None:
                t = [0.01 * float(extrinsics["translation"][axis]) for axis in "xyz"]
                T = pose(np.array(extrinsics["rotationMatrix"], float).reshape(3, 3), np.array(t))
                T = T if side == "left" else inverse(T)
    except (LookupError, AttributeError, *NO_NUMBERS) as error:
        raise CalibrationError(f"it is depthai's, but a camera of the pair is missing or damaged ({error})") from error
    if T is None:
        raise CalibrationError("it is depthai's, but says nothing of how the pair stands to each other")
    return named | {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()}
