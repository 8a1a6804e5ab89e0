"""Painting streets: road, house fronts, cars, and the playing field."""

from __future__ import annotations

import numpy as np

from slam.worlds import brushes as paint
from slam.worlds.brushes import Colour, Size
from slam.worlds.surfaces import Material, scattered, windows

_WALLS: tuple[Colour, ...] = (
    (150, 190, 215),
    (120, 140, 185),
    (190, 205, 215),
    (110, 120, 150),
    (160, 175, 180),
    (120, 165, 200),
)
_PAINTS: tuple[Colour, ...] = (
    (40, 40, 150), (130, 80, 40), (60, 60, 60), (185, 190, 195), (215, 220, 222), (70, 110, 60), (30, 32, 35),
)  # fmt: skip


def house_front(house: Material, density: float) -> np.ndarray:
    """The picture of a house front, BGR uint8, `density` texels per metre."""
    rng = np.random.default_rng([house.seed, 64])
    size = round(house.height * density), round(house.width * density)
    colour = _WALLS[int(rng.integers(len(_WALLS)))]
    light = 1 + 0.06 * paint.clouds(size, rng, 1.5 * density, 5) + 0.03 * rng.standard_normal(size, np.float32)
    canvas = paint.tinted(light, colour)
    if rng.random() < 0.4:
        _bricks(canvas, density, rng)
    width = size[1]
    base = 0.7 * density
    paint.bar(canvas, (0, size[0] - base, width, base), (95.0, 100.0, 105.0))
    paint.bar(canvas, (0, 0, width, 0.35 * density), (70.0, 80.0, 110.0))
    for left, top, w, h in windows(house) * density:
        _window(canvas, (left, top, w, h), density, rng)
    _door(canvas, size, density, rng)
    for x, y, diameter in scattered(house) * density:
        darker = rng.uniform(0.55, 0.85)
        shade = (colour[0] * darker, colour[1] * darker, colour[2] * darker)
        paint.bar(canvas, (x - diameter / 2, y - diameter / 6, diameter, diameter / 3), shade)
    if rng.random() < 0.5:
        sign = (0.15 * width, size[0] - 3.0 * density, rng.uniform(2.0, 4.0) * density, 0.5 * density)
        paint.bar(canvas, sign, tuple(rng.uniform(30, 200, 3)))
        paint.lettering(canvas, paint.words(rng, 9), sign, (240.0, 240.0, 240.0), rng)
    return canvas


def _bricks(canvas: np.ndarray, density: float, rng: np.random.Generator) -> None:
    """Courses of bricks."""
    height, width = canvas.shape[:2]
    course, length = 0.09 * density, 0.26 * density
    for row, y in enumerate(np.arange(0, height, course)):
        shift = length / 2 * (row % 2)
        for x in np.arange(-shift, width, length):
            if rng.random() < 0.25:
                x0, y0 = max(int(x), 0), int(y)
                part = canvas[y0 : int(y + course), x0 : int(x + length)]
                np.copyto(part, (part * rng.uniform(0.75, 0.95)).astype(np.uint8))


def _window(canvas: np.ndarray, box: paint.Box, density: float, rng: np.random.Generator) -> None:
    """A window with its frame, panes, sill, and sometimes shutters or a curtain."""
    left, top, w, h = box
    frame = 0.07 * density
    paint.bar(canvas, (left - frame, top - frame, w + 2 * frame, h + 2 * frame), (225.0, 230.0, 232.0))
    glass = rng.uniform(35, 90)
    paint.bar(canvas, box, (glass * 1.2, glass * 1.05, glass))
    if rng.random() < 0.5:
        paint.bar(canvas, (left, top, w * rng.uniform(0.2, 0.45), h), (170.0, 185.0, 195.0))
    paint.bar(canvas, (left + w / 2 - frame / 2, top, frame, h), (220.0, 225.0, 228.0))
    paint.bar(canvas, (left, top + 0.35 * h, w, 0.7 * frame), (220.0, 225.0, 228.0))
    paint.bar(canvas, (left - 1.5 * frame, top + h + frame, w + 3 * frame, frame), (110.0, 115.0, 120.0))
    if rng.random() < 0.25:
        shutter = tuple(rng.uniform(40, 130, 3))
        for x in (left - frame - 0.45 * w, left + w + frame):
            paint.bar(canvas, (x, top, 0.42 * w, h), shutter)


def _door(canvas: np.ndarray, size: Size, density: float, rng: np.random.Generator) -> None:
    """A door."""
    left, top = rng.uniform(0.4, 0.6) * size[1], size[0] - 2.2 * density
    paint.bar(canvas, (left - 0.1 * density, top - 0.1 * density, 1.2 * density, 2.3 * density), (200.0, 205.0, 210.0))
    paint.bar(canvas, (left, top, density, 2.2 * density), tuple(rng.uniform(30, 110, 3)))
    paint.bar(canvas, (left + 0.2 * density, top + 0.2 * density, 0.6 * density, 0.7 * density), (70.0, 60.0, 55.0))
    paint.dot(canvas, left + 0.88 * density, top + 1.2 * density, 0.05 * density, (200.0, 210.0, 215.0))


def road(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A street running down the picture: asphalt, kerbs, pavements, a dashed line and a few dark patches."""
    height, width = size
    canvas = asphalt(size, rng, density)
    for left, right in ((0.0, 1.4), (width / density - 1.9, width / density)):
        x0, x1 = round(left * density), round(right * density)
        stones = 1 + 0.05 * paint.clouds((height, x1 - x0), rng, 0.3 * density)
        canvas[:, x0:x1] = paint.tinted(stones, (140.0, 143.0, 146.0))
        for y in np.arange(0, height, 0.5 * density):
            paint.bar(canvas, (x0, y, x1 - x0, 0.03 * density), (105.0, 108.0, 110.0))
        kerb = right if left == 0 else left
        paint.bar(canvas, ((kerb - 0.08) * density, 0, 0.16 * density, height), (170.0, 172.0, 174.0))
    middle = 7.4 * density  # between the lanes
    for y in np.arange(0, height, 6 * density):
        paint.bar(canvas, (middle - 0.07 * density, y, 0.14 * density, 3 * density), (215.0, 218.0, 220.0))
    return canvas


def asphalt(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """Asphalt with nothing on it."""
    light = 1 + 0.05 * paint.clouds(size, rng, 2.0 * density, 4) + 0.06 * paint.clouds(size, rng, 2.0, 1)
    return paint.tinted(light, (88.0, 86.0, 85.0))


def road_across(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """The same, running across the picture."""
    return np.ascontiguousarray(np.rot90(road((size[1], size[0]), rng, density)))


def car_side(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """The side of a car below its windows: doors, handles and wheels."""
    canvas = paintwork(size, rng, density)
    height, width = size
    for x in (0.36, 0.60, 0.82):
        paint.bar(canvas, (x * width, 0, 0.02 * density, 0.8 * height), (25.0, 25.0, 28.0))
    for x in (0.40, 0.64):
        paint.bar(canvas, (x * width, 0.22 * height, 0.18 * density, 0.05 * density), (190.0, 190.0, 190.0))
    for x in (0.18, 0.80):
        paint.dot(canvas, x * width, 0.85 * height, 0.34 * density, (25.0, 25.0, 25.0))
        paint.dot(canvas, x * width, 0.85 * height, 0.2 * density, (165.0, 165.0, 165.0))
        paint.dot(canvas, x * width, 0.85 * height, 0.06 * density, (60.0, 60.0, 60.0))
    return canvas


def car_end(size: Size, rng: np.random.Generator, density: float, lamp: Colour) -> np.ndarray:
    """The front or the back of a car below its windows: lamps, number plate, bumper."""
    canvas = paintwork(size, rng, density)
    height, width = size
    for x in (0.05, 0.77):
        paint.bar(canvas, (x * width, 0.18 * height, 0.18 * width, 0.2 * height), lamp)
    plate = (0.32 * width, 0.5 * height, 0.36 * width, 0.16 * height)
    paint.bar(canvas, plate, (240.0, 240.0, 240.0))
    inner = (plate[0] + 2, plate[1] + 1, plate[2] - 4, plate[3] - 2)
    paint.lettering(canvas, paint.words(rng, 6), inner, (20, 20, 20), rng)
    paint.bar(canvas, (0, 0.72 * height, width, 0.12 * height), (55.0, 55.0, 58.0))
    for x in (0.05, 0.78):
        paint.bar(canvas, (x * width, 0.84 * height, 0.17 * width, 0.16 * height), (20.0, 20.0, 20.0))
    return canvas


def cabin_side(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """The windows along a car's side."""
    canvas = paintwork(size, rng, density)
    height, width = size
    for x0, x1 in ((0.04, 0.46), (0.50, 0.92)):
        paint.bar(canvas, (x0 * width, 0.18 * height, (x1 - x0) * width, 0.75 * height), (75.0, 65.0, 55.0))
        paint.bar(canvas, ((x0 + 0.05) * width, 0.25 * height, 0.08 * width, 0.6 * height), (125.0, 115.0, 105.0))
    return canvas


def cabin_end(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A car's windscreen or rear window."""
    canvas = paintwork(size, rng, density)
    height, width = size
    paint.bar(canvas, (0.07 * width, 0.15 * height, 0.86 * width, 0.8 * height), (75.0, 65.0, 55.0))
    paint.bar(canvas, (0.15 * width, 0.25 * height, 0.2 * width, 0.3 * height), (130.0, 120.0, 110.0))
    paint.bar(canvas, (0.62 * width, 0.6 * height, 0.12 * width, 0.2 * height), (40.0, 35.0, 35.0))
    return canvas


def paintwork(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """Car paint (roof, bonnet); its colour is drawn first, so that all sides of a car have the same."""
    colour = _PAINTS[int(rng.integers(len(_PAINTS)))]
    light = 1.05 - 0.25 * np.linspace(0, 1, size[0], dtype=np.float32)[:, None]
    return paint.tinted(light + 0.02 * paint.clouds(size, rng, 0.3 * density), colour)


def field(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A robots' playing field: green carpet with white lines."""
    height, width = size
    light = 1 + 0.09 * paint.clouds(size, rng, 0.012 * density, 2) + 0.05 * paint.clouds(size, rng, 0.3 * density)
    canvas = paint.tinted(light, (60.0, 125.0, 55.0))
    white, line = (225.0, 232.0, 228.0), 0.05 * density
    edge = 0.35 * density
    for box in (
        (edge, edge, width - 2 * edge, line),
        (edge, height - edge, width - 2 * edge, line),
        (edge, edge, line, height - 2 * edge),
        (width - edge, edge, line, height - 2 * edge),
        (width / 2, edge, line, height - 2 * edge),
    ):
        paint.bar(canvas, box, white)
    paint.ring(canvas, width / 2, height / 2, 0.6 * density, line, white)
    return canvas
