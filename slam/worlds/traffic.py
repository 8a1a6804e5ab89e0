"""A drive through two streets of a town, at the scale and rate of KITTI: with moving cars, or slowly among people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.drives import EYE, PACE, STEP, Road, in_a_car, interpolated
from slam.worlds.geometry import Parts, Rectangle, crate
from slam.worlds.paths import clock, placed, smooth_step, sway
from slam.worlds.streets import Streets, car
from slam.worlds.surfaces import Material

TURN_AT, TURN_LENGTH = 104.0, 30.0  #: where the turn to the left begins and how long it is [m along the path]
_LENGTH = 250.0  #: of the streets along the way [m]
_LANE = 3.2  #: to the oncoming lane [m]


def street(values: Mapping[str, Any]) -> Parts:
    """A drive past parked cars, with moving ones."""
    stamps, t = clock(values, 28.0)
    layout, moving = values["layout"], range(1, values["cars"] + 1)
    rng = np.random.default_rng([layout, 43])
    poses = in_a_car(*path(driven(t) + 0.3 * sway(t, rng, 0.03, 0.15)), stamps, rng)
    cars = [part for body in moving for part in car(np.eye(4), 5000 + 20 * layout + body, body)]
    objects = np.array([_drive(t, body) for body in moving]).reshape(-1, len(t), 4, 4)
    return Parts(stamps, poses, surroundings(layout) + cars, objects)


def driven(t: Array) -> Array:
    """Way driven at times t (N,) [m]: at an even pace, but more slowly through the turn."""
    middle, slower, duration = (TURN_AT + TURN_LENGTH / 2) / PACE, 2.5, 2.5
    return PACE * t - slower * duration * (np.tanh((t - middle) / duration) + np.tanh(middle / duration))


def _heading(s: Array) -> Array:
    """The way's turn to the left of +y (N,) [rad] at distances s (N,) [m] along it."""
    return np.pi / 2 * smooth_step((s - TURN_AT) / TURN_LENGTH)


def path(s: Array, across: Array | float = 0.0) -> tuple[Array, Array]:
    """Places (N, 2) [m] and headings (N,) [rad] at distances s [m] along the way, `across` [m] to the left of it."""
    step, heading = 0.02, _heading(s)
    grid = np.arange(-100.0, 420.0, step)
    yaw = _heading(grid)
    xy = step * np.cumsum(np.stack([-np.sin(yaw), np.cos(yaw)], axis=1), axis=0)
    xy -= xy[np.searchsorted(grid, 0.0)]
    left = np.stack([-np.cos(heading), -np.sin(heading)], axis=1)
    return interpolated(s, grid, xy) + np.reshape(across, (-1, 1)) * left, heading


def surroundings(layout: int) -> list[Rectangle]:
    """What stands still beside the way, and the ground."""
    along = np.arange(0.0, _LENGTH, STEP)
    places = np.column_stack([path(along)[0], np.full(len(along), EYE)])
    return Streets(Road.along(places), layout).rectangles()


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
    """A slow drive past parked cars, among cyclists and walkers whose legs swing about the hips."""
    stamps, t = clock(values, 14.0)
    layout = values["layout"]
    rng = np.random.default_rng([layout, 47])
    poses = in_a_car(*path(5.0 * t + 0.2 * sway(t, rng, 0.03, 0.15)), stamps, rng)
    rectangles, objects = surroundings(layout), []
    for number, (cycles, ahead, across, along, aside, pace) in enumerate(PEOPLE):
        rectangles += _person(cycles, 9000 + 50 * layout + 10 * number, PARTS * number + 1)
        place, heading = path(ahead + along * t, across + aside * t)
        T = placed((*place.T, 0), (heading + np.arctan2(aside, along), 0, 0))
        swing = _STRIDE * np.sin(2 * np.pi * pace * t + number)
        objects += [T, *(T @ placed((0 * t, 0, HIP), (0, 0, side * swing)) for side in (1.0, -1.0))]
    return Parts(stamps, poses, rectangles, np.array(objects))


def _person(cycles: bool, seed: int, body: int) -> list[Rectangle]:
    """Trunk and head (a cyclist's with the bicycle) as `body`, and the legs as the next two; boxes of cloth."""
    boxes = [((0.46, 0.28, 0.62), (-0.23, -0.14, HIP), 0, 0), ((0.2, 0.22, 0.26), (-0.1, -0.11, HIP + 0.62), 1, 0)]
    boxes += [((0.08, 1.7, 0.45), (-0.04, -0.85, 0.1), 2, 0)] if cycles else []
    boxes += [((0.16, 0.18, 0.8), (x, -0.09, -0.85), 2 + leg, leg) for leg, x in ((1, -0.2), (2, 0.04))]
    out = []
    for size, corner, number, part in boxes:
        out += crate(size, Material(0, 0, "carton", 20 * (seed + number), 60, (0.02, 0.08)), corner, body + part)
    return out
