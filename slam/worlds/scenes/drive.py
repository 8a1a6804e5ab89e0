"""A drive along any path: a town stands along the roads that it runs along."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.worlds.drives import Road, level, read_path, sampled
from slam.worlds.geometry import Rectangle
from slam.worlds.options import Option
from slam.worlds.scenes import street
from slam.worlds.scenes.common import assemble, make_rig
from slam.worlds.scenes.streets import Streets
from slam.worlds.world import World

TEXT = "a drive through a town along the path of a file, at KITTI's scale and rate"
OPTIONS = (
    Option("path", "", "file of the path: poses in the form of KITTI (at 10 Hz) or TUM"),
    Option("alike", 0.0, "share of the streets' stretches of 48 m that look like another one", 0, 1),
)
DEFAULTS: dict[str, Any] = {
    **street.DEFAULTS, "density": 1.2, "detect": 0.75, "change": 0.5, "clutter": 0.3,
    "descriptor": 16, "descriptor_noise": 0.1, "descriptor_drift": 2.2,
}  # fmt: skip

REACH = (4.0, 60.0)  #: nearest and farthest distance of a feature [m]
TEXELS = 64.0  #: per metre of a surface


def build(values: Mapping[str, Any]) -> World:
    """The world of these options; raises SequenceError where the file is no path."""
    return town("drive", read_path(values["path"]), values)


def town(name: str, path: Trajectory, values: Mapping[str, Any]) -> World:
    """Streets along a path, in the path's own axes, and the drive along them."""
    R_level_path = level(path)
    streets = Streets(Road.along(path.positions @ R_level_path.T), values["layout"], values["alike"])
    rectangles = streets.houses() + streets.furniture() + streets.parked_cars() + streets.ground()
    upright = [_turned(r, R_level_path.T) for r in rectangles]
    rig = make_rig(values, street.FOCAL * values["width"] / 1241)
    drive = sampled(path, values)
    return assemble(name, "driving", values, rig, drive.stamps, drive.poses, upright, REACH, TEXELS, alike=True)


def _turned(part: Rectangle, R: Array) -> Rectangle:
    """A rectangle in other axes."""
    return replace(part, origin=R @ part.origin, along=R @ part.along, down=R @ part.down)
