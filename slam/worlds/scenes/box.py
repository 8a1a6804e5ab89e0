"""Paper B, section 4.4: a box that stands at the four places of Table 1, one after another, with beacons around it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.options import Option
from slam.worlds.paths import through, yaw_pitch_roll
from slam.worlds.scenes.common import CAMERAS, assemble, carton, clock, laboratory, make_rig, watching
from slam.worlds.world import World

TEXT = "a box at the four places of Table 1, stop and go, with beacons around it (paper B, section 4.4)"
OPTIONS = (Option("camera", "sway", "how the camera moves", choices=CAMERAS),)
DEFAULTS: dict[str, Any] = {"density": 40.0}

FOCAL = 260.0
FLOOR = -0.48  #: height of the floor; the world's origin is the camera's first place [m]
SIZE = (0.24, 0.16, 0.20)  #: of the box [m]; its frame sits at the upper right corner of its front

#: Table 1: displacement x, y, z [m] and yaw, pitch, roll [degrees] at B0 to B3.
PLACES = np.array(
    [
        (-0.185, 0.900, 0.230, 0.0, 0.0, 0.0),
        (-0.100, 1.025, 0.067, 5.8, -15.1, -35.0),
        (-0.121, 0.775, 0.214, -8.6, 15.3, 52.6),
        (-0.221, 1.017, 0.265, 4.7, 38.9, -21.3),
    ]
)
REST, MOVE = 2.0, 1.5  #: how long the box stands at a place, and is on its way to the next [s]
DURATION = 4 * REST + 3 * MOVE


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    layout = values["layout"]
    size = np.array(SIZE)
    rectangles = laboratory(layout, FLOOR) + carton(size, np.array([-size[0], 0, -size[2]]), 1, 200 + layout)
    poses = watching(t, stamps, values["camera"], np.random.default_rng([layout, 51]))
    rig = make_rig(values, FOCAL * values["width"] / 320)
    return assemble("box", "handheld", values, rig, stamps, poses, rectangles, (0.3, 5.0), 700.0, _box_poses(t)[None])


def _box_poses(t: Array) -> Array:
    """Box poses (N, 4, 4): at rest at a place, then smoothly on to the next."""
    times, rows = [], []
    for i, place in enumerate(PLACES):
        start = i * (REST + MOVE)
        times += [start, start + REST]
        rows += [place, place]
    x, y, z, yaw, pitch, roll = (through(t, times, column) for column in np.array(rows).T)
    angles = np.deg2rad(np.stack([yaw, pitch, roll], axis=1))
    R = np.array([yaw_pitch_roll(*a) for a in angles])
    return pose(R, np.stack([x, y, z], axis=1))
