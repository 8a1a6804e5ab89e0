"""A slow drive past parked cars, among cyclists and walkers whose arms and legs swing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, pose
from slam.worlds.geometry import Rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, sway, yaw_pitch_roll
from slam.worlds.scenes import street
from slam.worlds.scenes.common import assemble, clock, crate, make_rig
from slam.worlds.textures.surfaces import Material
from slam.worlds.world import World

TEXT = "a slow drive past parked cars, among cyclists and walkers whose legs swing"
OPTIONS: tuple[Option, ...] = ()
DEFAULTS = street.DEFAULTS

PACE = 5.0  #: driving speed [m/s]
DURATION = 14.0  #: [s]
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


def build(values: Mapping[str, Any]) -> World:
    """The world of these options."""
    stamps, t = clock(values, DURATION)
    layout = values["layout"]
    rig = make_rig(values, street.FOCAL * values["width"] / 1241)
    rng = np.random.default_rng([layout, 47])
    xy, yaw = street.path(PACE * t + 0.2 * sway(t, rng, 0.03, 0.15))
    positions = np.column_stack([xy, street.EYE + 0.01 * sway(stamps, rng, 0.8, 2)])
    poses = camera_poses(positions, yaw, 0.003 * sway(stamps, rng, 0.8, 2), 0.002 * sway(stamps, rng, 0.8, 2))
    rectangles, objects = street.surroundings(layout), np.zeros((0, len(t), 4, 4))
    for number, (cycles, ahead, across, along, aside, pace) in enumerate(PEOPLE):
        rectangles += _person(cycles, 9000 + 50 * layout + 10 * number, PARTS * number + 1)
        place = _ways(t, ahead, across, along, aside)
        objects = np.concatenate([objects, _limbs(place, np.sin(2 * np.pi * pace * t + number))])
    return assemble("people", "driving", values, rig, stamps, poses, rectangles, (4.0, 60.0), 64.0, objects)


def _ways(t: Array, ahead: float, across: float, along: float, aside: float) -> Array:
    """Poses (N, 4, 4) of somebody's feet, y ahead of him; see `PEOPLE`."""
    place, heading = street.path(ahead + along * t)
    left = np.column_stack([-np.cos(heading), -np.sin(heading)])
    place = place + (across + aside * t)[:, None] * left
    turn = np.arctan2(aside, along)
    R = np.array([yaw_pitch_roll(h + turn, 0, 0) for h in heading])
    return pose(R, np.column_stack([place, np.zeros(len(t))]))


def _limbs(T: Array, swing: Array) -> Array:
    """Poses (3, N, 4, 4) of the trunk and of both legs, which turn about the hips by `swing` (N,) times a stride."""
    legs = []
    for side in (1.0, -1.0):
        hip = np.array([yaw_pitch_roll(0, 0, side * _STRIDE * s) for s in swing])
        legs.append(T @ pose(hip, np.tile([0.0, 0.0, HIP], (len(swing), 1))))
    return np.stack([T, *legs])


def _person(cycles: bool, seed: int, body: int) -> list[Rectangle]:
    """Trunk and head (a cyclist's with the bicycle) as `body`, and the legs as the next two."""
    wide, deep = 0.46, 0.28
    out = _clothed((wide, deep, 0.62), (-wide / 2, -deep / 2, HIP), seed, body)
    out += _clothed((0.2, 0.22, 0.26), (-0.1, -0.11, HIP + 0.62), seed + 1, body)
    if cycles:
        out += _clothed((0.08, 1.7, 0.45), (-0.04, -0.85, 0.1), seed + 2, body)
    for leg, x in ((1, -0.2), (2, 0.04)):
        out += _clothed((0.16, 0.18, 0.8), (x, -0.09, -0.85), seed + 2 + leg, body + leg)
    return out


def _clothed(size: Sequence[float], corner: Sequence[float], seed: int, body: int) -> list[Rectangle]:
    """A box of cloth."""
    return crate(size, Material(0, 0, "carton", 20 * seed, 60, (0.02, 0.08)), corner, body)
