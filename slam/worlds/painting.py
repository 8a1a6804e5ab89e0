"""Painting all textures but bookshelves, and all materials by their names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from slam.worlds.brushes import Box, Colour, Page, Rng, Size, clouds, grain, mottled, tinted, wood, words
from slam.worlds.geometry import Texture
from slam.worlds.shelves import paint_bay
from slam.worlds.surfaces import Bay, Facade, Material, Signs

_INKS = ((25, 30, 40), (235, 240, 240), (40, 40, 170), (150, 70, 30))
_DARK = (30.0, 30.0, 40.0)


def paint(texture: Texture, density: float) -> np.ndarray:
    """The picture of a texture, BGR uint8 (round(height · density), round(width · density), 3), texels per metre.

    A texture of another class than the built-in ones paints itself: its ``paint(density)`` is called.
    """
    painter = PAINTERS.get(type(texture))
    picture: np.ndarray = painter(texture, density) if painter else texture.paint(density)  # type: ignore[attr-defined]
    return picture


def _paint_material(piece: Material, density: float) -> np.ndarray:
    recipe = RECIPES[piece.material]
    rng = np.random.default_rng([piece.seed, 63])
    density *= recipe.detail
    size = max(1, round(piece.height * density)), max(1, round(piece.width * density))
    page = Page(recipe.ground(size, rng, density), rng, density)
    if recipe.spot is not None:
        for x, y, diameter in piece.marks() * density:
            recipe.spot(page, x, y, diameter)
    return page.picture


def _cover(size: Size, rng: Rng, density: float) -> np.ndarray:
    colour = rng.uniform(30, 190, 3)
    page = Page(tinted(1 + 0.04 * rng.standard_normal(size, np.float32), colour), rng)
    ink = (230.0, 235.0, 240.0) if colour.mean() < 120 else _DARK
    page.title(9, page.part(0.1, 0.12, 0.8, 0.12), ink)
    page.title(7, page.part(0.15, 0.28, 0.7, 0.08), ink)
    page.bar(page.part(0.15, 0.45, 0.7, 0.35), rng.uniform(60, 230, 3))
    for _ in range(5):
        x, y = rng.uniform(0.2, 0.8) * page.width, rng.uniform(0.5, 0.75) * page.height
        page.dot(x, y, rng.uniform(0.02, 0.09) * min(size), rng.uniform(20, 240, 3))
    page.title(5, page.part(0.3, 0.86, 0.4, 0.06), ink)
    return page.picture


def _poster(size: Size, rng: Rng, density: float) -> np.ndarray:
    ground = rng.uniform(120, 240, 3)
    page = Page(mottled(size, rng, density, ground, [(0.02, 0.1, 3)]), rng)
    page.title(7, page.part(0.08, 0.04, 0.84, 0.14), _DARK)
    for _ in range(9):
        x, y = rng.uniform(0.15, 0.85) * page.width, rng.uniform(0.27, 0.6) * page.height
        r = rng.uniform(0.02, 0.1) * min(size)
        colour = rng.uniform(10, 245, 3)
        if rng.random() < 0.5:
            page.dot(x, y, r, colour)
        else:
            page.bar((x - r, y - 0.6 * r, 2 * r, 1.2 * r), colour)
    page.print(page.part(0.1, 0.7, 0.8, 0.24), 0.04 * page.height, _DARK)
    return page.picture


def _ceiling(size: Size, rng: Rng, density: float) -> np.ndarray:
    page = Page(mottled(size, rng, density, (205.0, 210.0, 212.0), [(0.01, 0.05, 3)]), rng)
    step, joint = 0.6 * density, 0.012 * density
    for x in np.arange(0, page.width, step):
        page.bar((x - joint / 2, 0, joint, page.height), (150.0, 155.0, 158.0))
    for y in np.arange(0, page.height, step):
        page.bar((0, y - joint / 2, page.width, joint), (150.0, 155.0, 158.0))
    for x in np.arange(step, page.width - step, 4 * step):
        page.bar((x + 0.1 * step, step * 1.2, 1.8 * step, 0.6 * step), (255.0, 255.0, 255.0))
    return page.picture


def _carton(size: Size, rng: Rng, density: float) -> np.ndarray:
    ribs = grain(size, rng, (2.0, 0.2 * density))
    page = Page(tinted(1 + 0.03 * ribs + 0.04 * clouds(size, rng, 0.1 * density), (105.0, 150.0, 185.0)), rng)
    page.bar(page.part(0, 0.44, 1, 0.12), (130.0, 175.0, 205.0))
    ink = (35.0, 45.0, 60.0)
    page.title(6, page.part(0.08, 0.1, 0.5, 0.2), ink)
    label = page.part(rng.uniform(0.45, 0.55), 0.55, 0.4, 0.36)
    page.bar(label, (235.0, 240.0, 240.0))
    x = label[0] + 0.08 * label[2]
    while x < label[0] + 0.9 * label[2]:  # a bar code
        w = rng.uniform(0.01, 0.035) * label[2]
        page.bar((x, label[1] + 0.1 * label[3], w, 0.4 * label[3]), (20.0, 20.0, 20.0))
        x += w + rng.uniform(0.015, 0.05) * label[2]
    page.print(page.part(0.08, 0.58, 0.84, 0.36, label), 0.12 * label[3], ink)
    w, h, edge = page.width, page.height, 1.5  # of a frame
    for box in ((0, 0, w, edge), (0, h - edge, w, edge), (0, 0, edge, h), (w - edge, 0, edge, h)):
        page.bar(box, (60.0, 90.0, 115.0))
    return page.picture


_WALLS = ((150, 190, 215), (120, 140, 185), (190, 205, 215), (110, 120, 150), (160, 175, 180), (120, 165, 200))
_PAINTS = ((40, 40, 150), (130, 80, 40), (60, 60, 60), (185, 190, 195), (215, 220, 222), (70, 110, 60), (30, 32, 35))


def _paint_facade(house: Facade, density: float) -> np.ndarray:
    rng = np.random.default_rng([house.seed, 64])
    size = round(house.height * density), round(house.width * density)
    colour = _WALLS[int(rng.integers(len(_WALLS)))]
    light = 1 + 0.06 * clouds(size, rng, 1.5 * density, 5) + 0.03 * rng.standard_normal(size, np.float32)
    page = Page(tinted(light, colour), rng, density)
    if rng.random() < 0.4:
        _bricks(page)
    page.bar((0, page.height - 0.7 * density, page.width, 0.7 * density), (95.0, 100.0, 105.0))
    page.bar((0, 0, page.width, 0.35 * density), (70.0, 80.0, 110.0))
    for left, top, w, h in house.windows() * density:
        _window(page, (left, top, w, h))
    left, top = rng.uniform(0.4, 0.6) * page.width, page.height - 2.2 * density
    page.bar((left - 0.1 * density, top - 0.1 * density, 1.2 * density, 2.3 * density), (200.0, 205.0, 210.0))  # a door
    page.bar((left, top, density, 2.2 * density), rng.uniform(30, 110, 3))
    page.bar((left + 0.2 * density, top + 0.2 * density, 0.6 * density, 0.7 * density), (70.0, 60.0, 55.0))
    page.dot(left + 0.88 * density, top + 1.2 * density, 0.05 * density, (200.0, 210.0, 215.0))
    for x, y, diameter in house.stains.marks() * density:
        shade = np.multiply(colour, rng.uniform(0.55, 0.85))
        page.bar((x - diameter / 2, y - diameter / 6, diameter, diameter / 3), shade)
    if rng.random() < 0.5:
        sign = (0.15 * page.width, page.height - 3.0 * density, rng.uniform(2.0, 4.0) * density, 0.5 * density)
        page.bar(sign, rng.uniform(30, 200, 3))
        page.title(9, sign, (240.0, 240.0, 240.0))
    return page.picture


def _bricks(page: Page) -> None:
    course, length = 0.09 * page.density, 0.26 * page.density
    for row, y in enumerate(np.arange(0, page.height, course)):
        for x in np.arange(-length / 2 * (row % 2), page.width, length):
            if page.rng.random() < 0.25:
                part = page.picture[int(y) : int(y + course), max(int(x), 0) : int(x + length)]
                np.copyto(part, (part * page.rng.uniform(0.75, 0.95)).astype(np.uint8))


def _window(page: Page, box: Box) -> None:
    rng, (left, top, w, h), frame = page.rng, box, 0.07 * page.density
    page.bar((left - frame, top - frame, w + 2 * frame, h + 2 * frame), (225.0, 230.0, 232.0))
    glass = rng.uniform(35, 90)
    page.bar(box, (glass * 1.2, glass * 1.05, glass))
    if rng.random() < 0.5:
        page.bar((left, top, w * rng.uniform(0.2, 0.45), h), (170.0, 185.0, 195.0))
    page.bar((left + w / 2 - frame / 2, top, frame, h), (220.0, 225.0, 228.0))
    page.bar((left, top + 0.35 * h, w, 0.7 * frame), (220.0, 225.0, 228.0))
    page.bar((left - 1.5 * frame, top + h + frame, w + 3 * frame, frame), (110.0, 115.0, 120.0))
    if rng.random() < 0.25:
        shutter = rng.uniform(40, 130, 3)
        for x in (left - frame - 0.45 * w, left + w + frame):
            page.bar((x, top, 0.42 * w, h), shutter)


def _asphalt(size: Size, rng: Rng, density: float) -> np.ndarray:
    light = 1 + 0.05 * clouds(size, rng, 2.0 * density, 4) + 0.06 * clouds(size, rng, 2.0, 1)
    return tinted(light, (88.0, 86.0, 85.0))


_BLACK, _GLASS, _GLARE = (25.0, 25.0, 28.0), (75.0, 65.0, 55.0), (125.0, 115.0, 105.0)
_WHEEL = ((0.079, 25.0), (0.047, 165.0), (0.014, 60.0))  # half widths as shares of a car's length, and grey values
_CAR_END = (
    ((0.32, 0.5, 0.36, 0.16), (240.0, 240.0, 240.0)), ((0, 0.72, 1, 0.12), (55.0, 55.0, 58.0)),
    ((0.05, 0.84, 0.17, 0.16), _BLACK), ((0.78, 0.84, 0.17, 0.16), _BLACK),
)  # fmt: skip
#: What is on the parts of a car: boxes by shares of the part, and their colours.
_CAR_PARTS: dict[str, tuple[tuple[Box, Colour], ...]] = {
    "car_top": (),
    "car_side": (
        *(((x, 0, 0.005, 0.8), _BLACK) for x in (0.36, 0.60, 0.82)),
        *(((x, 0.22, 0.042, 0.067), (190.0, 190.0, 190.0)) for x in (0.40, 0.64)),
        *(((x - r, 0.85 - 5.73 * r, 2 * r, 11.47 * r), (grey,) * 3) for x in (0.18, 0.80) for r, grey in _WHEEL),
    ),
    "car_front": (*(((x, 0.18, 0.18, 0.2), (235.0, 240.0, 240.0)) for x in (0.05, 0.77)), *_CAR_END),
    "car_back": (*(((x, 0.18, 0.18, 0.2), (45.0, 45.0, 200.0)) for x in (0.05, 0.77)), *_CAR_END),
    "cabin_side": (
        ((0.04, 0.18, 0.42, 0.75), _GLASS), ((0.09, 0.25, 0.08, 0.6), _GLARE),
        ((0.50, 0.18, 0.42, 0.75), _GLASS), ((0.55, 0.25, 0.08, 0.6), _GLARE),
    ),
    "cabin_end": (
        ((0.07, 0.15, 0.86, 0.8), _GLASS), ((0.15, 0.25, 0.2, 0.3), _GLARE), ((0.62, 0.6, 0.12, 0.2), _BLACK),
    ),
}  # fmt: skip


def _car_part(size: Size, rng: Rng, density: float, items: tuple[tuple[Box, Colour], ...]) -> np.ndarray:
    """A part of a car: paint, whose colour is drawn first, so that all parts have the same, and boxes on it."""
    colour = _PAINTS[int(rng.integers(len(_PAINTS)))]
    light = 1.05 - 0.25 * np.linspace(0, 1, size[0], dtype=np.float32)[:, None]
    page = Page(tinted(light + 0.02 * clouds(size, rng, 0.3 * density), colour), rng)
    for box, shade in items:
        page.bar(page.part(*box), shade)
    return page.picture


def _fleck(page: Page, x: float, y: float, diameter: float) -> None:
    """A faint round fleck, darker or brighter than what is around it."""
    here = page.picture[min(int(y), page.height - 1), min(int(x), page.width - 1)].astype(float)
    page.dot(x, y, diameter / 2, np.clip(here * (0.75 if page.rng.random() < 0.6 else 1.25), 0, 255))


def _print(page: Page, x: float, y: float, diameter: float) -> None:
    """A printed sign: a letter, a disc or a square in strong ink."""
    ink = _INKS[int(page.rng.integers(len(_INKS)))]
    kind = int(page.rng.integers(3))
    if kind == 0:
        page.dot(x, y, diameter / 2, ink)
    elif kind == 1:
        page.bar((x - 0.4 * diameter, y - 0.4 * diameter, 0.8 * diameter, 0.8 * diameter), ink)
    else:
        letter = words(page.rng, 3)[0]
        page.write(letter, (x - diameter / 2, y - diameter / 2, diameter, diameter), ink)


class Recipe(NamedTuple):
    """How to paint a material."""

    ground: Callable[[Size, Rng, float], np.ndarray]  # paints the whole piece
    spot: Callable[[Page, float, float, float], None] | None = None  # puts a scattered thing on it
    detail: float = 1.0  # how finely, as a share of the texels asked for: plain surfaces need fewer


_PLASTER = partial(mottled, colour=(200.0, 212.0, 218.0), spots=[(0.012, 0.6, 3), (0.006, 0.01, 2)])  # hardly anything
_CARPET = partial(mottled, colour=(105.0, 85.0, 75.0), spots=[(0.10, 0.008, 2), (0.05, 0.15, 3)])
_BOARD = partial(mottled, colour=(205.0, 212.0, 215.0), spots=[(0.01, 0.2, 3)])

RECIPES = {
    "plaster": Recipe(_PLASTER, _fleck, 0.25),
    "carpet": Recipe(_CARPET, _fleck, 0.5),
    "ceiling": Recipe(_ceiling, None, 0.5),
    "carton": Recipe(_carton, _print),
    "board": Recipe(_BOARD, _print),
    "wood": Recipe(wood, _fleck),
    "cover": Recipe(_cover, _print),
    "poster": Recipe(_poster, _print),
    "asphalt": Recipe(_asphalt, _fleck, 0.5),
    **{name: Recipe(partial(_car_part, items=items)) for name, items in _CAR_PARTS.items()},
}

PAINTERS: dict[type, Callable[..., np.ndarray]] = {
    Material: _paint_material, Facade: _paint_facade, Signs: _paint_material, Bay: paint_bay,
}  # fmt: skip
