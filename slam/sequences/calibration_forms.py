"""Calibration files as nested entries: YAML, JSON, XML, KITTI's, and the makers' own of ZED and depthai cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.se3 import inverse, pose
from slam.sequences.calibration import NO_NUMBERS, naming, read_kitti
from slam.sequences.images import Size
from slam.sequences.yaml_files import read_calibration, read_yaml

_ZED_SIZES = {"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "SVGA": (960, 600),
              "VGA": (672, 376)}  # fmt: skip


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
    kitti = re.search(r"^(P|P_rect_0)0[: ]", text, re.MULTILINE)
    if kitti:
        rows = read_kitti(path)
        named = {f"P{side}": rows.get(f"{kitti[1]}{side}") for side in (0, 1)}
        return {**named, "size": rows.get("S_rect_00")}, "KITTI's"
    root = read_yaml(path)
    if "residual_scale" in root or "self_calibration" in root:
        raise CalibrationError(
            f"{path}: errors of a rig, as `slam calibrate` or a run found them, not a rig: see --calibration"
        )
    if "cameraData" not in root:
        return root, ""
    with naming(path):
        return _read_depthai(root), "depthai's"


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
        given = (
            "several sizes: give size=(width, height)" if images is None else "another size than {}x{}".format(*images)
        )
        raise CalibrationError(f"{path}: it is a ZED's, for images of {given}; it has {sizes}")
    stereo = {key.lower(): value for key, value in parser["STEREO"].items()}
    try:
        read = {
            key: float(stereo.get(f"{key}_{name.lower()}", stereo.get(key, "0")))
            for key in ("ty", "tz", "rx", "cv", "rz")
        }
        offset = [-float(stereo.get("baseline", "nan")), read["ty"], read["tz"]]
    except ValueError as error:
        raise CalibrationError(f"{path}: [STEREO]: {error}") from error
    cameras = {
        side: dict(parser[f"{side}_CAM_{name}"])
        for side in ("LEFT", "RIGHT")
        if parser.has_section(f"{side}_CAM_{name}")
    }
    rotation = [read["rx"], read["cv"], read["rz"]]
    return cameras | {"R": rotation, "T": [0.001 * x for x in offset], "size": list(_ZED_SIZES[name])}


def _read_depthai(root: Mapping[str, Any]) -> dict[str, Any]:
    """A depthai calibration [cm]: the cameras of its stereo pair, and the motion from one to the other."""
    try:
        cameras = {int(socket): camera for socket, camera in root["cameraData"]}
        pair = root.get("stereoRectificationData") or {}
        sockets = [int(pair.get(f"{side}CameraSocket", default)) for side, default in (("left", 1), ("right", 2))]
        left, right = (cameras[socket] for socket in sockets)
        T = None
        for camera, other, back in ((left, sockets[1], False), (right, sockets[0], True)):
            extrinsics = camera["extrinsics"]
            if int(extrinsics["toCameraSocket"]) == other and T is None:
                t = [0.01 * float(extrinsics["translation"][axis]) for axis in "xyz"]
                T = pose(np.array(extrinsics["rotationMatrix"], float).reshape(3, 3), np.array(t))
                T = inverse(T) if back else T
    except (KeyError, LookupError, AttributeError, *NO_NUMBERS) as error:
        raise CalibrationError(f"it is depthai's, but a camera of the pair is missing or damaged ({error})") from error
    if T is None:
        raise CalibrationError("it is depthai's, but says nothing of how the pair stands to each other")
    named = {
        side: {key: camera.get(key) for key in ("intrinsicMatrix", "distortionCoeff", "width", "height")}
        | {"camera_model": "fisheye" if camera.get("cameraType") == 1 else "pinhole"}
        for side, camera in (("left", left), ("right", right))
    }
    return named | {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()}
