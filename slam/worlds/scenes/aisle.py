"""The bookshelf aisle of paper A, section V: walked through by a person who carries the camera pair."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.geometry import Rectangle, Texture, rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, carried, sway, through, yaw_pitch_roll
from slam.worlds.scenes.common import assemble, carton, clock, make_rig
from slam.worlds.textures.surfaces import Material, Shelves
from slam.worlds.world import World

TEXT = "a library aisle with bookshelves, walked through by hand (paper A, section V)"
OPTIONS = (Option("box", 0, "1 for a box that moves along the shelves, stops, and moves on", 0, 1),)
DEFAULTS: dict[str, Any] = {}

FOCAL = 260.0
DURATION = 1524 / 30  #: of the walk [s]
LENGTH = 8.0  #: of the walk [m]
BARE = (5.4, 7.2)  #: the stretch of bare wall
SHELF_Y = 1.15  #: the shelves' fronts
OTHER_Y = -0.85  #: the fronts of the shelves on the other side
START_X, END_X = -2.7, 12.6  #: extent of the aisle
HEIGHT = 2.14  #: of the shelves
CEILING = 2.7
EYE = 1.35  #: height of the camera


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    rectangles = _room(values["layout"])
    boxes = None
    if values["box"]:
        size = np.array([0.34, 0.26, 0.28])
        rectangles += carton(size, -size / 2, 1, 100 + values["layout"])
        boxes = _box_poses(t)[None]
    rig = make_rig(values, FOCAL * values["width"] / 320)
    poses = _walk(t, stamps, values["layout"])
    return assemble("aisle", "handheld", values, rig, stamps, poses, rectangles, (0.3, 5.0), 640.0, boxes)


def _walk(t: Array, stamps: Array, layout: int) -> Array:
    """Camera poses at path times t, shaken at times `stamps`: along the shelves, looking along and towards them."""
    rng = np.random.default_rng([layout, 41])
    offsets, angles = carried(stamps, rng)
    far = LENGTH * _pace(t / DURATION)
    across = 0.3 * np.tanh(0.6 * sway(t, rng, 0.03, 0.12, 3))  # the shelves stay more than 0.8 m away
    heading = np.deg2rad(-42) + np.deg2rad(6) * sway(t, rng, 0.03, 0.15, 4)
    pitch = np.deg2rad(-3) + np.deg2rad(2) * sway(t, rng, 0.05, 0.2, 4)
    positions = np.stack([far, across, np.full(len(t), EYE)], axis=1)
    positions += offsets[:, [1, 0, 2]]
    return camera_poses(positions, heading + angles[:, 0], pitch + angles[:, 1], angles[:, 2])


def _pace(x: Array) -> Array:
    """Share of the walk done at share x of its time: starts from rest, walks evenly, comes to rest."""
    ramp = 0.04  # share of the time for setting off and for stopping
    x = np.clip(x, 0, 1)
    # The speed rises as 3s² − 2s³; the integral of that is s³ − s⁴/2.
    rise = lambda s: s**3 - s**4 / 2  # noqa: E731
    first = ramp * rise(np.clip(x / ramp, 0, 1))
    last = ramp * (0.5 - rise(np.clip((1 - x) / ramp, 0, 1)))
    middle = np.clip(x - ramp, 0, 1 - 2 * ramp)
    return (first + middle + np.where(x > 1 - ramp, last, 0)) / (1 - ramp)


def _room(layout: int) -> list[Rectangle]:
    """Shelves on both sides, floor, ceiling, end walls and a stretch of bare wall."""
    length, depth, behind = END_X - START_X, SHELF_Y - OTHER_Y, SHELF_Y + 0.2
    above = CEILING - HEIGHT
    out = [
        _along_aisle(Shelves(length, HEIGHT, 100 * layout + 50), END_X, OTHER_Y, HEIGHT, -1),
        _along_aisle(Material(length, above + 0.1, "plaster", layout), END_X, OTHER_Y - 0.2, CEILING, -1),
        _along_aisle(Material(length, above + 0.2, "plaster", layout + 1), START_X, behind, CEILING, 1),
        rectangle(Material(length, depth + 0.4, "carpet", layout, 6), (START_X, behind, 0), (1, 0, 0), (0, -1, 0)),
        rectangle(
            Material(length, depth + 0.4, "ceiling", layout), (START_X, OTHER_Y - 0.2, CEILING), (1, 0, 0), (0, 1, 0)
        ),
    ]
    end = Material(depth + 0.4, CEILING, "door_wall", layout + 1, 8)
    out.append(rectangle(end, (END_X, behind, CEILING), (0, -1, 0), (0, 0, -1)))
    out.append(rectangle(end, (START_X, OTHER_Y - 0.2, CEILING), (0, 1, 0), (0, 0, -1)))
    for number, (x0, x1) in enumerate(((START_X, BARE[0]), (BARE[1], END_X))):
        out.append(_along_aisle(Shelves(x1 - x0, HEIGHT, 100 * layout + number), x0, SHELF_Y, HEIGHT, 1))
    wall = Material(BARE[1] - BARE[0] + 1.0, CEILING, "plaster", layout + 2, 0.6)
    out.append(_along_aisle(wall, BARE[0] - 0.5, behind - 0.01, CEILING, 1))
    side = Material(0.19, HEIGHT, "wood", layout)
    out.append(rectangle(side, (BARE[0], SHELF_Y, HEIGHT), (0, 1, 0), (0, 0, -1)))
    out.append(rectangle(side, (BARE[1], behind - 0.01, HEIGHT), (0, -1, 0), (0, 0, -1)))
    return out


def _along_aisle(texture: Texture, x: float, y: float, top: float, direction: int) -> Rectangle:
    """A wall along the aisle, seen from within: from x on, its upper edge running along +x or −x."""
    return rectangle(texture, (x, y, top), (direction, 0, 0), (0, 0, -1))


def _box_poses(t: Array) -> Array:
    """Box poses (N, 4, 4): carried along before the camera, with stops and turns."""
    times = [2, 6, 9, 14, 17, 22, 26, 32, 35, 41, 44, 50]
    x = through(t, times, [1.3, 1.9, 1.9, 3.2, 3.2, 4.6, 4.6, 6.2, 6.2, 7.8, 7.8, 9.2])
    y = through(t, times, [0.75, 0.7, 0.7, 0.8, 0.8, 0.72, 0.72, 0.8, 0.8, 0.75, 0.75, 0.8])
    z = through(t, times[:6], [1.15, 1.3, 1.3, 1.2, 1.2, 1.25])
    yaw = through(t, times, [0.3, 0.8, 0.8, 0.2, 0.2, -0.4, -0.4, 0.3, 0.3, 1.0, 1.0, 0.4])
    roll = through(t, times[:6], [0, 0.25, 0.25, -0.1, -0.1, 0.15])
    R = np.array([yaw_pitch_roll(a, 0, c) for a, c in zip(yaw, roll)])
    return pose(R, np.stack([x, y, z], axis=1))
