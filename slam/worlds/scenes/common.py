"""What the built-in worlds share: the rig, the clock, and putting a world together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from slam.data import IdArray
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, so3_exp
from slam.worlds.geometry import Rectangle, cuboid, place_landmarks, rectangle
from slam.worlds.paths import camera_poses, carried
from slam.worlds.textures.surfaces import Material
from slam.worlds.world import World

_TOE_IN = 0.06  # each camera of the toed-in rig turns this far inwards [rad]


def make_rig(values: Mapping[str, Any], focal: float) -> StereoRig:
    """The rig of the options; `focal` [px] is meant for the image width that the world has by default."""
    width, height, baseline = values["width"], values["height"], values["baseline"]
    if values["rig"] == "rectified":
        return StereoRig.rectified_pair(focal, (width - 1) / 2, (height - 1) / 2, baseline, width, height)
    return toed_in_rig(focal, width, height, baseline)


def toed_in_rig(f: float, width: int, height: int, baseline: float) -> StereoRig:
    """A pair as built by hand: axes crossing, slightly rolled, unequal cameras with lens distortion."""
    s = width / 320
    left = PinholeCamera(
        f, f * 1.004, (width - 1) / 2 + 2.3 * s, (height - 1) / 2 - 1.7 * s, width, height,
        "radtan", (-0.16, 0.05, 0.0006, -0.0004),
    )  # fmt: skip
    right = PinholeCamera(
        f * 1.012, f * 1.009, (width - 1) / 2 - 1.9 * s, (height - 1) / 2 + 2.6 * s, width, height,
        "radtan", (-0.15, 0.04, -0.0005, 0.0007),
    )  # fmt: skip
    R = so3_exp(np.array([0.008, 2 * _TOE_IN, 0.012]))
    direction = np.array([-np.cos(_TOE_IN), 0.01, -np.sin(_TOE_IN)])
    return StereoRig(left, right, R, baseline * direction / np.linalg.norm(direction))


def clock(values: Mapping[str, Any], duration: float) -> tuple[Array, Array]:
    """Stamps [s] of the frames, and where they are on the path: its time [s] at the usual pace.

    `duration` [s] is the path's at the usual pace; the option `frames` cuts it short (or runs it on).
    """
    frames = values["frames"] or max(1, round(duration * values["rate"] / values["speed"]))
    stamps = np.arange(frames) / values["rate"]
    return stamps, stamps * values["speed"]


def assemble(
    name: str, kind: str, values: Mapping[str, Any], rig: StereoRig, stamps: Array, T_world_left: Array,
    rectangles: Iterable[Rectangle], reach: tuple[float, float], texels: float,
    T_world_object: Array | None = None, lasting: IdArray | None = None, alike: bool = False,
) -> World:  # fmt: skip
    """A world with its landmarks chosen; the arguments are the world's attributes, and `alike` of `place_landmarks`."""
    surfaces = tuple(rectangles)
    landmarks = place_landmarks(surfaces, values["density"], np.random.default_rng([values["layout"], 31]), alike)
    objects = np.zeros((0, len(stamps), 4, 4)) if T_world_object is None else T_world_object
    return World(name, kind, rig, stamps, T_world_left, surfaces, landmarks, objects, reach, texels, lasting=lasting)


#: The axes along which the sides of a box are wide and high.
SIDES = {"front": (0, 2), "back": (0, 2), "left": (1, 2), "right": (1, 2), "top": (0, 1), "bottom": (0, 1)}


def crate(
    size: Sequence[float] | Array, looks: Material, corner: Iterable[float] = (0, 0, 0), body: int = 0,
    T_body_box: Array | None = None, sides: Iterable[str] = SIDES,
) -> list[Rectangle]:  # fmt: skip
    """The `sides` of a box, each a piece of its own like `looks`; thin ones are left out. See `cuboid`."""
    faces = {}
    for i, (side, wide, high) in enumerate((side, size[SIDES[side][0]], size[SIDES[side][1]]) for side in sides):
        if min(wide, high) > 0.01:
            faces[side] = replace(looks, width=wide, height=high, seed=looks.seed + i)
    return cuboid(faces, size, corner, body, T_body_box)


def carton(size: Array, lowest: Array, body: int, seed: int) -> list[Rectangle]:
    """All six sides of a printed carton with edges `size` (3,) [m] from its `lowest` corner (3,) in body axes."""
    return crate(size, Material(0, 0, "carton", 10 * seed, 250, (0.01, 0.03)), lowest, body)


def laboratory(layout: int, floor: float) -> list[Rectangle]:
    """The corner of a room: two walls with posters, the beacons of paper B's Fig. 9, and a floor at height `floor`."""
    rng = np.random.default_rng([layout, 46])
    top = floor + 2.6
    out = [
        rectangle(Material(6.0, 2.6, "plaster", layout, 0.5), (-1.3, 2.0, top), (1, 0, 0), (0, 0, -1)),
        rectangle(Material(5.0, 2.6, "plaster", layout + 1, 0.5), (-1.3, -3.0, top), (0, 1, 0), (0, 0, -1)),
        rectangle(Material(6.0, 5.0, "carpet", layout, 8), (-1.3, 2.0, floor), (1, 0, 0), (0, -1, 0)),
        rectangle(Material(6.0, 5.0, "ceiling", layout), (-1.3, -3.0, top), (1, 0, 0), (0, 1, 0)),
    ]
    for column in range(5):
        for row in range(3):
            width, height = rng.uniform(0.3, 0.5), rng.uniform(0.35, 0.5)
            poster = Material(width, height, "poster", int(rng.integers(1 << 30)), 120, (0.02, 0.06))
            along = -1.2 + 0.62 * column + rng.uniform(0, 0.1)
            z = floor + 0.6 + 0.55 * row + rng.uniform(0, 0.05)
            out.append(rectangle(poster, (along, 1.99, z), (1, 0, 0), (0, 0, -1)))
            side = Material(width, height, "poster", int(rng.integers(1 << 30)), 120, (0.02, 0.06))
            out.append(rectangle(side, (-1.29, 1.3 - 0.62 * column, z), (0, 1, 0), (0, 0, -1)))
    return out


#: How the camera moves in worlds where objects do: the words of the option ``camera``.
CAMERAS = ("still", "sway", "moving")


def watching(t: Array, stamps: Array, way: str, rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) of a camera at the world's origin that looks along +y.

    Args:
        t: path times (N,) [s].
        stamps: times (N,) [s] of the sway.
        way: still; sway, as a robot that stands; or moving, half a metre to and fro.
        rng: of its sway.
    """
    zero = np.zeros(len(t))
    if way == "still":
        return camera_poses(np.zeros((len(t), 3)), zero, zero, zero)
    offsets, angles = carried(stamps, rng, gait=1.1, amount=0.3)
    x = 0.25 * np.sin(2 * np.pi * t / 8.0) if way == "moving" else zero
    y = 0.10 * np.sin(2 * np.pi * t / 13.0) if way == "moving" else zero
    positions = offsets + np.stack([x, y, zero], axis=1)
    return camera_poses(positions, 0.5 * x + angles[:, 0], angles[:, 1], angles[:, 2])
