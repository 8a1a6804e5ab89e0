"""Several boxes with different velocities that hide each other and the scene; one has a lid on a hinge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.options import Option
from slam.worlds.paths import through, yaw_pitch_roll
from slam.worlds.scenes.common import CAMERAS, assemble, carton, clock, laboratory, make_rig, watching
from slam.worlds.world import World

TEXT = "three boxes with different velocities, and one of two parts joined by a hinge, before a room's corner"
OPTIONS = (Option("camera", "moving", "how the camera moves", choices=CAMERAS),)
DEFAULTS: dict[str, Any] = {"density": 40.0}

FOCAL = 260.0
FLOOR = -0.48  #: height of the floor; the world's origin is the camera's first place [m]
DURATION = 20.0  #: [s]

#: Sizes of the boxes 1 to 3, and of the two parts of the articulated one, 4 and 5 [m].
SIZES = ((0.22, 0.18, 0.20), (0.26, 0.20, 0.24), (0.16, 0.16, 0.16), (0.26, 0.20, 0.12), (0.26, 0.20, 0.05))


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    layout = values["layout"]
    rectangles = laboratory(layout, FLOOR)
    for body, size in enumerate(np.array(SIZES), start=1):
        hinged = body >= 4  # the frames of both hinged parts lie in the hinge, at the upper rear edge of the lower part
        lowest = np.array([-size[0] / 2, -size[1], -size[2] if body == 4 else 0.0]) if hinged else -size / 2
        rectangles += carton(size, lowest, body, 300 + 10 * layout + body)
    poses = watching(t, stamps, values["camera"], np.random.default_rng([layout, 52]))
    rig = make_rig(values, FOCAL * values["width"] / 320)
    return assemble("boxes", "handheld", values, rig, stamps, poses, rectangles, (0.3, 5.0), 700.0, _poses(t))


def _poses(t: Array) -> Array:
    """Poses (5, N, 4, 4) of the boxes and of the two hinged parts."""
    wave = lambda period, phase=0.0: np.sin(2 * np.pi * t / period + phase)  # noqa: E731
    level = np.zeros(len(t))
    first = _placed(-0.32 + 0.3 * wave(14.0), 1.0 + level, -0.16 + 0.04 * wave(5.0), 0.4 * wave(9.0), level, level)
    # The second goes the other way, behind the first, with stops.
    x = through(t, [1, 4, 6, 10, 12, 16, 18], [0.6, 0.0, 0.0, -0.6, -0.6, 0.3, 0.3])
    second = _placed(x, 1.35 + level, 0.16 + level, 0.5 * wave(11.0, 1), 0.2 * wave(8.0), level)
    x, y, z = -0.1 + 0.3 * wave(6.0, 2), 0.85 + 0.15 * wave(6.0, 0.5), 0.22 + 0.06 * wave(4.0)
    third = _placed(x, y, z, 0.35 * t, level, 0.4 * wave(7.0))
    turn = 0.4 + 0.3 * wave(13.0)
    lower = _placed(0.4 + 0.12 * wave(10.0), 1.15 + level, -0.25 + level, turn, level, level)
    opening = 0.6 - 0.6 * np.cos(2 * np.pi * t / 5.0)  # the lid turns about the hinge, up to 1.2 rad
    lid = lower.copy()
    lid[:, :3, :3] = lower[:, :3, :3] @ np.array([yaw_pitch_roll(0, 0, -a) for a in opening])
    return np.stack([first, second, third, lower, lid])


def _placed(x: Array, y: Array, z: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """Poses (N, 4, 4) from places [m] and angles [rad]."""
    return pose(np.array([yaw_pitch_roll(*a) for a in zip(yaw, pitch, roll)]), np.stack([x, y, z], axis=1))
