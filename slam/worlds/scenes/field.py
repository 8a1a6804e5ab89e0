"""Paper B, section 4.3: a small humanoid robot walks from the left to the right side of a playing field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import pose
from slam.worlds.geometry import Rectangle, cuboid, rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, carried, sway, through, yaw_pitch_roll
from slam.worlds.scenes.common import assemble, clock, make_rig
from slam.worlds.textures.surfaces import Material
from slam.worlds.world import World

TEXT = "a robots' playing field, the robot walking from its left to its right side (paper B, section 4.3)"
OPTIONS: tuple[Option, ...] = ()
DEFAULTS: dict[str, Any] = {"density": 60.0}

FOCAL = 260.0
DURATION = 25.0  #: [s]
WALK = 3.0  #: length of the walk [m]
EYE = 0.48  #: height of the camera: the robot is 51 cm tall [m]
HALF_LENGTH, HALF_WIDTH = 3.0, 2.0  #: of the field [m]


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    layout = values["layout"]
    rng = np.random.default_rng([layout, 48])
    offsets, angles = carried(stamps, rng, gait=1.6, amount=1.2)
    x = through(t, [1.0, DURATION - 1.0], [-WALK / 2, WALK / 2])
    positions = np.stack([x, np.full(len(t), -0.6), np.full(len(t), EYE)], axis=1) + offsets
    yaw = np.deg2rad(4) * sway(t, rng, 0.05, 0.2) + angles[:, 0]
    poses = camera_poses(positions, yaw, np.deg2rad(-5) + angles[:, 1], angles[:, 2])
    rig = make_rig(values, FOCAL * values["width"] / 320)
    rectangles = _ground(layout) + _boards(layout) + _obstacles(layout)
    return assemble("field", "handheld", values, rig, stamps, poses, rectangles, (0.3, 5.0), 500.0)


def _ground(layout: int) -> list[Rectangle]:
    """The field and the hall behind it."""
    field = Material(2 * HALF_LENGTH, 2 * HALF_WIDTH, "field", layout, 3)
    hall = Material(12.0, 3.5, "plaster", layout, 0.3)
    floor = Material(12.0, 9.0, "wood", layout + 1, 1)
    return [
        rectangle(field, (-HALF_LENGTH, HALF_WIDTH, 0.0), (1, 0, 0), (0, -1, 0)),
        rectangle(floor, (-6.0, 4.0, -0.01), (1, 0, 0), (0, -1, 0)),
        rectangle(hall, (-6.0, 4.0, 3.4), (1, 0, 0), (0, 0, -1)),
    ]


def _boards(layout: int) -> list[Rectangle]:
    """Advertising boards behind the field, and posters on the hall's wall."""
    rng = np.random.default_rng([layout, 49])
    out = []
    for i in range(8):
        board = Material(0.72, 0.5, "poster", int(rng.integers(1 << 30)), 60, (0.03, 0.08))
        place = (-HALF_LENGTH + 0.75 * i, HALF_WIDTH + 0.15 + rng.uniform(0, 0.1), 0.5)
        out.append(rectangle(board, place, (1, 0, 0), (0, 0, -1), occludes=True))
    for i in range(7):
        poster = Material(0.6, 0.8, "poster", int(rng.integers(1 << 30)), 60, (0.03, 0.08))
        out.append(rectangle(poster, (-4.2 + 1.2 * i, 3.98, 1.9), (1, 0, 0), (0, 0, -1)))
    return out


def _obstacles(layout: int) -> list[Rectangle]:
    """Goal posts and cartons on the field."""
    rng = np.random.default_rng([layout, 50])
    out = []
    for x in (-0.75, 0.7):  # the posts of the goal
        faces = {side: Material(0.05, 0.8, "board", layout, 0) for side in ("front", "left", "right")}
        out += cuboid(faces, (0.05, 0.05, 0.8), (x, HALF_WIDTH - 0.3, 0))
    for i, (x, y) in enumerate(((-1.6, 0.9), (-0.4, 1.2), (0.5, 0.8), (1.7, 1.1))):
        size = rng.uniform(0.18, 0.32, 3)
        faces = {}
        for side, (a, b) in {"front": (0, 2), "left": (1, 2), "right": (1, 2), "top": (0, 1)}.items():
            faces[side] = Material(size[a], size[b], "carton", 1000 * layout + 10 * i + a, 200, (0.015, 0.04))
        T = pose(yaw_pitch_roll(rng.uniform(-0.6, 0.6), 0, 0), np.array([x, y, 0.0]))
        out += cuboid(faces, size, T_body_box=T)
    return out
