"""Calibration files as nested entries: YAML, JSON, XML, KITTI's, and the makers' own of ZED and depthai cameras.

They may be hostile: YAML is bounded in depth and length of values and without aliases, XML without entities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.se3 import inverse, pose
from slam.sequences.calibration import NO_NUMBERS, naming, read_calibration, read_kitti
from slam.sequences.images import Size

_ZED_SIZES = {"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "SVGA": (960, 600),
              "VGA": (672, 376)}  # fmt: skip
_KITTI = re.compile(r"^(P|P_rect_0)0[: ]", re.MULTILINE)

_DEEPEST = 32
_LONGEST = 4096  # characters of a value

#: What constructing a value of an odd tag (``!!bool maybe``, ``!!int ''``, ``!!timestamp x``) raises.
_REFUSALS = (ValueError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError)


def read_form(path: Path, images: Size | None) -> tuple[Mapping[str, Any], str]:
    """What a file holds, and whose form it is where its entries do not tell.

    Raises:
        CalibrationError: it is missing, damaged, or no calibration of a rig.
    """
    text = read_calibration(path).strip()
    if text.startswith("<"):
        return _read_xml(path, text), ""
    if text.startswith("[") and "[STEREO]" in text.upper():
        return _read_zed(path, text, images), "ZED's"
    kitti = _KITTI.search(text)
    if kitti:
        rows = read_kitti(path)
        named = {f"P{side}": rows.get(f"{kitti[1]}{side}") for side in (0, 1)}
        return {**named, "size": rows.get("S_rect_00")}, "KITTI's"
    root = read_yaml(path)
    if "residual_scale" in root or "self_calibration" in root:
        what = "errors of a rig, as `slam calibrate` or a run found them, not a rig: see --calibration"
        raise CalibrationError(f"{path}: {what}")
    if "cameraData" not in root:
        return root, ""
    with naming(path):
        return _read_depthai(root), "depthai's"


def is_kitti(path: Path) -> bool:
    """Whether a file is of KITTI's form; CalibrationError where it cannot be read."""
    return _KITTI.search(read_calibration(path)) is not None


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping in a YAML (or JSON) file, in OpenCV's dialect, too.

    That has ``%YAML:1.0`` in its first line, ``.Nan`` and ``.Inf``, and a mark on matrices (mappings with ``data``).

    Raises:
        CalibrationError: the file is missing, no YAML, or no mapping; or it holds too much for a calibration.
    """
    import yaml

    text = read_calibration(path)
    if text.startswith("%YAML:"):
        text = "\n" + text.partition("\n")[2]  # rows keep their numbers
    text = re.sub(r"\.(Nan|Inf)\b", lambda match: match[0].lower(), text)
    depth, loader = 0, _loader()
    try:
        for event in yaml.parse(text, loader):  # aliases may stand for gigabytes
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            long = isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST
            if depth > _DEEPEST or long or isinstance(event, yaml.AliasEvent):
                what = (
                    "nested too deeply" if depth > _DEEPEST else "a value too long" if long else "no aliases are read"
                )
                row = event.start_mark.line + 1  # type: ignore[union-attr]
                raise CalibrationError(f"{path}, row {row}: {what} for a calibration")
        node = yaml.load(text, loader)
    except (yaml.YAMLError, *_REFUSALS) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", row {mark.line + 1}" if mark else ""
        raise CalibrationError(f"{path}{where}: no valid YAML") from error
    if not isinstance(node, Mapping):
        raise CalibrationError(f"{path}: no calibration in this file")
    return node


@lru_cache(maxsize=1)
def _loader() -> Any:
    """A safe loader, in C where that is there, that reads values with an unknown mark as if they had none."""
    import yaml

    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    class Loader(base):
        """The loader."""

    def unmarked(loader: Any, _: str, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None

    Loader.add_multi_constructor("", unmarked)
    return Loader


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


def _read_zed(path: Path, text: str, images: Size | None) -> dict[str, Any]:
    """ZED's file as it comes from its maker [mm], for one of its resolutions: that of the images."""
    parser = ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"{path}: no valid file of a ZED: {error}") from error
    there = [name for name in _ZED_SIZES if parser.has_section(f"LEFT_CAM_{name}")]
    name = next((n for n in there if images is None or _ZED_SIZES[n] == images), None)
    if name is None or (images is None and len(there) > 1):
        sizes = ", ".join("{}x{}".format(*_ZED_SIZES[n]) for n in there) or "none that is known"
        given = "another size than {}x{}".format(*images) if images else "several sizes: give size=(width, height)"
        raise CalibrationError(f"{path}: it is a ZED's, for images of {given}; it has {sizes}")
    stereo = parser["STEREO"]
    try:
        ty, tz, *turn = (
            float(stereo.get(f"{key}_{name}", stereo.get(key, "0"))) for key in ("ty", "tz", "rx", "cv", "rz")
        )
        offset = [-float(stereo.get("baseline", "nan")), ty, tz]
    except ValueError as error:
        raise CalibrationError(f"{path}: [STEREO]: {error}") from error
    sides = {side: dict(parser[f"{side}_CAM_{name}"]) for side in ("LEFT", "RIGHT") if f"{side}_CAM_{name}" in parser}
    return sides | {"R": turn, "T": [0.001 * x for x in offset], "size": list(_ZED_SIZES[name])}


def _read_depthai(root: Mapping[str, Any]) -> dict[str, Any]:
    """A depthai calibration [cm]: the cameras of its stereo pair, and the motion from one to the other."""
    T = None
    try:
        cameras = {int(socket): camera for socket, camera in root["cameraData"]}
        pair = root.get("stereoRectificationData") or {}
        sockets = [int(pair.get(f"{side}CameraSocket", default)) for side, default in (("left", 1), ("right", 2))]
        for own, other in (sockets, sockets[::-1]):
            extrinsics = cameras[own]["extrinsics"]
            if int(extrinsics["toCameraSocket"]) == other and T is None:
                t = [0.01 * float(extrinsics["translation"][axis]) for axis in "xyz"]
                T = pose(np.array(extrinsics["rotationMatrix"], float).reshape(3, 3), np.array(t))
                T = T if own == sockets[0] else inverse(T)
        named = {
            side: {key: cameras[socket].get(key) for key in ("intrinsicMatrix", "distortionCoeff", "width", "height")}
            | {"camera_model": "fisheye" if cameras[socket].get("cameraType") == 1 else "pinhole"}
            for side, socket in zip(("left", "right"), sockets)
        }
    except (KeyError, LookupError, AttributeError, *NO_NUMBERS) as error:
        raise CalibrationError(f"it is depthai's, but a camera of the pair is missing or damaged ({error})") from error
    if T is None:
        raise CalibrationError("it is depthai's, but says nothing of how the pair stands to each other")
    return named | {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()}
