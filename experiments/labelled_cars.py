"""Labels of KITTI's drives: which object is which car or cyclist, how fast, and what hides behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from slam.data import StereoFeatures
from slam.geometry.se3 import Array, pose, transform

_COLOUR_SHIFT = 44.9  # the labels' boxes are of a camera to the right of the left one: shift by so much / z [px m]
_NEAR = 3.0  # an object within so far of a labelled car, in the ground plane, is that car [m]
_SPAN = 5  # frames over which a labelled speed is taken, to both sides


@dataclass(frozen=True)
class Car:
    """A labelled car, or cyclist, in a frame."""

    place: Array  # middle of its bottom (3,) in left-camera coordinates [m]
    box: Array | None = None  # left, top, right, bottom (4,) in the left image [px]; None where the labels have none
    kind: str = ""  # what it is, where the labels say so


Labels = dict[int, dict[int, Car]]


def read_labels(path: Path) -> Labels:
    """Labelled cars by frame and number, from a file of KITTI tracking."""
    labels: Labels = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if int(words[1]) >= 0:
            place, box = np.array(words[13:16], float), np.array(words[6:10], float)
            box[[0, 2]] += _COLOUR_SHIFT / place[2]
            labels.setdefault(int(words[0]), {})[int(words[1])] = Car(place, box)
    return labels


def read_tracklets(path: Path, day: Path) -> Labels:
    """The same from the tracklets of KITTI raw, which are in the laser's coordinates; `day` has the calibration."""
    laser = _calibration(day / "calib_velo_to_cam.txt")
    R_rectified = _calibration(day / "calib_cam_to_cam.txt")["R_rect_00"].reshape(3, 3)
    T = pose(R_rectified, np.zeros(3)) @ pose(laser["R"].reshape(3, 3), laser["T"])
    labels: Labels = {}
    for number, item in enumerate(ElementTree.parse(path).getroot().iterfind("tracklets/item")):
        first, kind = int(item.findtext("first_frame", "0")), item.findtext("objectType", "")
        places = [[float(p.findtext(f"t{axis}", "nan")) for axis in "xyz"] for p in item.iterfind("poses/item")]
        for frame, place in enumerate(transform(T, np.array(places)), first):
            labels.setdefault(frame, {})[number] = Car(place, kind=kind)
    return labels


def _calibration(path: Path) -> dict[str, Array]:
    """Rows of numbers of one of KITTI's calibration files, by their names."""
    rows = (line.partition(":") for line in path.read_text(encoding="utf-8").splitlines())
    return {name: np.array(values.split(), float) for name, _, values in rows if name != "calib_time"}


def nearest_car(cars: Mapping[int, Car], centre: Array) -> int:
    """Number of the labelled car near a point (3,) in left-camera coordinates, −1 for none."""
    gaps = {number: float(np.linalg.norm((car.place - centre)[[0, 2]])) for number, car in cars.items()}
    best = min(gaps, key=lambda number: gaps[number], default=-1)
    return best if best >= 0 and gaps[best] < _NEAR else -1


def labelled_speed(labels: Labels, poses: Array, stamps: Array, number: int, frame: int) -> float:
    """Speed [m/s] of a car about a frame, from its labelled places and the camera's poses (N, 4, 4); NaN if unknown."""
    frames = [k for k in (max(frame - _SPAN, 0), min(frame + _SPAN, len(poses) - 1)) if number in labels.get(k, {})]
    if len(frames) < 2:
        return float("nan")
    first, last = (poses[k, :3, :3] @ labels[k][number].place + poses[k, :3, 3] for k in frames)
    return float(np.linalg.norm(last - first) / (stamps[frames[1]] - stamps[frames[0]]))


def hidden(features: StereoFeatures, cars: Mapping[int, Car], numbers: tuple[int, ...]) -> np.ndarray:
    """Which features (N,) lie in the boxes of these cars."""
    inside = np.zeros(len(features), bool)
    for number in numbers:
        box = cars[number].box if number in cars else None
        if box is not None:
            left, top, right, bottom = box
            u, v = features.uv_left.T
            inside |= (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    return inside
