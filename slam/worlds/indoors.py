"""Worlds within walls: shelves, a desk, a laboratory with boxes, a board of signs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.geometry import BACK, DOWN, FORWARD, LEFT, RIGHT, Parts, Rectangle, crate, rectangle
from slam.worlds.paths import camera_poses, carried, clock, placed, sway, through, watching
from slam.worlds.surfaces import Material, Shelves, Signs


def carton(size: Array, lowest: Array, body: int, seed: int) -> list[Rectangle]:
    """All six sides of a printed carton with edges `size` (3,) [m] from its `lowest` corner (3,) in body axes."""
    return crate(size, Material(0, 0, "carton", 10 * seed, 250, (0.01, 0.03)), lowest, body)


AISLE_TIME = 1524 / 30  #: of the walk [s]
AISLE_LENGTH = 8.0  #: of the walk [m]
BARE = (5.4, 7.2)  #: the stretch of bare wall
SHELF_Y = 1.15  #: the shelves' fronts
OTHER_Y = -0.85  #: the fronts of the shelves on the other side
START_X, END_X = -2.7, 12.6  #: extent of the aisle
HEIGHT = 2.14  #: of the shelves
CEILING = 2.7
EYE = 1.35  #: height of the camera


def aisle(values: Mapping[str, Any]) -> Parts:
    """The bookshelf aisle of paper A, section V: walked through by a person who carries the camera pair."""
    stamps, t = clock(values, AISLE_TIME)
    rectangles = _aisle_walls(values["layout"])
    boxes = None
    if values["box"]:
        size = np.array([0.34, 0.26, 0.28])
        rectangles += carton(size, -size / 2, 1, 100 + values["layout"])
        boxes = _carried_box(t)[None]
    return Parts(stamps, _walk(t, stamps, values["layout"]), rectangles, boxes)


def _walk(t: Array, stamps: Array, layout: int) -> Array:
    """Camera poses at path times t, shaken at times `stamps`: along the shelves, looking along and towards them."""
    rng = np.random.default_rng([layout, 41])
    offsets, angles = carried(stamps, rng)
    far = AISLE_LENGTH * _pace(t / AISLE_TIME)
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


def _aisle_walls(layout: int) -> list[Rectangle]:
    length, depth, behind = END_X - START_X, SHELF_Y - OTHER_Y, SHELF_Y + 0.2
    above, back = CEILING - HEIGHT, OTHER_Y - 0.2

    def shelves(wide: float, number: int) -> Shelves:
        return Shelves(wide, HEIGHT, 100 * layout + number)

    end = Material(depth + 0.4, CEILING, "plaster", layout + 1, 8)
    wall = Material(BARE[1] - BARE[0] + 1.0, CEILING, "plaster", layout + 2, 0.6)
    side = Material(0.19, HEIGHT, "wood", layout)
    return [
        rectangle(shelves(length, 50), (END_X, OTHER_Y, HEIGHT), LEFT, DOWN),
        rectangle(Material(length, above + 0.1, "plaster", layout), (END_X, back, CEILING), LEFT, DOWN),
        rectangle(Material(length, above + 0.2, "plaster", layout + 1), (START_X, behind, CEILING), RIGHT, DOWN),
        rectangle(Material(length, depth + 0.4, "carpet", layout, 6), (START_X, behind, 0), RIGHT, BACK),
        rectangle(Material(length, depth + 0.4, "ceiling", layout), (START_X, back, CEILING), RIGHT, FORWARD),
        rectangle(end, (END_X, behind, CEILING), BACK, DOWN),
        rectangle(end, (START_X, back, CEILING), FORWARD, DOWN),
        rectangle(shelves(BARE[0] - START_X, 0), (START_X, SHELF_Y, HEIGHT), RIGHT, DOWN),
        rectangle(shelves(END_X - BARE[1], 1), (BARE[1], SHELF_Y, HEIGHT), RIGHT, DOWN),
        rectangle(wall, (BARE[0] - 0.5, behind - 0.01, CEILING), RIGHT, DOWN),
        rectangle(side, (BARE[0], SHELF_Y, HEIGHT), FORWARD, DOWN),
        rectangle(side, (BARE[1], behind - 0.01, HEIGHT), BACK, DOWN),
    ]


def _carried_box(t: Array) -> Array:
    """Box poses (N, 4, 4): carried along before the camera, with stops and turns."""
    times = [2, 6, 9, 14, 17, 22, 26, 32, 35, 41, 44, 50]
    x = through(t, times, [1.3, 1.9, 1.9, 3.2, 3.2, 4.6, 4.6, 6.2, 6.2, 7.8, 7.8, 9.2])
    y = through(t, times, [0.75, 0.7, 0.7, 0.8, 0.8, 0.72, 0.72, 0.8, 0.8, 0.75, 0.75, 0.8])
    z = through(t, times[:6], [1.15, 1.3, 1.3, 1.2, 1.2, 1.25])
    yaw = through(t, times, [0.3, 0.8, 0.8, 0.2, 0.2, -0.4, -0.4, 0.3, 0.3, 1.0, 1.0, 0.4])
    roll = through(t, times[:6], [0, 0.25, 0.25, -0.1, -0.1, 0.15])
    return placed((x, y, z), (yaw, 0, roll))


TOP = 0.74  #: height of the desk's top [m]
WALL_Y = 0.55  #: the wall behind the desk


#: Things on the desk: name, size (x, y, z) [m], place of the lower front left corner (x, y), turn [degrees], lift.
_THINGS = (
    ("poster", (0.52, 0.05, 0.33), (-0.10, 0.28), -4, 0.09),
    ("cover", (0.44, 0.15, 0.02), (-0.12, -0.08), 3, 0.0),
    ("cover", (0.21, 0.29, 0.035), (-0.58, -0.10), 14, 0.0),
    ("cover", (0.19, 0.26, 0.05), (-0.56, -0.08), -9, 0.035),
    ("cover", (0.17, 0.24, 0.03), (-0.55, -0.05), 22, 0.085),
    ("carton", (0.20, 0.16, 0.22), (0.48, 0.15), -25, 0.0),
    ("carton", (0.09, 0.09, 0.12), (0.40, -0.10), 35, 0.0),
    ("cover", (0.04, 0.17, 0.25), (-0.46, 0.25), 0, 0.0),
    ("cover", (0.05, 0.19, 0.28), (-0.41, 0.25), 0, 0.0),
    ("cover", (0.03, 0.17, 0.23), (-0.35, 0.25), 0, 0.0),
    ("board", (0.21, 0.297, 0.003), (0.14, -0.385), -12, 0.0),
)


def desk(values: Mapping[str, Any]) -> Parts:
    """A desk: a small volume whose landmarks are seen again and again."""
    stamps, t = clock(values, 30.0)
    return Parts(stamps, _orbit(t, stamps, values["layout"]), _desk_room(values["layout"]))


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


def _desk_room(layout: int) -> list[Rectangle]:
    board = Material(1.1, 0.75, "board", layout, 160, (0.01, 0.05))
    top = Material(1.5, 0.75, "wood", layout, 60, (0.006, 0.02))
    out = [
        rectangle(Material(9.0, 3.0, "plaster", layout), (-4.5, WALL_Y, 3.0), RIGHT, DOWN),
        rectangle(board, (-0.6, WALL_Y - 0.01, 1.85), RIGHT, DOWN),
        rectangle(Material(9.0, 3.0, "carpet", layout, 6), (-4.5, WALL_Y, 0), RIGHT, BACK),
        rectangle(top, (-0.75, WALL_Y - 0.05, TOP), RIGHT, BACK, occludes=True),
    ]
    for number, (material, size, place, turn, lift) in enumerate(_THINGS):
        T = placed((*place, TOP + lift), (np.deg2rad(turn), 0, 0))
        looks = Material(0, 0, material, 1000 * layout + 10 * number, 500, (0.006, 0.02))
        out += crate(size, looks, T_body_box=T, sides=("front", "left", "right", "top"))
    return out


FLOOR = -0.48  #: height of the laboratory's floor; the world's origin is the camera's first place [m]


def _laboratory(layout: int) -> list[Rectangle]:
    """The corner of a room: two walls with posters, the beacons of paper B's Fig. 9, and a floor."""
    rng = np.random.default_rng([layout, 46])
    top = FLOOR + 2.6
    out = [
        rectangle(Material(6.0, 2.6, "plaster", layout, 0.5), (-1.3, 2.0, top), RIGHT, DOWN),
        rectangle(Material(5.0, 2.6, "plaster", layout + 1, 0.5), (-1.3, -3.0, top), FORWARD, DOWN),
        rectangle(Material(6.0, 5.0, "carpet", layout, 8), (-1.3, 2.0, FLOOR), RIGHT, BACK),
        rectangle(Material(6.0, 5.0, "ceiling", layout), (-1.3, -3.0, top), RIGHT, FORWARD),
    ]
    for column in range(5):
        for row in range(3):
            width, height = rng.uniform(0.3, 0.5), rng.uniform(0.35, 0.5)
            poster = Material(width, height, "poster", int(rng.integers(1 << 30)), 120, (0.02, 0.06))
            along = -1.2 + 0.62 * column + rng.uniform(0, 0.1)
            z = FLOOR + 0.6 + 0.55 * row + rng.uniform(0, 0.05)
            out.append(rectangle(poster, (along, 1.99, z), RIGHT, DOWN))
            side = replace(poster, seed=int(rng.integers(1 << 30)))
            out.append(rectangle(side, (-1.29, 1.3 - 0.62 * column, z), FORWARD, DOWN))
    return out


#: Paper B, Table 1: displacement x, y, z [m] and yaw, pitch, roll [degrees] of the box at B0 to B3.
PLACES = np.array(
    [
        (-0.185, 0.900, 0.230, 0.0, 0.0, 0.0),
        (-0.100, 1.025, 0.067, 5.8, -15.1, -35.0),
        (-0.121, 0.775, 0.214, -8.6, 15.3, 52.6),
        (-0.221, 1.017, 0.265, 4.7, 38.9, -21.3),
    ]
)
REST, MOVE = 2.0, 1.5  #: how long the box stands at a place, and is on its way to the next [s]


def box(values: Mapping[str, Any]) -> Parts:
    """Paper B, 4.4: a box that stands at the four places of Table 1, one after another, with beacons around it."""
    stamps, t = clock(values, 4 * REST + 3 * MOVE)
    layout, size = values["layout"], np.array([0.24, 0.16, 0.20])
    lowest = np.array([-size[0], 0, -size[2]])  # its frame sits at the upper right corner of its front
    rectangles = _laboratory(layout) + carton(size, lowest, 1, 200 + layout)
    times = [i * (REST + MOVE) + wait for i in range(len(PLACES)) for wait in (0.0, REST)]
    x, y, z, *turns = (through(t, times, column) for column in np.repeat(PLACES, 2, axis=0).T)
    poses = watching(t, stamps, values["camera"], np.random.default_rng([layout, 51]))
    return Parts(stamps, poses, rectangles, placed((x, y, z), [np.deg2rad(turn) for turn in turns])[None])


#: Sizes of the boxes 1 to 3, and of the two parts of the articulated one, 4 and 5 [m].
SIZES = ((0.22, 0.18, 0.20), (0.26, 0.20, 0.24), (0.16, 0.16, 0.16), (0.26, 0.20, 0.12), (0.26, 0.20, 0.05))


def boxes(values: Mapping[str, Any]) -> Parts:
    """Several boxes with different velocities that hide each other and the scene; one has a lid on a hinge."""
    stamps, t = clock(values, 20.0)
    layout = values["layout"]
    rectangles = _laboratory(layout)
    for body, size in enumerate(np.array(SIZES), start=1):
        hinged = body >= 4  # the frames of both hinged parts lie in the hinge, at the upper rear edge of the lower part
        lowest = np.array([-size[0] / 2, -size[1], -size[2] if body == 4 else 0.0]) if hinged else -size / 2
        rectangles += carton(size, lowest, body, 300 + 10 * layout + body)
    poses = watching(t, stamps, values["camera"], np.random.default_rng([layout, 52]))
    return Parts(stamps, poses, rectangles, _box_poses(t))


def _box_poses(t: Array) -> Array:
    """Poses (5, N, 4, 4) of the boxes and of the two hinged parts."""
    wave = lambda period, phase=0.0: np.sin(2 * np.pi * t / period + phase)  # noqa: E731
    first = placed((-0.32 + 0.3 * wave(14.0), 1.0, -0.16 + 0.04 * wave(5.0)), (0.4 * wave(9.0), 0, 0))
    # The second goes the other way, behind the first, with stops.
    x = through(t, [1, 4, 6, 10, 12, 16, 18], [0.6, 0.0, 0.0, -0.6, -0.6, 0.3, 0.3])
    second = placed((x, 1.35, 0.16), (0.5 * wave(11.0, 1), 0.2 * wave(8.0), 0))
    x, y, z = -0.1 + 0.3 * wave(6.0, 2), 0.85 + 0.15 * wave(6.0, 0.5), 0.22 + 0.06 * wave(4.0)
    third = placed((x, y, z), (0.35 * t, 0, 0.4 * wave(7.0)))
    lower = placed((0.4 + 0.12 * wave(10.0), 1.15, -0.25), (0.4 + 0.3 * wave(13.0), 0, 0))
    opening = 0.6 - 0.6 * np.cos(2 * np.pi * t / 5.0)  # the lid turns about the hinge, up to 1.2 rad
    return np.stack([first, second, third, lower, lower @ placed((0, 0, 0), (0, 0, -opening))])


CAMERA = (0.03, -0.70, 0.027)  #: where the camera stands before the board, whose middle is the world's origin [m]


def startup(values: Mapping[str, Any]) -> Parts:
    """Paper B, 4.2: the camera stands before a board of features with known positions."""
    stamps, _ = clock(values, 5.0)
    layout, floor = values["layout"], -0.45  # the robot is half a metre tall
    offsets, angles = carried(stamps, np.random.default_rng([layout, 47]), gait=1.1, amount=0.1)
    rectangles = [
        rectangle(Signs(0.8, 0.6, "board", layout), (-0.4, 0, 0.3), RIGHT, DOWN),
        rectangle(Material(6.0, 2.5, "plaster", layout), (-3.0, 0.02, floor + 2.5), RIGHT, DOWN),
        rectangle(Material(6.0, 2.0, "carpet", layout, 6), (-3.0, 0.02, floor), RIGHT, BACK),
    ]
    return Parts(stamps, camera_poses(np.array(CAMERA) + offsets, *angles.T), rectangles)
