"""Calibration files of any program as one table of entries: their names, and the readers of every form.

Every form says the same few things under other names, which `_SPELLINGS` has. Files may be hostile: YAML is bounded in
depth and read without aliases and tags, XML without entities.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from slam.errors import CalibrationError
from slam.files import read_text
from slam.geometry.se3 import Array, inverse, pose
from slam.sequences.images import Size, size_text

#: Names of entries, in lower case, letters and digits only, without the side: K1, cameraMatrix1, camera_matrix_left,
#: LEFT.K, cam0/intrinsics and Camera1.fx are all found.
_SPELLINGS: dict[str, tuple[str, ...]] = {
    "K": ("k", "m", "kk", "cameramatrix", "mtx", "intrinsics", "intrinsic", "intrinsicmatrix"),
    "D": ("d", "kc", "distcoeffs", "dist", "distortion", "distortioncoeffs", "distortioncoefficients",
          "distortioncoeff", "coeffs"),
    "P": ("p", "projectionmatrix", "projection"),
    "R_rect": ("r", "rectificationmatrix"),
    "T_BS": ("tbs", "timucam"),
    "T_cam_imu": ("tcamimu",),
    "R": ("r", "rot", "om", "rotation", "rotationmatrix", "stereor", "rstereo"),
    "T": ("t", "trans", "translation", "translationvector", "stereot", "tstereo"),
    "T_cn_cnm1": ("cam1tcncnm1",),
    "T_c1_c2": ("stereotc1c2",),
    "width": ("imagewidth", "width", "cols"),
    "height": ("imageheight", "height", "rows"),
    "size": ("imagesize", "size", "imgsize", "resolution"),
    "unit": ("unit", "units"),
    "baseline": ("baseline", "base", "baselinem", "stereob", "b"),
    "bf": ("bf", "focalxbaseline"),
    "fx": ("fx", "f", "focal", "focallength", "fxpx"),
    "fy": ("fy", "f", "focal", "focallength", "fypx"),
    "cx": ("cx", "ppx", "cu", "u0", "cxpx"),
    "cy": ("cy", "ppy", "cv", "v0", "cypx"),
    "distortion model": ("distortionmodel",),
    "camera model": ("cameramodel", "model", "cameratype", "modeltype"),
}  # fmt: skip
_GROUPS = ("stereorectifier", "extrinsics", "extrinsic", "intrinsics", "intrinsic", "parameters")  # names say nothing
_OF_ONE = ("tbs", "cameramatrix", "projectionmatrix", "p")  # names that a file of one camera has
_FROM_ZERO = ("k0", "m0", "d0", "p0", "cameramatrix0", "camera0fx")  # one of these: cameras are counted from 0

#: Whose a form is: entries that only it has.
_FORMS = {
    "Kalibr's": ("cam0intrinsics", "cam1intrinsics", "cam0cameramodel", "cam1cameramodel"),
    "EuRoC's": ("lefttbs",),
    "ROS's": ("leftcameramatrix", "leftp"),
    "ORB-SLAM's": ("camerabf", "stereotc1c2", "stereob", "camera1fx"),
    "stella_vslam's": ("camerafocalxbaseline",),
}
_COMPLETE = "K1, D1, K2, D2, R and T; one of rectified images P1 and P2, or fx, fy, cx, cy and baseline"

_ZED_SIZES = {"2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "SVGA": (960, 600),
              "VGA": (672, 376)}  # fmt: skip
_NO_TEXT = (".npz", ".npy", ".pkl", ".mat")  # of NumPy, Python and MATLAB
_DEEPEST = 32  # of nested entries
_MOST = 1e9  # numbers of a calibration are smaller than this; larger ones overflow in what is made of them
_LIMIT = 4 * 2**20  # most bytes of a file: OpenCV's sample programs keep all corners of all images in it

Entry = tuple[str, Any]  # an entry's name as written, and its value


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the file's name before the message of a calibration fault."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def array(value: Any, name: str, shape: tuple[int, ...] | None) -> Array:
    """A finite array of the shape, flat where that is None, of numbers, texts or OpenCV's ``{rows, cols, data}``."""
    if value is None:
        raise CalibrationError(f"{name} is missing")
    data = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array(data.split() if isinstance(data, str) and shape != () else data, dtype=float)
        numbers = numbers.reshape(-1 if shape is None else shape)
    except (ValueError, TypeError, OverflowError):  # text, ragged lists, numbers of 400 digits
        what = "no number" if shape == () else "no matrix" + (f" of shape {shape}" if shape else "")
        raise CalibrationError(f"{name} is {what}") from None
    if not np.isfinite(numbers).all():
        raise CalibrationError(f"{name} is not finite: {numbers.tolist()}")
    if np.abs(numbers).max(initial=0) > _MOST:
        raise CalibrationError(f"{name} is impossibly large: {numbers.tolist()}")
    return numbers


class Entries:
    """The entries of calibration files by their names in lower case, letters and digits only.

    Of two files of one camera each the first is the left one's. Whose `form` it is, as ``"Kalibr's"``, the entries tell
    where it is empty. OpenCV's, and five plain numbers, have none: of these alone unit and lens may be another one.
    """

    def __init__(self, files: Sequence[Mapping[str, Entry]], form: str = "") -> None:
        self._values: dict[str, Entry] = {}
        single = len(files) == 2 and any(all(n in f for f in files) for n in _OF_ONE)
        for side, file in zip(("left", "right"), files):
            self._values |= {(side + name if single else name): entry for name, entry in file.items()}
        found = (known for known, names in _FORMS.items() if any(name in self._values for name in names))
        self.form = form or next(found, "")
        counts = ("0", "1") if any(name in self._values for name in _FROM_ZERO) else ("1", "2")
        self._sides = [
            (word, word[0], count, f"cam{side}", f"camera{count}", f"{word}camera")
            for side, (word, count) in enumerate(zip(("left", "right"), counts))
        ]

    def find(self, role: str, side: int | None = None) -> Entry | None:
        """An entry, of a camera (0 left, 1 right) or of the pair; None where there is none."""
        spellings = _SPELLINGS.get(role, (role,))
        if side is None:
            names = [*spellings, *(f"camera{s}" for s in spellings)]
        else:
            names = [name for s in spellings for token in self._sides[side] for name in (s + token, token + s)]
        least = 2 if role == "K" else 1  # words; k1 and k2 alone are coefficients of distortion
        there = (entry for n in names if (entry := self._values.get(n)) is not None and entry[1] is not None)
        return next((e for e in there if not isinstance(e[1], str) or len(e[1].split()) >= least), None)

    def numbers(self, role: str, side: int | None, shape: tuple[int, ...] | None) -> Array | None:
        """A finite array of this shape, flat where that is None; None where there is no such entry."""
        found = self.find(role, side)
        return None if found is None else array(found[1], found[0], shape)

    def number(self, role: str, side: int | None = None, default: float | None = None) -> float:
        """One finite number; CalibrationError where it is none, or missing and there is no default."""
        name, value = self.find(role, side) or (role, default)
        return float(array(value, name, ())[()])

    def incomplete(self, missing: Sequence[str]) -> CalibrationError:
        """The error where roles are missing; all entries are named as they are written."""
        there = ", ".join(sorted(name for name, _ in self._values.values())) or "nothing"
        whose = f"it looks like {self.form}, but " if self.form else ""
        one = " (it is one camera's: name both files, calibration=LEFT,RIGHT)" * ("cameramatrix" in self._values)
        lacks = f"{whose}{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing{one}"
        return CalibrationError(f"{lacks}; in it: {there}. A stereo calibration has {_COMPLETE}")


def read_entries(paths: Sequence[Path], images: Size | None, cameras: tuple[str, str] = ("0", "1")) -> Entries:
    """The entries of one file or two; the images' size chooses one of a ZED's resolutions, `cameras` two of KITTI's."""
    read = [_read(path, images, cameras) for path in paths]
    return Entries([dict(_flat(root, "", "")) for root, _ in read], read[0][1] if len(read) == 1 else "")


def _flat(node: Mapping[str, Any], written: str, plain: str) -> Iterator[tuple[str, Entry]]:
    """Entries of nested mappings, their names joined; matrices are values."""
    for key, value in node.items():
        name = plain_name(key)
        if isinstance(value, Mapping) and "data" not in value:
            yield from _flat(value, f"{written}{key}/", plain + ("" if name in _GROUPS else name))
        else:
            yield plain + name, (f"{written}{key}", value)


def plain_name(name: Any) -> str:
    """A name in lower case, letters and digits only."""
    return "".join(filter(str.isalnum, str(name).lower()))


def _read(path: Path, images: Size | None, cameras: tuple[str, str]) -> tuple[Mapping[str, Any], str]:
    """What a file holds, and whose form it is where its entries do not tell; CalibrationError where it is no rig's."""
    if path.suffix.lower() in _NO_TEXT:
        raise CalibrationError(f"{path}: no text: write K1, D1, K2, D2, R and T with cv2.FileStorage (docs/guide.md)")
    text = _text(path)
    if kitti := re.search(r"^(P|P_rect_0)\d[: ]+[^!\[\s]", text, re.MULTILINE):
        rows = read_kitti(path)
        names = [f"{kitti[1]}{camera}" for camera in cameras]
        if missing := [name for name in names if name not in rows]:
            raise CalibrationError(f"{path}: {' and '.join(missing)} missing, or no row of numbers")
        P = {f"P{side}": rows[name] for side, name in enumerate(names)}
        return P | {"size": rows.get(f"S_rect_0{cameras[0]}")}, "KITTI's"
    with naming(path):
        if text.lstrip().startswith("<"):
            return _read_xml(text.strip()), ""
        if text.lstrip().startswith("[") and "[STEREO]" in text.upper():
            return _read_zed(text, images), "ZED's"
        root = _read_yaml(text, "JSON" if path.suffix.lower() == ".json" else "YAML")
        if {"evidence", "residual_scale", "self_calibration"} & set(root):
            what = "errors of a rig, as `slam calibrate` or a run found them, not a rig: see --calibration"
            raise CalibrationError(what)
        return (_read_depthai(root), "depthai's") if "cameraData" in root else (root, "")


def _text(path: Path) -> str:
    """A calibration file's text; CalibrationError where it is missing, cannot be read, or is too large for one."""
    if not path.exists():
        raise CalibrationError(f"{path}: the calibration is missing")
    return read_text(path, _LIMIT, CalibrationError)


def read_kitti(path: Path) -> dict[str, Array]:
    """The rows ``name: numbers`` of a file of KITTI's, colons or none; CalibrationError where there are none."""
    rows: dict[str, Array] = {}
    for line in _text(path).splitlines():
        name, _, rest = line.replace(":", " ", 1).strip().partition(" ")
        try:
            rows[name] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    if not rows:
        raise CalibrationError(f"{path}: no calibration in this file")
    return rows


def _read_yaml(text: str, kind: str) -> Mapping[str, Any]:
    """The mapping in a text in YAML (or JSON), all values as texts; also OpenCV's dialect: ``%YAML:1.0``, ``.Nan``."""
    import yaml

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
                raise CalibrationError(f"row {row}: {what} in a calibration")
        root = next(yaml.load_all(text, loader), None)  # of messages that ROS prints, a line ends each
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise CalibrationError((f"row {mark.line + 1}: " if mark else "") + f"no valid {kind}") from error
    if not isinstance(root, Mapping):
        raise CalibrationError("no calibration in this file")
    return root


def _read_xml(text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):  # OpenCV writes no entities, which may stand for gigabytes
        raise CalibrationError("a calibration has no document type and no entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: a declared encoding that is none
        raise CalibrationError(f"no valid XML: {error}") from error
    return {node.tag: {part.tag: part.text or "" for part in node} if len(node) else node.text or "" for node in root}


def _read_zed(text: str, images: Size | None) -> dict[str, Any]:
    """ZED's file as it comes from its maker [mm], for one of its resolutions: that of the images."""
    parser = ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"no valid file of a ZED: {error}") from error
    there = {name: size for name, size in _ZED_SIZES.items() if parser.has_section(f"LEFT_CAM_{name}")}
    fitting = [name for name, size in there.items() if images in (None, size)]
    if len(fitting) != 1:
        sizes = ", ".join(map(size_text, there.values())) or "none that is known"
        given = f"another size than {size_text(images)}" if images else "several sizes: give size=(width, height)"
        raise CalibrationError(f"it is a ZED's, for images of {given}; it has {sizes}")
    (name,), stereo = fitting, parser["STEREO"]
    T = [array(stereo.get(key, "0"), key, ()) * sign for key, sign in (("baseline", -1e-3), ("ty", 1e-3), ("tz", 1e-3))]
    turn = [array(stereo.get(f"{key}_{name}", stereo.get(key, "0")), key, ()) for key in ("rx", "cv", "rz")]
    sides = {side: dict(parser[f"{side}_CAM_{name}"]) for side in ("LEFT", "RIGHT") if f"{side}_CAM_{name}" in parser}
    return sides | {"R": turn, "T": T, "size": list(there[name])}


def _read_depthai(root: Mapping[str, Any]) -> dict[str, Any]:
    """A depthai calibration [cm]: the cameras of its stereo pair, and the motion from one to the other."""
    T, named = None, {}
    try:
        cameras = {int(socket): camera for socket, camera in root["cameraData"]}
        pair = root.get("stereoRectificationData") or {}
        sockets = [int(pair.get(f"{side}CameraSocket", default)) for side, default in (("left", 1), ("right", 2))]
        for side, (own, other) in (("left", sockets), ("right", sockets[::-1])):
            camera, extrinsics = cameras[own], cameras[own]["extrinsics"]
            named[side] = {key: camera.get(key) for key in ("intrinsicMatrix", "distortionCoeff", "width", "height")}
            named[side]["camera_model"] = "fisheye" if camera.get("cameraType") == "1" else "pinhole"
            if int(extrinsics["toCameraSocket"]) == other and T is None:
                t = [0.01 * float(extrinsics["translation"][axis]) for axis in "xyz"]
                T = pose(array(extrinsics["rotationMatrix"], "rotationMatrix", (3, 3)), np.array(t))
                T = T if side == "left" else inverse(T)
    except (LookupError, AttributeError, ValueError, TypeError, OverflowError) as error:
        raise CalibrationError(f"it is depthai's, but a camera of the pair is missing or damaged ({error})") from error
    if T is None:
        raise CalibrationError("it is depthai's, but says nothing of how the pair stands to each other")
    return named | {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()}
