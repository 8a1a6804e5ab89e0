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


def road(size: Size, rng: Rng, density: float) -> np.ndarray:
    """A street running down the picture: asphalt, kerbs, pavements, and a dashed line."""
    page = Page(asphalt(size, rng, density), rng)
    height, width = size
    for left, right in ((0.0, 1.4), (width / density - 1.9, width / density)):
        x0, x1 = round(left * density), round(right * density)
        stones = 1 + 0.05 * clouds((height, x1 - x0), rng, 0.3 * density)
        page.picture[:, x0:x1] = tinted(stones, (140.0, 143.0, 146.0))
        for y in np.arange(0, height, 0.5 * density):
            page.bar((x0, y, x1 - x0, 0.03 * density), (105.0, 108.0, 110.0))
        kerb = right if left == 0 else left
        page.bar(((kerb - 0.08) * density, 0, 0.16 * density, height), (170.0, 172.0, 174.0))
    for y in np.arange(0, height, 6 * density):  # between the lanes
        page.bar((7.4 * density - 0.07 * density, y, 0.14 * density, 3 * density), (215.0, 218.0, 220.0))
    return page.picture


def road_across(size: Size, rng: Rng, density: float) -> np.ndarray:
    """The same, running across the picture."""
    return np.ascontiguousarray(np.rot90(road((size[1], size[0]), rng, density)))


def asphalt(size: Size, rng: Rng, density: float) -> np.ndarray:
    """Asphalt with nothing on it."""
    light = 1 + 0.05 * clouds(size, rng, 2.0 * density, 4) + 0.06 * clouds(size, rng, 2.0, 1)
    return tinted(light, (88.0, 86.0, 85.0))


def paintwork(size: Size, rng: Rng, density: float) -> np.ndarray:
    """Car paint (roof, bonnet); its colour is drawn first, so that all sides of a car have the same."""
    colour = _PAINTS[int(rng.integers(len(_PAINTS)))]
    light = 1.05 - 0.25 * np.linspace(0, 1, size[0], dtype=np.float32)[:, None]
    return tinted(light + 0.02 * clouds(size, rng, 0.3 * density), colour)


def car_side(size: Size, rng: Rng, density: float) -> np.ndarray:
    """The side of a car below its windows: doors, handles and wheels."""
    page = Page(paintwork(size, rng, density), rng)
    height, width = size
    for x in (0.36, 0.60, 0.82):
        page.bar((x * width, 0, 0.02 * density, 0.8 * height), (25.0, 25.0, 28.0))
    for x in (0.40, 0.64):
        page.bar((x * width, 0.22 * height, 0.18 * density, 0.05 * density), (190.0, 190.0, 190.0))
    for x in (0.18, 0.80):
        for radius, grey in ((0.34, 25.0), (0.2, 165.0), (0.06, 60.0)):
            page.dot(x * width, 0.85 * height, radius * density, (grey, grey, grey))
    return page.picture


def car_end(size: Size, rng: Rng, density: float, lamp: Colour) -> np.ndarray:
    """The front or the back of a car below its windows: lamps, number plate, bumper."""
    page = Page(paintwork(size, rng, density), rng)
    for x in (0.05, 0.77):
        page.bar(page.part(x, 0.18, 0.18, 0.2), lamp)
    plate = page.part(0.32, 0.5, 0.36, 0.16)
    page.bar(plate, (240.0, 240.0, 240.0))
    page.title(6, (plate[0] + 2, plate[1] + 1, plate[2] - 4, plate[3] - 2), (20, 20, 20))
    page.bar(page.part(0, 0.72, 1, 0.12), (55.0, 55.0, 58.0))
    for x in (0.05, 0.78):
        page.bar(page.part(x, 0.84, 0.17, 0.16), (20.0, 20.0, 20.0))
    return page.picture


def cabin(size: Size, rng: Rng, density: float, panes: tuple[tuple[Box, Colour], ...]) -> np.ndarray:
    """The windows of a car, as shares of its side."""
    page = Page(paintwork(size, rng, density), rng)
    for box, colour in panes:
        page.bar(page.part(*box), colour)
    return page.picture


_GLASS = (75.0, 65.0, 55.0)
SIDE_PANES = (
    ((0.04, 0.18, 0.46 - 0.04, 0.75), _GLASS), ((0.04 + 0.05, 0.25, 0.08, 0.6), (125.0, 115.0, 105.0)),
    ((0.50, 0.18, 0.92 - 0.50, 0.75), _GLASS), ((0.50 + 0.05, 0.25, 0.08, 0.6), (125.0, 115.0, 105.0)),
)  # fmt: skip
END_PANES = (
    ((0.07, 0.15, 0.86, 0.8), _GLASS), ((0.15, 0.25, 0.2, 0.3), (130.0, 120.0, 110.0)),
    ((0.62, 0.6, 0.12, 0.2), (40.0, 35.0, 35.0)),
)  # fmt: skip


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
