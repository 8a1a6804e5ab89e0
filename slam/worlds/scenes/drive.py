"""A drive along any path: a town stands along the roads that it runs along."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.worlds.drives import Road, level, read_path, sampled
from slam.worlds.geometry import Rectangle
from slam.worlds.options import Option
from slam.worlds.scenes import street
from slam.worlds.scenes.common import assemble, make_rig
from slam.worlds.scenes.roadside import car
from slam.worlds.scenes.streets import Streets
from slam.worlds.world import World

TEXT = "a drive through a town along the path of a file, at KITTI's scale and rate"
#: Options of streets.
STREETS = (
    Option(
        "cars", "same", "parked cars: none, the same at each pass, or other ones", choices=("none", "same", "other")
    ),
    Option("alike", 0.0, "share of the streets' stretches of 48 m that look like another one", 0, 1),
)
OPTIONS = (Option("path", "", "file of the path: poses in the form of KITTI (at 10 Hz) or TUM"), *STREETS)
DEFAULTS: dict[str, Any] = {
    **street.DEFAULTS, "density": 1.2, "detect": 0.75, "change": 0.5, "clutter": 0.3,
    "descriptor": 16, "descriptor_noise": 0.1, "descriptor_drift": 2.2,
}  # fmt: skip

REACH = (4.0, 60.0)  #: nearest and farthest distance of a feature [m]
TEXELS = 64.0  #: per metre of a surface

_APART = 200  # frames between two passes of a place
_OTHER = 7_919_000  # from the seed of one car to that of the car that replaces it


def build(values: Mapping[str, Any]) -> World:
    """The world of these options; raises SequenceError where the file is no path."""
    return town("drive", read_path(values["path"]), values)


def town(name: str, path: Trajectory, values: Mapping[str, Any]) -> World:
    """Streets along a path, in the path's own axes, and the drive along them."""
    R = level(path)  # to level axes
    streets = Streets(Road.along(path.positions @ R.T), values["layout"], values["alike"])
    drive = sampled(path, values)
    always = streets.houses() + streets.furniture() + streets.ground()
    cars = _parked(streets, drive.positions @ R.T, values["cars"])
    upright = [_turned(r, R.T) for r in (*always, *(part for part, _ in cars))]
    lasting = np.array([(0, len(drive))] * len(always) + [frames for _, frames in cars]).reshape(-1, 2)
    rig = make_rig(values, street.FOCAL * values["width"] / 1241)
    return assemble(
        name, "driving", values, rig, drive.stamps, drive.poses, upright, REACH, TEXELS,
        lasting=lasting if values["cars"] == "other" else None, alike=True,
    )  # fmt: skip


def _parked(streets: Streets, positions: Array, way: str) -> list[tuple[Rectangle, tuple[int, int]]]:
    """Parts of parked cars, each with the frames (from, to) in which it is there.

    Args:
        streets: where they park.
        positions: of the camera in every frame (N, 3) [m], level.
        way: none, same, or other, which are replaced between one pass and the next.
    """
    always = (0, len(positions))
    out = []
    for T, seed in streets.parking() if way != "none" else ():
        passes = _passes(positions, T[:3, 3]) if way == "other" else [always]
        for number, frames in enumerate(passes):
            out += [(part, frames) for part in car(T, seed + _OTHER * number)]
    return out


def _passes(positions: Array, place: Array) -> list[tuple[int, int]]:
    """Frames (from, to) of each time that a camera passes a place, half way to the next time."""
    near = np.flatnonzero(np.linalg.norm((positions - place)[:, :2], axis=1) < REACH[1])
    gaps = np.flatnonzero(np.diff(near) > _APART)
    middles = [int(near[i] + near[i + 1]) // 2 for i in gaps]
    return list(pairwise([0, *middles, len(positions)]))


def _turned(part: Rectangle, R: Array) -> Rectangle:
    """A rectangle in other axes."""
    return replace(part, origin=R @ part.origin, along=R @ part.along, down=R @ part.down)
