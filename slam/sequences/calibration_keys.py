"""Calibration files of any program as one table of entries, and the rig that they describe.

Every form says the same few things under other names: camera matrices, distortions, how the cameras stand to each
other. `_SPELLINGS` has the names; `rig_of` does not care whose they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, pose, so3_exp
from slam.sequences.calibration import array, projection_offset, read_form, rig_from_projections, rigid
from slam.sequences.images import Size

#: Names of entries, in lower case, letters and digits only, without the side: K1, cameraMatrix1, camera_matrix_left,
#: LEFT.K, cam0/intrinsics and Camera1.fx are all found.
_SPELLINGS: dict[str, tuple[str, ...]] = {
    "K": ("k", "m", "cameramatrix", "mtx", "intrinsics", "intrinsic", "intrinsicmatrix"),
    "D": ("d", "distcoeffs", "dist", "distortion", "distortioncoeffs", "distortioncoefficients", "distortioncoeff"),
    "P": ("p", "projectionmatrix", "projection"),
    "R_rect": ("r", "rectificationmatrix"),
    "T_BS": ("tbs", "timucam", "bodyt"),
    "T_cam_imu": ("tcamimu",),
    "R": ("r", "rot", "rotation", "rotationmatrix", "stereor", "rstereo"),
    "T": ("t", "trans", "translation", "translationvector", "stereot", "tstereo"),
    "T_cn_cnm1": ("cam1tcncnm1",),
    "T_c1_c2": ("stereotc1c2",),
    "width": ("imagewidth", "width", "cols"),
    "height": ("imageheight", "height", "rows"),
    "size": ("imagesize", "size", "imgsize", "resolution"),
    "baseline": ("baseline", "stereob"),
    "bf": ("bf", "focalxbaseline"),
    "cx": ("cx", "ppx"),
    "cy": ("cy", "ppy"),
    "distortion model": ("distortionmodel",),
    "camera model": ("cameramodel", "model", "cameratype", "modeltype"),
}
_FISHEYE = ("equidistant", "fisheye", "kannalabrandt8", "kannalabrandt")
_PINHOLE = ("", "none", "radialtangential", "radtan", "plumbbob", "rationalpolynomial", "pinhole", "perspective",
            "rectified")  # fmt: skip
_OF_ONE = ("tbs", "cameramatrix", "projectionmatrix", "p")  # names that a file of one camera has
_FROM_ZERO = ("k0", "m0", "d0", "p0", "cameramatrix0", "camera0fx")  # one of these: cameras are counted from 0
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_PLAIN = ("fx", "fy", "cx", "cy")

#: Whose a form is: entries that only it has, and what a complete file of it holds.
_FORMS = {
    "Kalibr's": (
        ("cam0intrinsics", "cam1intrinsics", "cam0cameramodel", "cam1cameramodel"),
        "cam0 and cam1, each with intrinsics and resolution, and T_cn_cnm1 in cam1",
    ),
    "EuRoC's": (("lefttbs",), "intrinsics, resolution and T_BS, in two files"),
    "ROS's": (("leftcameramatrix", "leftp"), "camera_matrix, rectification_matrix and projection_matrix, in two files"),
    "ORB-SLAM's": (
        ("camerabf", "stereotc1c2", "stereob", "camera1fx"),
        "Camera.bf for rectified images, LEFT.K … and RIGHT.K …, or Camera1.fx …, Camera2.fx … and Stereo.T_c1_c2",
    ),
    "stella_vslam's": (("camerafocalxbaseline",), "Camera.fx … and Camera.focal_x_baseline"),
    "VINS-Fusion's": (("bodytcam0",), "cam0_calib and cam1_calib, files that are there, body_T_cam0 and body_T_cam1"),
    "Basalt's": (("value0intrinsics",), "other entries than are read here: write it in another form"),
}
_COMPLETE = "K1, D1, K2, D2, R and T; one of rectified images P1 and P2, or fx, fy, cx, cy and baseline"

#: guard: shortest focal length as a share of the image's width: a pinhole camera of 170 degrees has 0.044.
_SHORTEST_FOCAL = 0.04

#: guard: largest skew as a share of the focal length: a thousandth moves the image's border by half a pixel.
_SKEW = 1e-3

#: guard: cosine of the widest angle between the optical axes of a stereo pair, 60 degrees.
_ALIKE = 0.5

Entry = tuple[str, Any]  # an entry's name as written, and its value


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
        found = (known for known, (names, _) in _FORMS.items() if any(name in self._values for name in names))
        self.form = form or next(found, "")
        counts = ("0", "1") if any(name in self._values for name in _FROM_ZERO) else ("1", "2")
        self._sides = [
            (word, word[0], count, f"cam{side}", f"camera{count}", f"{word}camera")
            for side, (word, count) in enumerate(zip(("left", "right"), counts))
        ]

    def find(self, role: str, side: int | None = None) -> Entry | None:
        """An entry, of a camera (0 left, 1 right) or of the pair; None where there is none."""
        spellings = (*_SPELLINGS.get(role, (role,)), f"projectionparameters{role}", f"distortionparameters{role}")
        if side is None:
            names = [*spellings, *(f"camera{s}" for s in spellings)]
        else:
            names = [name for s in spellings for token in self._sides[side] for name in (s + token, token + s)]
        least = 2 if role == "K" else 1  # words; k1 and k2 alone are coefficients of distortion
        there = (entry for n in names if (entry := self._values.get(n)) is not None and entry[1] is not None)
        return next((e for e in there if not isinstance(e[1], str) or len(e[1].split()) >= least), None)

    def both(self, role: str) -> bool:
        """Whether both cameras have an entry."""
        return all(self.find(role, side) is not None for side in (0, 1))

    def numbers(self, role: str, side: int | None, shape: tuple[int, ...] | None) -> Array | None:
        """A finite array of this shape, flat where that is None; None where there is no such entry."""
        found = self.find(role, side)
        return None if found is None else array(found[1], found[0], shape)

    def incomplete(self, missing: Sequence[str], by_form: bool = True) -> CalibrationError:
        """The error where roles are missing, in the words of the form; all entries are named as they are written."""
        there = f"in it: {', '.join(sorted(name for name, _ in self._values.values())) or 'nothing'}"
        if by_form and self.form in _FORMS:
            return CalibrationError(f"it looks like {self.form}, which has {_FORMS[self.form][1]}; {there}")
        one = " (it is one camera's: name both files, calibration=LEFT,RIGHT)" * (self.find("cameramatrix") is not None)
        verb = "is" if len(missing) == 1 else "are"
        return CalibrationError(
            f"{', '.join(missing)} {verb} missing{one}; {there}. A stereo calibration has {_COMPLETE}"
        )


def read_entries(paths: Sequence[Path], images: Size | None) -> Entries:
    """The entries of one file or two, read by the XML, INI and YAML libraries: OpenCV's reader can crash.

    The size of the images, where it is known, chooses one of several resolutions. CalibrationError where a file is
    missing or unreadable.
    """
    read = [read_form(path, images) for path in paths]
    return Entries([dict(_flat(root, "", "")) for root, _ in read], read[0][1] if len(read) == 1 else "")


def rig_of(entries: Entries, images: Size | None, unit: float, rectified: bool, fisheye: bool) -> StereoRig:
    """The rig of calibration files, lengths in them in units of so many metres.

    Taken are two cameras with R and T as ``cv2.stereoCalibrate`` gives them (``h_right = R h_left + T``), with poses on
    a body, or with rectifications; for `rectified` images two projections, or fx, fy, cx, cy and baseline. The size of
    the images counts where the files name none; `fisheye` distortion is ``cv2.fisheye``'s. CalibrationError where
    entries are missing, or the rig is impossible.
    """
    sizes = [_size(entries, side) for side in (0, 1)]
    size = sizes[0] or sizes[1] or images
    if size is None:
        raise CalibrationError("names no image size: give size=(width, height)")
    P, K, scalars = ([entries.find(role, side) is not None for side in (0, 1)] for role in ("P", "K", "fx"))
    if rectified or (any(P) and not K[0] and not scalars[0]):
        if not all(P):
            raise entries.incomplete([f"P{side + 1}" for side in (0, 1) if not P[side]], by_form=False)
        return rig_from_projections(*_projections(entries, unit), size)
    T_right_left = _extrinsics(entries, unit)
    if T_right_left is None and not any(K) and (plain := _plain(entries, size, unit)) is not None:
        return plain
    missing = [f"K{side + 1}" for side in (0, 1) if not (K[side] or scalars[side])]
    missing += [role for role in ("R", "T") if T_right_left is None and entries.find(role) is None]
    if missing or T_right_left is None:
        raise entries.incomplete(missing)
    cameras = [_camera(entries, side, sizes[side] or size, fisheye) for side in (0, 1)]
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    b = R.T @ t  # h_right = R (h_left + b), paper A, Eq. 6
    if entries.form and b[0] > np.abs(b).max() / 2:
        raise CalibrationError(
            f"the second camera stands {b[0]:.4f} m to the left of the first one: are the cameras swapped? The "
            "first one of a calibration is the left one"
        )
    if R[2, 2] < _ALIKE:
        apart = np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))
        raise CalibrationError(f"the cameras look {apart:.0f} degrees apart: is a rotation in degrees?")
    return StereoRig.side_by_side(cameras[0], cameras[1], R, b)


def body_pose(entries: Entries, side: int) -> Array:
    """``T_body_camera`` (4, 4) of a camera; where no body is named, it is the left camera."""
    found = entries.numbers("T_BS", side, (4, 4))
    if found is not None:
        return rigid(found, "T_BS")
    found = entries.numbers("T_cam_imu", side, (4, 4))
    return np.eye(4) if found is None else inverse(rigid(found, "T_cam_imu"))


def _extrinsics(entries: Entries, unit: float) -> Array | None:
    """``T_right_left`` (4, 4) [m], by whichever entries say it; None where none does."""
    R, t = entries.numbers("R", None, None), entries.numbers("T", None, (3,))
    if R is not None and t is not None:
        return pose(so3_exp(R) if R.size == 3 else array(R, "R", (3, 3)), unit * t)
    if entries.both("T_BS") or entries.both("T_cam_imu"):
        return inverse(body_pose(entries, 1)) @ body_pose(entries, 0)
    for role, turned in (("T_cn_cnm1", False), ("T_c1_c2", True)):
        T = entries.numbers(role, None, (4, 4))
        if T is not None:
            return inverse(rigid(T, role)) if turned else rigid(T, role)
    left, right = (entries.numbers("R_rect", side, (3, 3)) for side in (0, 1))
    offset = None  # of the rectified left camera in the rectified right one's axes (3,) [m]
    if entries.both("P"):
        P_left, P_right = _projections(entries, unit)
        offset = projection_offset(P_right) - projection_offset(P_left)
    elif (baseline := entries.find("baseline")) is not None:
        offset = np.array([-unit * _number(baseline), 0.0, 0.0])
    elif (product := entries.find("bf")) is not None and (focal := entries.find("fx")) is not None:
        offset = np.array([-unit * _number(product) / _number(focal), 0.0, 0.0])
    return None if left is None or right is None or offset is None else pose(right.T @ left, right.T @ offset)


def _projections(entries: Entries, unit: float) -> tuple[Array, Array]:
    """Both projections (3, 4), their last column for metres."""
    left, right = (entries.numbers("P", side, (3, 4)) for side in (0, 1))
    assert left is not None and right is not None
    if left[0, 3] == right[0, 3] and left[1, 3] == right[1, 3]:
        raise CalibrationError("the cameras are not calibrated as a pair: P of the right one holds no baseline")
    scale = np.array([1, 1, 1, unit])
    return left * scale, right * scale


def _plain(entries: Entries, size: Size, unit: float) -> StereoRig | None:
    """A rectified rig of two equal cameras by five numbers, of which all that are wrong are named; None for none."""
    side = 0 if entries.find("fx") is None and entries.find("fx", 0) is not None else None
    last = "bf" if entries.find("baseline") is None and entries.find("bf") is not None else "baseline"
    found = {name: entries.find(name, side) for name in _PLAIN} | {last: entries.find(last)}
    if not any(found.values()):
        return None
    values, wrong = [], []
    for name, entry in found.items():
        try:
            values.append(_number(entry or (name, None)))
            if values[-1] <= 0 and name not in ("cx", "cy"):
                wrong.append(f"{name} is {values[-1]:g}, which must be positive")
        except CalibrationError as error:
            wrong.append(str(error))
    if wrong:
        raise CalibrationError(f"{'; '.join(wrong)} (a rectified pair needs fx, fy, cx, cy in pixels and baseline)")
    if any(_number(entry) for name in _COEFFICIENTS if (entry := entries.find(name, side)) is not None):
        raise CalibrationError("names distortion, but only one camera: images of five numbers are rectified")
    fx, fy, cx, cy, length = values
    _require_pixels(fx, size)
    left, right = (PinholeCamera(fx, fy, cx, cy, *size) for _ in range(2))
    return StereoRig.side_by_side(
        left, right, np.eye(3), np.array([-unit * length / (fx if last == "bf" else 1), 0, 0])
    )


def _require_pixels(focal: float, size: Size) -> None:
    if focal < _SHORTEST_FOCAL * size[0]:
        raise CalibrationError(f"a focal length of {focal:g} px for images {size[0]} px wide: is it in pixels?")


def _camera(entries: Entries, side: int, size: Size, fisheye: bool) -> PinholeCamera:
    """One camera from its matrix, or its four numbers, and its distortion."""
    for role in ("distortion model", "camera model"):
        model = entries.find(role, side) or entries.find(role) or ("", "")
        name = _plain_name(model[1])
        if name not in _FISHEYE + _PINHOLE and (entries.form or role == "distortion model"):
            raise CalibrationError(f"{role} {model[1]!r} is not supported")
        fisheye = fisheye or name in _FISHEYE
    K = _matrix(entries, side)
    _require_pixels(K[0, 0], size)
    D = entries.numbers("D", side, None)
    if D is None:
        names = ("k1", "k2", "k3", "k4") if fisheye else _COEFFICIENTS
        D = np.array([_number(entries.find(name, side) or (name, 0.0)) for name in names])
    D = D[:4] if fisheye else D
    if 0 < len(D) < 4:
        raise CalibrationError(f"distortion model takes 4 coefficients or more, got {len(D)}")
    return PinholeCamera.from_matrix(K, D if D.any() or fisheye else None, size, fisheye)


def _matrix(entries: Entries, side: int) -> Array:
    """A camera matrix (3, 3), by its own entry or by four numbers."""
    found = entries.find("K", side)
    values = [_number(entries.find(name, side) or (name, None)) for name in _PLAIN] if found is None else []
    if found is not None:
        values = array(found[1], found[0], None).tolist()
        if len(values) not in (4, 9):
            raise CalibrationError(f"{found[0]} has {len(values)} numbers; it has fx, fy, cx, cy, or 3 rows of 3")
    if len(values) == 4:
        fx, fy, cx, cy = values
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    K = np.reshape(values, (3, 3))
    if abs(K[0, 1]) > _SKEW * abs(K[0, 0]) or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        raise CalibrationError(f"{found and found[0]} is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {K.tolist()}")
    return np.asarray(K)


def _size(entries: Entries, side: int) -> Size | None:
    """Width and height of a camera's images, where the files name them."""
    for which in (side, None):
        both = entries.numbers("size", which, (2,))
        parts = [entries.numbers(name, which, (1,)) for name in ("width", "height")]
        if both is not None:
            return int(both[0]), int(both[1])
        if parts[0] is not None and parts[1] is not None:
            return int(parts[0][0]), int(parts[1][0])
    return None


def _number(entry: Entry) -> float:
    """One finite number; CalibrationError where it is none, or is missing."""
    name, value = entry
    if value is None:
        raise CalibrationError(f"{name} is missing")
    return float(array(value, name, ())[()])


def _plain_name(name: Any) -> str:
    """A name in lower case, letters and digits only."""
    return "".join(filter(str.isalnum, str(name).lower()))


def _flat(node: Mapping[str, Any], written: str, plain: str) -> Iterator[tuple[str, Entry]]:
    """Entries of nested mappings, their names joined; matrices are values."""
    for key, value in node.items():
        name = _plain_name(key)
        inner = plain + ("" if name == "stereorectifier" else name)
        if isinstance(value, Mapping) and "data" not in value:
            yield from _flat(value, f"{written}{key}/", inner)
        else:
            yield inner, (f"{written}{key}", value)
