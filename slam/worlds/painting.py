"""Painting what stands indoors, and all materials by their names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from slam.worlds import streetside
from slam.worlds.brushes import Colour, Page, Rng, Size, clouds, grain, mottled, tinted, wood, words
from slam.worlds.geometry import Texture
from slam.worlds.shelves import paint_bay
from slam.worlds.streetside import paint_facade
from slam.worlds.surfaces import Bay, Facade, Material, Signs

_INKS = ((25, 30, 40), (235, 240, 240), (40, 40, 170), (150, 70, 30))
_DARK = (30.0, 30.0, 40.0)


def _even(colour: Colour, *spots: tuple[float, float, int]) -> Callable[[Size, Rng, float], np.ndarray]:
    """A painter of a surface with nothing on it, see `slam.worlds.brushes.mottled`."""
    return lambda size, rng, density: mottled(size, rng, density, colour, *spots)


_BOARD = _even((205.0, 212.0, 215.0), (0.01, 0.2, 3))
_PLASTER = _even((200.0, 212.0, 218.0), (0.012, 0.6, 3), (0.006, 0.01, 2))  # nearly nothing to see


def paint(texture: Texture, density: float) -> np.ndarray:
    """The picture of a texture, BGR uint8 (round(height · density), round(width · density), 3), texels per metre.

    A texture of another class than the built-in ones paints itself: its ``paint(density)`` is called.
    """
    painter = PAINTERS.get(type(texture))
    picture: np.ndarray = painter(texture, density) if painter else texture.paint(density)  # type: ignore[attr-defined]
    return picture


def _paint_material(piece: Material | Signs, density: float) -> np.ndarray:
    """A piece of a material, or a board of signs."""
    recipe = RECIPES[piece.material]
    rng = np.random.default_rng([piece.seed, 63])
    density *= recipe.detail
    size = max(1, round(piece.height * density)), max(1, round(piece.width * density))
    page = Page(recipe.ground(size, rng, density), rng, density)
    if recipe.spot is not None:
        for x, y, diameter in piece.marks() * density:
            recipe.spot(page, x, y, diameter)
    return page.picture


def _frame(page: Page, edge: float, colour: Colour) -> None:
    """A frame around the whole page, `edge` texels wide."""
    w, h = page.width, page.height
    for box in ((0, 0, w, edge), (0, h - edge, w, edge), (0, 0, edge, h), (w - edge, 0, edge, h)):
        page.bar(box, colour)


def _cover(size: Size, rng: Rng, density: float) -> np.ndarray:
    """The cover or the spine of a book."""
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
    """A poster: heading, shapes, print."""
    ground = rng.uniform(120, 240, 3)
    page = Page(mottled(size, rng, density, ground, (0.02, 0.1, 3)), rng)
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
    """Ceiling panels with lamps."""
    page = Page(mottled(size, rng, density, (205.0, 210.0, 212.0), (0.01, 0.05, 3)), rng)
    step, joint = 0.6 * density, 0.012 * density
    for x in np.arange(0, page.width, step):
        page.bar((x - joint / 2, 0, joint, page.height), (150.0, 155.0, 158.0))
    for y in np.arange(0, page.height, step):
        page.bar((0, y - joint / 2, page.width, joint), (150.0, 155.0, 158.0))
    for x in np.arange(step, page.width - step, 4 * step):
        page.bar((x + 0.1 * step, step * 1.2, 1.8 * step, 0.6 * step), (255.0, 255.0, 255.0))
    return page.picture


def _carton(size: Size, rng: Rng, density: float) -> np.ndarray:
    """A side of a carton: brown board, tape, print and a label."""
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
    _frame(page, 1.5, (60.0, 90.0, 115.0))
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


RECIPES = {
    "plaster": Recipe(_PLASTER, _fleck, 0.25),
    "carpet": Recipe(_even((105.0, 85.0, 75.0), (0.10, 0.008, 2), (0.05, 0.15, 3)), _fleck, 0.5),
    "ceiling": Recipe(_ceiling, None, 0.5),
    "carton": Recipe(_carton, _print),
    "board": Recipe(_BOARD, _print),
    "wood": Recipe(wood, _fleck),
    "cover": Recipe(_cover, _print),
    "poster": Recipe(_poster, _print),
    "asphalt": Recipe(streetside.asphalt, _fleck, 0.5),
    **{name: Recipe(partial(streetside.car_part, items=items)) for name, items in streetside.CAR_PARTS.items()},
    "field": Recipe(streetside.field, _fleck),
}

PAINTERS: dict[type, Callable[..., np.ndarray]] = {
    Material: _paint_material, Facade: paint_facade, Signs: _paint_material, Bay: paint_bay,
}  # fmt: skip
