"""A desk: a small volume whose landmarks are seen again and again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.geometry import Rectangle, rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, carried, sway, yaw_pitch_roll
from slam.worlds.scenes.common import assemble, clock, crate, make_rig
from slam.worlds.textures.surfaces import Material
from slam.worlds.world import World

TEXT = "a desk seen from all sides of one chair: a small volume, landmarks seen again and again"
OPTIONS: tuple[Option, ...] = ()
DEFAULTS: dict[str, Any] = {"density": 70.0}

FOCAL = 260.0
DURATION = 30.0  #: [s]
TOP = 0.74  #: height of the desk's top [m]
WALL_Y = 0.55  #: the wall behind the desk

#: Things on the desk: name, size (x, y, z) [m], place of the lower front left corner (x, y), turn [degrees], lift.
_THINGS = (
    ("screen", (0.52, 0.05, 0.33), (-0.10, 0.28), -4, 0.09),
    ("keyboard", (0.44, 0.15, 0.02), (-0.12, -0.08), 3, 0.0),
    ("cover", (0.21, 0.29, 0.035), (-0.58, -0.10), 14, 0.0),
    ("cover", (0.19, 0.26, 0.05), (-0.56, -0.08), -9, 0.035),
    ("cover", (0.17, 0.24, 0.03), (-0.55, -0.05), 22, 0.085),
    ("carton", (0.20, 0.16, 0.22), (0.48, 0.15), -25, 0.0),
    ("carton", (0.09, 0.09, 0.12), (0.40, -0.10), 35, 0.0),
    ("cover", (0.04, 0.17, 0.25), (-0.46, 0.25), 0, 0.0),
    ("cover", (0.05, 0.19, 0.28), (-0.41, 0.25), 0, 0.0),
    ("cover", (0.03, 0.17, 0.23), (-0.35, 0.25), 0, 0.0),
    ("paper", (0.21, 0.297, 0.003), (0.14, -0.385), -12, 0.0),
)


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    rig = make_rig(values, FOCAL * values["width"] / 320)
    rectangles, poses = _room(values["layout"]), _orbit(t, stamps, values["layout"])
    return assemble("desk", "handheld", values, rig, stamps, poses, rectangles, (0.25, 4.0), 1000.0)


def _orbit(t: Array, stamps: Array, layout: int) -> Array:
    """Camera poses at path times t, shaken at times `stamps`: swinging before the desk, looking at it."""
    rng = np.random.default_rng([layout, 42])
    _, angles = carried(stamps, rng, amount=0.5)
    azimuth = 0.65 * np.sin(2 * np.pi * t / 9.0) + 0.06 * sway(t, rng, 0.1, 0.5)
    distance = 0.95 + 0.15 * np.sin(2 * np.pi * t / 13.0 + 1) + 0.02 * sway(t, rng, 0.2, 1.0)
    height = TOP + 0.42 + 0.12 * np.sin(2 * np.pi * t / 7.0) + 0.01 * sway(t, rng, 0.2, 1.5)
    target = np.array([0.0, 0.15, TOP + 0.1])
    positions = np.stack([distance * np.sin(azimuth), 0.15 - distance * np.cos(azimuth), height], axis=1)
    gaze = target - positions
    yaw = np.arctan2(-gaze[:, 0], gaze[:, 1])
    pitch = np.arctan2(gaze[:, 2], np.hypot(gaze[:, 0], gaze[:, 1]))
    return camera_poses(positions, yaw + angles[:, 0], pitch + angles[:, 1], angles[:, 2])


def _room(layout: int) -> list[Rectangle]:
    """Desk, wall with pinned papers, and the things on the desk."""
    board = Material(1.1, 0.75, "pinboard", layout, 160, (0.01, 0.05))
    wall = Material(9.0, 3.0, "plaster", layout, 0)
    floor = Material(9.0, 3.0, "carpet", layout, 6)
    top = Material(1.5, 0.75, "wood", layout, 60, (0.006, 0.02))
    out = [
        rectangle(wall, (-4.5, WALL_Y, 3.0), (1, 0, 0), (0, 0, -1)),
        rectangle(board, (-0.6, WALL_Y - 0.01, 1.85), (1, 0, 0), (0, 0, -1)),
        rectangle(floor, (-4.5, WALL_Y, 0), (1, 0, 0), (0, -1, 0)),
        rectangle(top, (-0.75, WALL_Y - 0.05, TOP), (1, 0, 0), (0, -1, 0), occludes=True),
    ]
    for number, (material, size, place, turn, lift) in enumerate(_THINGS):
        T = pose(yaw_pitch_roll(np.deg2rad(turn), 0, 0), np.array([*place, TOP + lift]))
        looks = Material(0, 0, material, 1000 * layout + 10 * number, 500, (0.006, 0.02))
        out += crate(size, looks, T_body_box=T, sides=("front", "left", "right", "top"))
    return out
