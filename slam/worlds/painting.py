"""Painting what stands indoors, and all materials by their names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from slam.errors import UnknownNameError
from slam.worlds import brushes, streetside
from slam.worlds.books import paint_bay
from slam.worlds.brushes import Box, Colour, Size
from slam.worlds.geometry import Texture
from slam.worlds.surfaces import Bay, Material

_INKS: tuple[Colour, ...] = ((25, 30, 40), (235, 240, 240), (40, 40, 170), (150, 70, 30))
Painter = Callable[["tuple[int, int]", np.random.Generator, float], np.ndarray]


def paint(piece: Texture, density: float) -> np.ndarray:
    """The picture of a texture, BGR uint8 (round(height · density), round(width · density), 3), texels per metre.

    A texture of another class paints itself: its ``paint(density)`` is called.

    Raises:
        UnknownNameError: there is no such material.
    """
    if isinstance(piece, Bay):
        return paint_bay(piece, density)
    if not isinstance(piece, Material):
        picture: np.ndarray = piece.paint(density)  # type: ignore[attr-defined]
        return picture
    if piece.material in WHOLE:
        return WHOLE[piece.material](piece, density)
    try:
        recipe = PAINTERS[piece.material]
    except KeyError:
        known = ", ".join((*PAINTERS, *WHOLE))
        raise UnknownNameError(f"unknown material {piece.material!r}; known: {known}") from None
    rng = np.random.default_rng([piece.seed, 63])
    density *= recipe.detail
    size = max(1, round(piece.height * density)), max(1, round(piece.width * density))
    canvas = recipe.ground(size, rng, density)
    for x, y, diameter in piece.marks() * density:
        recipe.spot(canvas, x, y, diameter, rng)
    return canvas


def sheet(canvas: np.ndarray, box: Box, rng: np.random.Generator) -> None:
    """A sheet of paper with a heading, print and a picture, pinned up, in place."""
    left, top, width, height = box
    brushes.bar(canvas, (left + 0.02 * width, top + 0.02 * height, width, height), (90.0, 95.0, 100.0))
    ground = tuple(rng.uniform(190, 250, 3)) if rng.random() < 0.4 else (232.0, 238.0, 240.0)
    brushes.bar(canvas, box, ground)
    ink = tuple(rng.choice([(40, 40, 40), (120, 60, 30), (40, 40, 150)]).astype(float))
    heading = (left + 0.1 * width, top + 0.06 * height, 0.8 * width, 0.1 * height)
    brushes.lettering(canvas, brushes.words(rng, 8), heading, ink, rng)
    picture = (left + 0.1 * width, top + 0.22 * height, 0.8 * width, 0.3 * height)
    brushes.bar(canvas, picture, tuple(rng.uniform(40, 200, 3)))
    for _ in range(3):
        x, y = left + rng.uniform(0.2, 0.8) * width, top + rng.uniform(0.27, 0.47) * height
        brushes.dot(canvas, x, y, rng.uniform(0.03, 0.08) * height, tuple(rng.uniform(20, 235, 3)))
    lines = (left + 0.1 * width, top + 0.57 * height, 0.8 * width, 0.36 * height)
    brushes.text_lines(canvas, lines, 0.05 * height, ink, rng)


def pinboard(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A cork board with papers pinned to it."""
    height, width = size
    cork = 1 + 0.12 * brushes.clouds(size, rng, 0.006 * density, 2)
    canvas = brushes.tinted(cork, (95.0, 135.0, 170.0))
    x = 0.04 * density
    while x < width - 0.25 * density:
        y = rng.uniform(0.03, 0.08) * density
        wide = 0.0
        while y < height - 0.2 * density:
            w, h = (0.21, 0.297) if rng.random() < 0.5 else (rng.uniform(0.1, 0.2), rng.uniform(0.1, 0.2))
            if y + h * density < height - 4:
                sheet(canvas, (x + rng.uniform(0, 0.02) * density, y, w * density, h * density), rng)
            wide = max(wide, w)
            y += (h + rng.uniform(0.02, 0.05)) * density
        x += (wide + rng.uniform(0.03, 0.05)) * density
    frame = 0.018 * density
    for edge in ((0, 0, width, frame), (0, height - frame, width, frame), (0, 0, frame, height)):
        brushes.bar(canvas, edge, (80.0, 110.0, 140.0))
    brushes.bar(canvas, (width - frame, 0, frame, height), (80.0, 110.0, 140.0))
    return canvas


def cover(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """The cover or the spine of a book."""
    height, width = size
    colour = rng.uniform(30, 190, 3)
    canvas = brushes.tinted(1 + 0.04 * rng.standard_normal(size, np.float32), tuple(colour))
    ink = (230.0, 235.0, 240.0) if colour.mean() < 120 else (30.0, 30.0, 40.0)
    brushes.lettering(canvas, brushes.words(rng, 9), (0.1 * width, 0.12 * height, 0.8 * width, 0.12 * height), ink, rng)
    brushes.lettering(
        canvas, brushes.words(rng, 7), (0.15 * width, 0.28 * height, 0.7 * width, 0.08 * height), ink, rng
    )
    brushes.bar(canvas, (0.15 * width, 0.45 * height, 0.7 * width, 0.35 * height), tuple(rng.uniform(60, 230, 3)))
    for _ in range(5):
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.5, 0.75) * height
        brushes.dot(canvas, x, y, rng.uniform(0.02, 0.09) * min(size), tuple(rng.uniform(20, 240, 3)))
    brushes.lettering(canvas, brushes.words(rng, 5), (0.3 * width, 0.86 * height, 0.4 * width, 0.06 * height), ink, rng)
    return canvas


def screen(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A monitor with windows full of text and a plot."""
    height, width = size
    canvas = np.full((*size, 3), 25, np.uint8)
    edge = 0.012 * density
    if min(size) < 4 * edge:
        return canvas
    brushes.bar(canvas, (edge, edge, width - 2 * edge, height - 2 * edge), (110.0, 70.0, 40.0))
    for left, top, w, h, ground, ink in (
        (0.05, 0.08, 0.45, 0.8, (40.0, 40.0, 40.0), (200.0, 220.0, 200.0)),
        (0.53, 0.05, 0.42, 0.5, (245.0, 245.0, 245.0), (60.0, 50.0, 40.0)),
        (0.57, 0.6, 0.36, 0.32, (250.0, 250.0, 250.0), (150.0, 80.0, 40.0)),
    ):
        box = (left * width, top * height, w * width, h * height)
        brushes.bar(canvas, box, ground)
        brushes.bar(canvas, (box[0], box[1], box[2], 0.03 * height), (160.0, 160.0, 165.0))
        inner = (box[0] + 0.02 * width, box[1] + 0.06 * height, box[2] - 0.05 * width, box[3] - 0.1 * height)
        brushes.text_lines(canvas, inner, 0.035 * height, ink, rng)
    return canvas


def keyboard(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A keyboard; the letters are a matter of luck."""
    height, width = size
    canvas = np.full((*size, 3), 45, np.uint8)
    pitch = 0.019 * density
    if height < 3 * pitch:
        return canvas
    y = 0.012 * density
    while y + pitch < height:
        x = 0.01 * density + rng.uniform(0, 0.5) * pitch
        while x + pitch < width - 0.01 * density:
            w = pitch * (1.5 if rng.random() < 0.06 else 1.0)
            grey = 205.0 if rng.random() < 0.9 else 130.0
            brushes.bar(canvas, (x + 0.1 * pitch, y + 0.1 * pitch, w - 0.2 * pitch, 0.8 * pitch), (grey, grey, grey))
            letter = brushes.words(rng, 3)[0]
            box = (x + 0.25 * pitch, y + 0.2 * pitch, 0.4 * pitch, 0.4 * pitch)
            brushes.lettering(canvas, letter, box, (40.0, 40.0, 40.0), rng)
            x += w
        y += pitch
    return canvas


def paper(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A printed page."""
    height, width = size
    canvas = np.full((*size, 3), 238, np.uint8)
    ink = (50.0, 45.0, 45.0)
    brushes.lettering(
        canvas, brushes.words(rng, 12), (0.1 * width, 0.06 * height, 0.8 * width, 0.05 * height), ink, rng
    )
    for column in (0.1, 0.53):
        box = (column * width, 0.16 * height, 0.37 * width, 0.76 * height)
        brushes.text_lines(canvas, box, 0.018 * height, ink, rng)
    brushes.bar(canvas, (0.12 * width, 0.3 * height, 0.33 * width, 0.14 * height), (225.0, 225.0, 225.0))
    brushes.dot(canvas, 0.28 * width, 0.37 * height, 0.05 * height, (120.0, 80.0, 60.0))
    return canvas


def poster(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A poster: heading, shapes, print."""
    height, width = size
    ground = rng.uniform(120, 240, 3)
    canvas = brushes.tinted(1 + 0.02 * brushes.clouds(size, rng, 0.1 * density), tuple(ground))
    ink = (30.0, 30.0, 40.0)
    brushes.lettering(
        canvas, brushes.words(rng, 7), (0.08 * width, 0.04 * height, 0.84 * width, 0.14 * height), ink, rng
    )
    for _ in range(9):
        x, y = rng.uniform(0.15, 0.85) * width, rng.uniform(0.27, 0.6) * height
        r = rng.uniform(0.02, 0.1) * min(size)
        colour = tuple(rng.uniform(10, 245, 3))
        if rng.random() < 0.5:
            brushes.dot(canvas, x, y, r, colour)
        else:
            brushes.bar(canvas, (x - r, y - 0.6 * r, 2 * r, 1.2 * r), colour)
    lines = (0.1 * width, 0.7 * height, 0.8 * width, 0.24 * height)
    brushes.text_lines(canvas, lines, 0.04 * height, ink, rng)
    return canvas


def wood(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A wooden top."""
    return brushes.wood(size, rng, (105.0, 150.0, 190.0), density)


def board(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A white board."""
    return brushes.tinted(1 + 0.01 * brushes.clouds(size, rng, 0.2 * density), (205.0, 212.0, 215.0))


def sign_board(piece: Material, density: float) -> np.ndarray:
    """A white board with signs: discs and squares with a pattern of their own around and on them."""
    rng = np.random.default_rng([piece.seed, 65])
    size = round(piece.height * density), round(piece.width * density)
    canvas = board(size, rng, density)
    for x, y, diameter in piece.marks() * density:
        dark = rng.random() < 0.7
        ground, ink = ((215.0,) * 3, (30.0,) * 3) if dark else ((45.0,) * 3, (225.0,) * 3)
        field = 2.2 * diameter
        brushes.bar(canvas, (x - field / 2, y - field / 2, field, field), ground)
        for _ in range(4):
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.75, 0.95) * diameter
            spot = x + far * np.cos(angle), y + far * np.sin(angle)
            brushes.dot(canvas, *spot, rng.uniform(0.06, 0.14) * diameter, ink)
        brushes.dot(canvas, x, y, diameter / 2, ink)
        for _ in range(2):
            spot = x + rng.uniform(-0.2, 0.2) * diameter, y + rng.uniform(-0.2, 0.2) * diameter
            brushes.dot(canvas, *spot, rng.uniform(0.04, 0.08) * diameter, ground)
    return canvas


def _plaster(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A painted wall: nearly nothing to see."""
    light = 1 + 0.012 * brushes.clouds(size, rng, 0.6 * density) + 0.006 * brushes.clouds(size, rng, 0.01 * density, 2)
    return brushes.tinted(light, (200.0, 212.0, 218.0))


def _carpet(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A carpet of short loops."""
    light = 1 + 0.10 * brushes.clouds(size, rng, 0.008 * density, 2) + 0.05 * brushes.clouds(size, rng, 0.15 * density)
    return brushes.tinted(light, (105.0, 85.0, 75.0))


def _ceiling(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """Ceiling panels with lamps."""
    canvas = brushes.tinted(1 + 0.01 * brushes.clouds(size, rng, 0.05 * density), (205.0, 210.0, 212.0))
    step = 0.6 * density
    for x in np.arange(0, size[1], step):
        brushes.bar(canvas, (x - 0.006 * density, 0, 0.012 * density, size[0]), (150.0, 155.0, 158.0))
    for y in np.arange(0, size[0], step):
        brushes.bar(canvas, (0, y - 0.006 * density, size[1], 0.012 * density), (150.0, 155.0, 158.0))
    for x in np.arange(step, size[1] - step, 4 * step):
        brushes.bar(canvas, (x + 0.1 * step, step * 1.2, 1.8 * step, 0.6 * step), (255.0, 255.0, 255.0))
    return canvas


def _door_wall(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A wall with a door and notices."""
    canvas = _plaster(size, rng, density)
    height, width = size
    wide, high = 0.9 * density, 2.05 * density
    left = (width - wide) / 2
    brushes.bar(
        canvas, (left - 0.06 * density, height - high - 0.06 * density, wide + 0.12 * density, high), (120, 130, 135)
    )
    door = brushes.wood((round(wide), round(high)), rng, (90.0, 120.0, 150.0), density).transpose(1, 0, 2)
    x, y = round(left), height - round(high)
    canvas[y : y + door.shape[0], x : x + door.shape[1]] = door[: height - y, : width - x]
    brushes.dot(canvas, left + 0.86 * wide, height - 1.05 * density, 0.03 * density, (190.0, 195.0, 200.0))
    place = (left + 0.3 * wide, height - 1.7 * density, 0.3 * density, 0.4 * density)
    sheet(canvas, place, rng)
    return canvas


def _carton(size: tuple[int, int], rng: np.random.Generator, density: float) -> np.ndarray:
    """A side of a carton: brown board, tape, print and a label."""
    height, width = size
    ribs = brushes.grain(size, rng, (2.0, 0.2 * density))
    canvas = brushes.tinted(1 + 0.03 * ribs + 0.04 * brushes.clouds(size, rng, 0.1 * density), (105.0, 150.0, 185.0))
    brushes.bar(canvas, (0, 0.44 * height, width, 0.12 * height), (130.0, 175.0, 205.0))
    ink = (35.0, 45.0, 60.0)
    brushes.lettering(canvas, brushes.words(rng, 6), (0.08 * width, 0.1 * height, 0.5 * width, 0.2 * height), ink, rng)
    label = (rng.uniform(0.45, 0.55) * width, 0.55 * height, 0.4 * width, 0.36 * height)
    brushes.bar(canvas, label, (235.0, 240.0, 240.0))
    x = label[0] + 0.08 * label[2]
    while x < label[0] + 0.9 * label[2]:  # a bar code
        w = rng.uniform(0.01, 0.035) * label[2]
        brushes.bar(canvas, (x, label[1] + 0.1 * label[3], w, 0.4 * label[3]), (20.0, 20.0, 20.0))
        x += w + rng.uniform(0.015, 0.05) * label[2]
    lines = (label[0] + 0.08 * label[2], label[1] + 0.58 * label[3], 0.84 * label[2], 0.36 * label[3])
    brushes.text_lines(canvas, lines, 0.12 * label[3], ink, rng)
    for edge in ((0, 0, width, 1.5), (0, height - 1.5, width, 1.5), (0, 0, 1.5, height), (width - 1.5, 0, 1.5, height)):
        brushes.bar(canvas, edge, (60.0, 90.0, 115.0))
    return canvas


def _no_spot(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """Nothing."""


def _fleck(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """A faint round fleck, darker or brighter than what is around it."""
    here = canvas[min(int(y), len(canvas) - 1), min(int(x), canvas.shape[1] - 1)].astype(float)
    b, g, r = np.clip(here * (0.75 if rng.random() < 0.6 else 1.25), 0, 255)
    brushes.dot(canvas, x, y, diameter / 2, (b, g, r))


def _print(canvas: np.ndarray, x: float, y: float, diameter: float, rng: np.random.Generator) -> None:
    """A printed sign: a letter, a disc or a square in strong ink."""
    ink = _INKS[int(rng.integers(len(_INKS)))]
    kind = int(rng.integers(3))
    if kind == 0:
        brushes.dot(canvas, x, y, diameter / 2, ink)
    elif kind == 1:
        brushes.bar(canvas, (x - 0.4 * diameter, y - 0.4 * diameter, 0.8 * diameter, 0.8 * diameter), ink)
    else:
        box = (x - diameter / 2, y - diameter / 2, diameter, diameter)
        brushes.lettering(canvas, brushes.words(rng, 3).replace(" ", "")[0], box, ink, rng)


class Recipe(NamedTuple):
    """How to paint a material.

    Attributes:
        ground: paints the whole piece.
        spot: paints one of the scattered
        detail: how finely, as a share of the texels asked for: plain surfaces need fewer.
    """

    ground: Painter
    spot: Callable[..., None] = _no_spot
    detail: float = 1.0


PAINTERS = {
    "plaster": Recipe(_plaster, _fleck, 0.25),
    "carpet": Recipe(_carpet, _fleck, 0.5),
    "ceiling": Recipe(_ceiling, _no_spot, 0.5),
    "door_wall": Recipe(_door_wall, _fleck),
    "carton": Recipe(_carton, _print),
    "board": Recipe(board, _print),
    "wood": Recipe(wood, _fleck),
    "pinboard": Recipe(pinboard),
    "cover": Recipe(cover, _print),
    "screen": Recipe(screen),
    "keyboard": Recipe(keyboard),
    "paper": Recipe(paper),
    "poster": Recipe(poster, _print),
    "asphalt": Recipe(streetside.asphalt, _fleck, 0.5),
    "road": Recipe(streetside.road, _fleck),
    "road_across": Recipe(streetside.road_across, _fleck),
    "car_side": Recipe(streetside.car_side),
    "car_front": Recipe(partial(streetside.car_end, lamp=(235.0, 240.0, 240.0))),
    "car_back": Recipe(partial(streetside.car_end, lamp=(45.0, 45.0, 200.0))),
    "car_top": Recipe(streetside.paintwork),
    "cabin_side": Recipe(streetside.cabin_side),
    "cabin_end": Recipe(streetside.cabin_end),
    "field": Recipe(streetside.field, _fleck),
}


def _shelves(wall: Material, density: float) -> np.ndarray:
    """A wall of bookshelves, in one picture."""
    return np.concatenate([paint_bay(bay, density) for bay in wall.parts()], axis=1)


#: Painters of whole pieces whose marks are their own.
WHOLE: dict[str, Callable[[Material, float], np.ndarray]] = {
    "facade": streetside.house_front, "signs": sign_board, "shelves": _shelves,
}  # fmt: skip
