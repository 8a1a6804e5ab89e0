"""What stands at the side of a road: cars, trees, signs."""

from __future__ import annotations

from slam.geometry.se3 import Array
from slam.worlds.geometry import Rectangle, cuboid
from slam.worlds.scenes.common import crate
from slam.worlds.textures.surfaces import Material


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
