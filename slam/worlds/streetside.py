"""Painting streets: house fronts, roads and cars; and the playing field."""

from __future__ import annotations

import cv2
import numpy as np

from slam.worlds.brushes import Box, Colour, Page, Rng, Size, clouds, mottled, tinted
from slam.worlds.surfaces import Facade

_WALLS = ((150, 190, 215), (120, 140, 185), (190, 205, 215), (110, 120, 150), (160, 175, 180), (120, 165, 200))
_PAINTS = ((40, 40, 150), (130, 80, 40), (60, 60, 60), (185, 190, 195), (215, 220, 222), (70, 110, 60), (30, 32, 35))
_WHITE = (225.0, 232.0, 228.0)


def paint_facade(house: Facade, density: float) -> np.ndarray:
    """The picture of a house front, BGR uint8, `density` texels per metre."""
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
    """Courses of bricks."""
    course, length = 0.09 * page.density, 0.26 * page.density
    for row, y in enumerate(np.arange(0, page.height, course)):
        for x in np.arange(-length / 2 * (row % 2), page.width, length):
            if page.rng.random() < 0.25:
                part = page.picture[int(y) : int(y + course), max(int(x), 0) : int(x + length)]
                np.copyto(part, (part * page.rng.uniform(0.75, 0.95)).astype(np.uint8))


def _window(page: Page, box: Box) -> None:
    """A window with its frame, panes, sill, and sometimes shutters or a curtain."""
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


def asphalt(size: Size, rng: Rng, density: float) -> np.ndarray:
    """Asphalt."""
    light = 1 + 0.05 * clouds(size, rng, 2.0 * density, 4) + 0.06 * clouds(size, rng, 2.0, 1)
    return tinted(light, (88.0, 86.0, 85.0))


_DARK, _GLASS, _GLARE = (25.0, 25.0, 28.0), (75.0, 65.0, 55.0), (125.0, 115.0, 105.0)
_WHEEL = ((0.079, 25.0), (0.047, 165.0), (0.014, 60.0))  # half widths as shares of a car's length, and grey values
_CAR_END = (
    ((0.32, 0.5, 0.36, 0.16), (240.0, 240.0, 240.0)), ((0, 0.72, 1, 0.12), (55.0, 55.0, 58.0)),
    ((0.05, 0.84, 0.17, 0.16), _DARK), ((0.78, 0.84, 0.17, 0.16), _DARK),
)  # fmt: skip
#: What is on the parts of a car: boxes by shares of the part, and their colours.
CAR_PARTS: dict[str, tuple[tuple[Box, Colour], ...]] = {
    "car_top": (),
    "car_side": (
        *(((x, 0, 0.005, 0.8), _DARK) for x in (0.36, 0.60, 0.82)),
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
        ((0.07, 0.15, 0.86, 0.8), _GLASS), ((0.15, 0.25, 0.2, 0.3), _GLARE), ((0.62, 0.6, 0.12, 0.2), _DARK),
    ),
}  # fmt: skip


def car_part(size: Size, rng: Rng, density: float, items: tuple[tuple[Box, Colour], ...]) -> np.ndarray:
    """A part of a car: paint, whose colour is drawn first, so that all parts have the same, and boxes on it."""
    colour = _PAINTS[int(rng.integers(len(_PAINTS)))]
    light = 1.05 - 0.25 * np.linspace(0, 1, size[0], dtype=np.float32)[:, None]
    page = Page(tinted(light + 0.02 * clouds(size, rng, 0.3 * density), colour), rng)
    for box, shade in items:
        page.bar(page.part(*box), shade)
    return page.picture


def field(size: Size, rng: Rng, density: float) -> np.ndarray:
    """A robots' playing field: green carpet with white lines."""
    page = Page(mottled(size, rng, density, (60.0, 125.0, 55.0), (0.09, 0.012, 2), (0.05, 0.3, 3)), rng)
    (height, width), line, edge = size, 0.05 * density, 0.35 * density
    for box in (
        (edge, edge, width - 2 * edge, line),
        (edge, height - edge, width - 2 * edge, line),
        (edge, edge, line, height - 2 * edge),
        (width - edge, edge, line, height - 2 * edge),
        (width / 2, edge, line, height - 2 * edge),
    ):
        page.bar(box, _WHITE)
    centre = round((width / 2 - 0.5) * 16), round((height / 2 - 0.5) * 16)
    cv2.circle(page.picture, centre, round(0.6 * density * 16), _WHITE, max(1, round(line)), cv2.LINE_AA, 4)
    return page.picture
