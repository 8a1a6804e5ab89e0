"""What calibrations of all forms are made of, and KITTI's files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import CalibrationError
from slam.files import read_text
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array

#: What making an array of numbers raises where the values are none: text, ragged lists, numbers of 400 digits.
NO_NUMBERS = (ValueError, TypeError, OverflowError)

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
    """A finite array of the shape; flat where that is None. OpenCV's matrices are ``{rows, cols, data}``.

    Raises:
        CalibrationError: it is none, or a number is larger than any in a calibration.
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
    """The ``name: numbers`` rows of KITTI's calibration files; rows that are no numbers (dates) are left out.

    The two-line form that holds only P0 and P1 and the old one without colons are accepted.

    Raises:
        CalibrationError: the file is missing or holds no such row.
    """
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
    """One finite matrix of a KITTI calibration."""
    if name not in rows:
        raise CalibrationError(f"{name} is missing")
    return array(rows[name], name, shape)


def rig_from_projections(P_left: Array, P_right: Array, size: tuple[int, int]) -> StereoRig:
    """The rig of two rectified projections ``P = K [I | t]`` (3, 4) from one frame of reference.

    Offsets across the baseline below a thousandth of it are rounding of the file: such images are rectified.
    """
    b = projection_offset(P_right) - projection_offset(P_left)
    b[np.abs(b) < 1e-3 * np.abs(b).max()] = 0
    left, right = (PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], *size) for P in (P_left, P_right))
    return StereoRig.side_by_side(left, right, np.eye(3), b)


def projection_offset(P: Array) -> Array:
    """``K⁻¹ p₄`` (3,) [m]: where the frame of reference's origin lies in this camera's axes.

    Raises:
        CalibrationError: P is no projection of a rectified camera.
    """
    K = P[:, :3]
    zeros = np.abs([K[0, 1], K[1, 0], K[2, 0], K[2, 1]]).max()
    if not (K[0, 0] > 0 and K[1, 1] > 0) or K[2, 2] != 1 or zeros > 0:
        raise CalibrationError(f"not a rectified projection matrix: {P.tolist()}")
    return np.asarray(np.linalg.solve(K, P[:, 3]), np.float64)
