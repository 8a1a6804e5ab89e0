"""Paper B, section 4.2: the camera stands before a board of features with known positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.worlds.geometry import rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, carried
from slam.worlds.scenes.common import assemble, clock, make_rig
from slam.worlds.textures.surfaces import Material, SignBoard
from slam.worlds.world import World

TEXT = "a board of features with known positions, the camera at [3, -70, 2.7] cm (paper B, section 4.2)"
OPTIONS = (Option("tremor", 0.1, "of the standing robot, as a multiple of a walking person's", 0, 10),)
DEFAULTS: dict[str, Any] = {"density": 200.0}

FOCAL = 260.0
DURATION = 5.0  #: [s]
CAMERA = (0.03, -0.70, 0.027)  #: where the camera stands [m]; the board's middle is the world's origin
FLOOR = -0.45  #: height of the floor: the robot is half a metre tall [m]


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, _ = clock(values, DURATION)
    layout = values["layout"]
    offsets, angles = carried(stamps, np.random.default_rng([layout, 47]), gait=1.1, amount=values["tremor"])
    poses = camera_poses(np.array(CAMERA) + offsets, *angles.T)
    board = SignBoard(0.8, 0.6, 4, 6, layout)
    rectangles = [
        rectangle(board, (-0.4, 0, 0.3), (1, 0, 0), (0, 0, -1)),
        rectangle(Material(6.0, 2.5, "plaster", layout), (-3.0, 0.02, FLOOR + 2.5), (1, 0, 0), (0, 0, -1)),
        rectangle(Material(6.0, 2.0, "carpet", layout, 6), (-3.0, 0.02, FLOOR), (1, 0, 0), (0, -1, 0)),
    ]
    rig = make_rig(values, FOCAL * values["width"] / 320)
    return assemble("startup", "handheld", values, rig, stamps, poses, rectangles, (0.2, 3.0), 1000.0)
