"""Driving through a town at the scale and rate of KITTI, with parked and moving cars."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.geometry import Rectangle, rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, smooth_step, sway, yaw_pitch_roll
from slam.worlds.scenes.common import assemble, clock, make_rig
from slam.worlds.scenes.roadside import car
from slam.worlds.textures.surfaces import Facade, Material
from slam.worlds.world import World

TEXT = "a drive through a town at KITTI's scale and rate, with parked and moving cars and a turn to the left"
OPTIONS = (Option("cars", 3, "moving cars", 0, 3),)
DEFAULTS: dict[str, Any] = {
    "rate": 10.0, "width": 1241, "height": 376, "baseline": 0.54, "density": 0.6, "lens": 0.6,
}  # fmt: skip

FOCAL = 718.856
PACE = 8.0  #: driving speed [m/s]
DURATION = 28.0  #: [s]
EYE = 1.65  #: height of the camera [m]
TURN_AT, TURN_LENGTH = 104.0, 30.0  #: where the turn to the left begins and how long it is [m along the path]
LEFT, RIGHT = -9.0, 7.0  #: house fronts left and right of the path [m]
_LANE = 3.2  #: to the oncoming lane [m]


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    layout = values["layout"]
    rig = make_rig(values, FOCAL * values["width"] / 1241)
    rng = np.random.default_rng([layout, 43])
    xy, yaw = path(driven(t) + 0.3 * sway(t, rng, 0.03, 0.15))
    positions = np.column_stack([xy, EYE + 0.01 * sway(stamps, rng, 0.8, 2)])
    poses = camera_poses(positions, yaw, 0.003 * sway(stamps, rng, 0.8, 2), 0.002 * sway(stamps, rng, 0.8, 2))
    rectangles = surroundings(layout)
    for body in range(1, values["cars"] + 1):
        rectangles += car(np.eye(4), 5000 + 20 * layout + body, body)
    objects = np.array([_drive(t, body) for body in range(1, values["cars"] + 1)]).reshape(-1, len(t), 4, 4)
    return assemble("street", "driving", values, rig, stamps, poses, rectangles, (4.0, 60.0), 64.0, objects)


def surroundings(layout: int) -> list[Rectangle]:
    """What stands still: houses, the ground, parked cars."""
    return _houses(layout) + _ground(layout) + _parked_cars(layout)


def driven(t: Array) -> Array:
    """Way driven at times t (N,) [m]: at an even pace, but more slowly through the turn."""
    middle, slower, duration = (TURN_AT + TURN_LENGTH / 2) / PACE, 2.5, 2.5
    return PACE * t - slower * duration * (np.tanh((t - middle) / duration) + np.tanh(middle / duration))


def path(s: Array, across: float = 0.0) -> tuple[Array, Array]:
    """Places (N, 2) [m] and headings (N,) [rad] at distances s [m] along the way, `across` [m] to the left of it."""
    step = 0.02
    grid = np.arange(-100.0, 420.0, step)
    yaw = np.pi / 2 * smooth_step((grid - TURN_AT) / TURN_LENGTH)
    xy = step * np.cumsum(np.stack([-np.sin(yaw), np.cos(yaw)], axis=1), axis=0)
    xy -= xy[np.searchsorted(grid, 0.0)]
    heading = np.pi / 2 * smooth_step((s - TURN_AT) / TURN_LENGTH)
    place = np.stack([np.interp(s, grid, xy[:, 0]), np.interp(s, grid, xy[:, 1])], axis=1)
    left = np.stack([-np.cos(heading), -np.sin(heading)], axis=1)
    return place + across * left, heading


def _corner() -> float:
    """The y at which the second street runs [m]."""
    return float(path(np.array([TURN_AT + TURN_LENGTH]))[0][0, 1])


def _houses(layout: int) -> list[Rectangle]:
    """House fronts along both streets, and across the end of the second."""
    y2 = _corner()
    west = -150.0
    rows = [  # from, to, along which front's upper edge runs to the right as seen from the street
        ((LEFT, -30.0), (LEFT, y2 + LEFT)),
        ((RIGHT, y2 + RIGHT), (RIGHT, -30.0)),
        ((west, y2 + RIGHT), (RIGHT, y2 + RIGHT)),
        ((LEFT, y2 + LEFT), (west, y2 + LEFT)),
        ((west, y2 + LEFT), (west, y2 + RIGHT)),
    ]
    out = []
    for number, (a, b) in enumerate(rows):
        rng = np.random.default_rng([layout, 44, number])
        start, direction = np.array(a), np.array(b) - a
        length = float(np.linalg.norm(direction))
        direction = direction / length
        at = 0.0
        while at < length - 1e-6:
            width = float(min(rng.uniform(9, 18), length - at))
            width = length - at if length - at - width < 5 else width
            height = float(rng.uniform(7, 12))
            facade = Facade(width, height, int(rng.integers(1 << 30)))
            corner = start + at * direction
            out.append(rectangle(facade, (*corner, height), (*direction, 0), (0, 0, -1), occludes=True))
            at += width
    return out


def _ground(layout: int) -> list[Rectangle]:
    """Road and pavement of both streets."""
    y2 = _corner()
    width = RIGHT - LEFT
    first = Material(width, y2 + 30 + RIGHT, "road", layout, 0.3, (0.05, 0.3))
    second = Material(150.0 + LEFT, width, "road_across", layout + 1, 0.3, (0.05, 0.3))
    return [
        rectangle(first, (LEFT, y2 + RIGHT, 0), (1, 0, 0), (0, -1, 0)),
        rectangle(second, (-150.0, y2 + RIGHT, 0), (1, 0, 0), (0, -1, 0)),
    ]


def _parked_cars(layout: int) -> list[Rectangle]:
    """Cars at both kerbs."""
    rng = np.random.default_rng([layout, 45])
    out = []
    for side in (-3.9, 6.6):  # to the right, and to the left beyond the oncoming lane
        s = -5.0
        number = 0
        while s < 230:
            s += rng.uniform(6, 14)
            number += 1
            if TURN_AT - 9 < s < TURN_AT + TURN_LENGTH + 9:
                continue
            place, heading = path(np.array([s]), side)
            turn = heading[0] + (np.pi if side > 0 else 0.0) + rng.normal(0, 0.02)
            T = pose(yaw_pitch_roll(turn, 0, 0), np.array([*place[0], 0.0]))
            out += car(T, 100 * layout + 1000 * (side > 0) + number)
    return out


def _drive(t: Array, number: int) -> Array:
    """Poses (N, 4, 4) of a moving car: 1 drives ahead, 2 comes towards the camera, 3 does so later."""
    if number == 1:
        s, across, turn = 14 + driven(t) + 5 * np.sin(2 * np.pi * t / 19), 0.0, 0.0
    else:
        s = (95.0 if number == 2 else 330.0) - (7.0 if number == 2 else 9.0) * t
        across, turn = _LANE, np.pi
    place, heading = path(s, across)
    R = np.array([yaw_pitch_roll(h + turn, 0, 0) for h in heading])
    return pose(R, np.column_stack([place, np.zeros(len(t))]))
