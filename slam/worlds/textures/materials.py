"""Painting walls, floors, furniture and boxes; the names are those of `Material.material`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from slam.errors import UnknownNameError
from slam.geometry.se3 import Array
from slam.worlds.textures import outdoors, paint, things
from slam.worlds.textures.paint import Area, Colour

_INKS: tuple[Colour, ...] = ((25, 30, 40), (235, 240, 240), (40, 40, 170), (150, 70, 30))

Painter = Callable[["tuple[int, int]", np.random.Generator, float], np.ndarray]


def paint_material(name: str, area: Area, spots: Array, seed: int, density: float) -> np.ndarray:
    """The picture of a piece of material, BGR uint8.

    Args:
        name: of the material.
        area: height, width [m].
        spots: things scattered over it (N, 3): x, y, diameter [m].
        seed: which piece.
        density: texels per metre.

    Raises:
        UnknownNameError: there is no such material.
    """
    try:
        recipe = RECIPES[name]
    except KeyError:
        raise UnknownNameError(f"unknown material {name!r}; known: {', '.join(RECIPES)}") from None
    rng = np.random.default_rng([seed, 63])
    density *= recipe.detail
    size = max(1, round(area[0] * density)), max(1, round(area[1] * density))
    canvas = recipe.ground(size, rng, density)
    for x, y, diameter in spots * density:
        recipe.spot(canvas, x, y, diameter, rng)
    return canvas


def _plaster(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A painted wall: nearly nothing to see."""
    light = 1 + 0.012 * paint.clouds(size, rng, 0.6 * density) + 0.006 * paint.clouds(size, rng, 0.01 * density, 2)
    return paint.tinted(light, (200.0, 212.0, 218.0))


def _carpet(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A carpet of short loops."""
    light = 1 + 0.10 * paint.clouds(size, rng, 0.008 * density, 2) + 0.05 * paint.clouds(size, rng, 0.15 * density)
    return paint.tinted(light, (105.0, 85.0, 75.0))


def _ceiling(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """Ceiling panels with lamps."""
    canvas = paint.tinted(1 + 0.01 * paint.clouds(size, rng, 0.05 * density), (205.0, 210.0, 212.0))
    step = 0.6 * density
    for x in np.arange(0, size[1], step):
        paint.bar(canvas, (x - 0.006 * density, 0, 0.012 * density, size[0]), (150.0, 155.0, 158.0))
    for y in np.arange(0, size[0], step):
        paint.bar(canvas, (0, y - 0.006 * density, size[1], 0.012 * density), (150.0, 155.0, 158.0))
    for x in np.arange(step, size[1] - step, 4 * step):
        paint.bar(canvas, (x + 0.1 * step, step * 1.2, 1.8 * step, 0.6 * step), (255.0, 255.0, 255.0))
    return canvas


def _door_wall(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A wall with a door and notices."""
    canvas = _plaster(size, rng, density)
    height, width = size
    wide, high = 0.9 * density, 2.05 * density
    left = (width - wide) / 2
    paint.bar(
        canvas, (left - 0.06 * density, height - high - 0.06 * density, wide + 0.12 * density, high), (120, 130, 135)
    )
    door = paint.wood((round(wide), round(high)), rng, (90.0, 120.0, 150.0), density).transpose(1, 0, 2)
    x, y = round(left), height - round(high)
    canvas[y : y + door.shape[0], x : x + door.shape[1]] = door[: height - y, : width - x]
    paint.dot(canvas, left + 0.86 * wide, height - 1.05 * density, 0.03 * density, (190.0, 195.0, 200.0))
    sheet = (left + 0.3 * wide, height - 1.7 * density, 0.3 * density, 0.4 * density)
    things.sheet(canvas, sheet, rng)
    return canvas


def _carton(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A side of a carton: brown board, tape, print and a label."""
    height, width = size
    ribs = paint.grain(size, rng, (2.0, 0.2 * density))
    canvas = paint.tinted(1 + 0.03 * ribs + 0.04 * paint.clouds(size, rng, 0.1 * density), (105.0, 150.0, 185.0))
    paint.bar(canvas, (0, 0.44 * height, width, 0.12 * height), (130.0, 175.0, 205.0))
    ink = (35.0, 45.0, 60.0)
    paint.lettering(canvas, paint.words(rng, 6), (0.08 * width, 0.1 * height, 0.5 * width, 0.2 * height), ink, rng)
    label = (rng.uniform(0.45, 0.55) * width, 0.55 * height, 0.4 * width, 0.36 * height)
    paint.bar(canvas, label, (235.0, 240.0, 240.0))
    x = label[0] + 0.08 * label[2]
    while x < label[0] + 0.9 * label[2]:  # a bar code
        w = rng.uniform(0.01, 0.035) * label[2]
        paint.bar(canvas, (x, label[1] + 0.1 * label[3], w, 0.4 * label[3]), (20.0, 20.0, 20.0))
        x += w + rng.uniform(0.015, 0.05) * label[2]
    lines = (label[0] + 0.08 * label[2], label[1] + 0.58 * label[3], 0.84 * label[2], 0.36 * label[3])
    paint.text_lines(canvas, lines, 0.12 * label[3], ink, rng)
    for edge in ((0, 0, width, 1.5), (0, height - 1.5, width, 1.5), (0, 0, 1.5, height), (width - 1.5, 0, 1.5, height)):
        paint.bar(canvas, edge, (60.0, 90.0, 115.0))
    return canvas


def _no_spot(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """Nothing."""


def _fleck(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """A faint round fleck, darker or brighter than what is around it."""
    here = canvas[min(int(y), len(canvas) - 1), min(int(x), canvas.shape[1] - 1)].astype(float)
    b, g, r = np.clip(here * (0.75 if rng.random() < 0.6 else 1.25), 0, 255)
    paint.dot(canvas, x, y, diameter / 2, (b, g, r))


def _print(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """A printed sign: a letter, a disc or a square in strong ink."""
    ink = _INKS[int(rng.integers(len(_INKS)))]
    kind = int(rng.integers(3))
    if kind == 0:
        paint.dot(canvas, x, y, diameter / 2, ink)
    elif kind == 1:
        paint.bar(canvas, (x - 0.4 * diameter, y - 0.4 * diameter, 0.8 * diameter, 0.8 * diameter), ink)
    else:
        box = (x - diameter / 2, y - diameter / 2, diameter, diameter)
        paint.lettering(canvas, paint.words(rng, 3).replace(" ", "")[0], box, ink, rng)


class Recipe(NamedTuple):
    """How to paint a material.

    Attributes:
        ground: paints the whole piece.
        spot: paints one of the scattered things.
        detail: how finely, as a share of the texels asked for: plain surfaces need fewer.
    """

    ground: Painter
    spot: Callable[..., None] = _no_spot
    detail: float = 1.0


RECIPES = {
    "plaster": Recipe(_plaster, _fleck, 0.25),
    "carpet": Recipe(_carpet, _fleck, 0.5),
    "ceiling": Recipe(_ceiling, _no_spot, 0.5),
    "door_wall": Recipe(_door_wall, _fleck),
    "carton": Recipe(_carton, _print),
    "board": Recipe(things.board, _print),
    "wood": Recipe(things.wood, _fleck),
    "pinboard": Recipe(things.pinboard),
    "cover": Recipe(things.cover, _print),
    "screen": Recipe(things.screen),
    "keyboard": Recipe(things.keyboard),
    "paper": Recipe(things.paper),
    "poster": Recipe(things.poster, _print),
    "asphalt": Recipe(outdoors.asphalt, _fleck, 0.5),
    "road": Recipe(outdoors.road, _fleck),
    "road_across": Recipe(outdoors.road_across, _fleck),
    "car_side": Recipe(outdoors.car_side),
    "car_front": Recipe(partial(outdoors.car_end, lamp=(235.0, 240.0, 240.0))),
    "car_back": Recipe(partial(outdoors.car_end, lamp=(45.0, 45.0, 200.0))),
    "car_top": Recipe(outdoors.paintwork),
    "cabin_side": Recipe(outdoors.cabin_side),
    "cabin_end": Recipe(outdoors.cabin_end),
    "field": Recipe(outdoors.field, _fleck),
}
