"""A drive through two streets of a town, at the scale and rate of KITTI: with moving cars, or slowly among people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.geometry import Parts, Rectangle, crate, cuboid, rectangle
from slam.worlds.paths import camera_poses, clock, placed, smooth_step, sway, yaw_pitch_roll
from slam.worlds.surfaces import Facade, Material


def car(T: Array, seed: int, body: int = 0) -> list[Rectangle]:
    """A car of two boxes; its frame: origin on the ground in its middle, y ahead."""
    out = []
    parts = (
        ((1.75, 4.3, 0.75), (-0.875, -2.15, 0.2), ("car_back", "car_front", "car_side")),
        ((1.5, 2.3, 0.55), (-0.75, -1.35, 0.95), ("cabin_end", "cabin_end", "cabin_side")),
    )
    for size, corner, (rear, fore, side) in parts:
        x, y, z = size
        sides = {"front": (rear, x, z), "back": (fore, x, z), "left": (side, y, z), "right": (side, y, z)}
        faces = {face: Material(a, b, name, seed, 12, (0.05, 0.25)) for face, (name, a, b) in sides.items()}
        faces["top"] = Material(x, y, "car_top", seed, 1, (0.05, 0.2))
        out += cuboid(faces, size, corner, body, T)
    return out


def trunk(T: Array, seed: int) -> list[Rectangle]:
    """The trunk of a tree, a square post; its frame: origin on the ground in its middle."""
    return _post(T, (0.35, 0.35, 4.0), "wood", seed)


def cabinet(T: Array, seed: int) -> list[Rectangle]:
    """A switch cabinet full of bills; its frame: origin on the ground in its middle."""
    return _post(T, (1.0, 0.5, 1.4), "poster", seed)


def _post(T: Array, size: tuple[float, float, float], material: str, seed: int) -> list[Rectangle]:
    """A box that stands on the ground."""
    looks = Material(0, 0, material, 10 * seed, 12, (0.05, 0.25))
    corner = (-size[0] / 2, -size[1] / 2, 0)
    return crate(size, looks, corner, T_body_box=T, sides=("front", "back", "left", "right"))


PACE = 8.0  #: driving speed [m/s]
EYE = 1.65  #: height of the camera above the ground [m]
TURN_AT, TURN_LENGTH = 104.0, 30.0  #: where the turn to the left begins and how long it is [m along the path]
LEFT, RIGHT = -9.0, 7.0  #: house fronts left and right of the path [m]
WEST = -150.0  #: end of the second street [m]
_LANE = 3.2  #: to the oncoming lane [m]


def driver(s: Array, stamps: Array, rng: np.random.Generator) -> Array:
    """Camera poses (N, 4, 4) at distances s (N,) [m] along the way, shaken at times `stamps` [s]."""
    xy, yaw = path(s)
    positions = np.column_stack([xy, EYE + 0.01 * sway(stamps, rng, 0.8, 2)])
    return camera_poses(positions, yaw, 0.003 * sway(stamps, rng, 0.8, 2), 0.002 * sway(stamps, rng, 0.8, 2))


def street(values: Mapping[str, Any]) -> Parts:
    """A drive past parked cars, with moving ones."""
    stamps, t = clock(values, 28.0)
    layout, moving = values["layout"], range(1, values["cars"] + 1)
    rng = np.random.default_rng([layout, 43])
    poses = driver(driven(t) + 0.3 * sway(t, rng, 0.03, 0.15), stamps, rng)
    cars = [part for body in moving for part in car(np.eye(4), 5000 + 20 * layout + body, body)]
    objects = np.array([_drive(t, body) for body in moving]).reshape(-1, len(t), 4, 4)
    return Parts(stamps, poses, surroundings(layout) + cars, objects)


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
    rows = [  # from, to, along which front's upper edge runs to the right as seen from the street
        ((LEFT, -30.0), (LEFT, y2 + LEFT)),
        ((RIGHT, y2 + RIGHT), (RIGHT, -30.0)),
        ((WEST, y2 + RIGHT), (RIGHT, y2 + RIGHT)),
        ((LEFT, y2 + LEFT), (WEST, y2 + LEFT)),
        ((WEST, y2 + LEFT), (WEST, y2 + RIGHT)),
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
            house = Facade(width, height, int(rng.integers(1 << 30)))
            corner = start + at * direction
            out.append(rectangle(house, (*corner, height), (*direction, 0), (0, 0, -1), occludes=True))
            at += width
    return out


def _ground(layout: int) -> list[Rectangle]:
    """Road and pavement of both streets."""
    y2, width = _corner(), RIGHT - LEFT
    first = Material(width, y2 + 30 + RIGHT, "road", layout, 0.3, (0.05, 0.3))
    second = Material(-WEST + LEFT, width, "road_across", layout + 1, 0.3, (0.05, 0.3))
    return [rectangle(m, (x, y2 + RIGHT, 0), (1, 0, 0), (0, -1, 0)) for m, x in ((first, LEFT), (second, WEST))]


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
    return placed((*place.T, 0), (heading + turn, 0, 0))


PARTS = 3  #: bodies a person is made of: the trunk (with the bicycle), and two legs
HIP = 0.9  #: height of the hips [m]
_STRIDE = 0.45  # how far a leg swings to both sides [rad]


#: Who moves how: whether on a bicycle, where at the start and to which side of the way [m], how fast along and across
#: [m/s], and steps (turns of the pedals) a second [Hz].
PEOPLE = (
    (True, 11.0, -1.6, 4.2, 0.0, 1.1),
    (False, 16.0, -2.5, 1.4, 0.0, 0.9),
    (True, 62.0, 2.6, -4.8, 0.0, 1.2),
    (False, 38.0, 4.5, 0.0, -1.3, 0.8),
    (False, 55.0, 3.6, -1.2, 0.0, 0.9),
)


def people(values: Mapping[str, Any]) -> Parts:
    """A slow drive past parked cars, among cyclists and walkers whose legs swing."""
    stamps, t = clock(values, 14.0)
    layout = values["layout"]
    rng = np.random.default_rng([layout, 47])
    poses = driver(5.0 * t + 0.2 * sway(t, rng, 0.03, 0.15), stamps, rng)
    rectangles, objects = surroundings(layout), np.zeros((0, len(t), 4, 4))
    for number, (cycles, ahead, across, along, aside, pace) in enumerate(PEOPLE):
        rectangles += _person(cycles, 9000 + 50 * layout + 10 * number, PARTS * number + 1)
        place = _ways(t, ahead, across, along, aside)
        objects = np.concatenate([objects, _limbs(place, np.sin(2 * np.pi * pace * t + number))])
    return Parts(stamps, poses, rectangles, objects)


def _ways(t: Array, ahead: float, across: float, along: float, aside: float) -> Array:
    """Poses (N, 4, 4) of somebody's feet, y ahead of him; see `PEOPLE`."""
    place, heading = path(ahead + along * t)
    left = np.column_stack([-np.cos(heading), -np.sin(heading)])
    place = place + (across + aside * t)[:, None] * left
    return placed((*place.T, 0), (heading + np.arctan2(aside, along), 0, 0))


def _limbs(T: Array, swing: Array) -> Array:
    """Poses (3, N, 4, 4) of the trunk and of both legs, which turn about the hips by `swing` (N,) times a stride."""
    return np.stack([T, *(T @ placed((0 * swing, 0, HIP), (0, 0, side * _STRIDE * swing)) for side in (1.0, -1.0))])


def _person(cycles: bool, seed: int, body: int) -> list[Rectangle]:
    """Trunk and head (a cyclist's with the bicycle) as `body`, and the legs as the next two; boxes of cloth."""
    boxes = [((0.46, 0.28, 0.62), (-0.23, -0.14, HIP), 0, 0), ((0.2, 0.22, 0.26), (-0.1, -0.11, HIP + 0.62), 1, 0)]
    boxes += [((0.08, 1.7, 0.45), (-0.04, -0.85, 0.1), 2, 0)] if cycles else []
    boxes += [((0.16, 0.18, 0.8), (x, -0.09, -0.85), 2 + leg, leg) for leg, x in ((1, -0.2), (2, 0.04))]
    out = []
    for size, corner, number, part in boxes:
        out += crate(size, Material(0, 0, "carton", 20 * (seed + number), 60, (0.02, 0.08)), corner, body + part)
    return out
