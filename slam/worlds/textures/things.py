"""Painting what lies on desks and hangs on walls."""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.textures import paint
from slam.worlds.textures.paint import Area

Size = tuple[int, int]


def sheet(canvas: np.ndarray, box: paint.Box, rng: np.random.Generator) -> None:
    """A sheet of paper with a heading, print and a picture, pinned up, in place."""
    left, top, width, height = box
    paint.bar(canvas, (left + 0.02 * width, top + 0.02 * height, width, height), (90.0, 95.0, 100.0))
    ground = tuple(rng.uniform(190, 250, 3)) if rng.random() < 0.4 else (232.0, 238.0, 240.0)
    paint.bar(canvas, box, ground)
    ink = tuple(rng.choice([(40, 40, 40), (120, 60, 30), (40, 40, 150)]).astype(float))
    heading = (left + 0.1 * width, top + 0.06 * height, 0.8 * width, 0.1 * height)
    paint.lettering(canvas, paint.words(rng, 8), heading, ink, rng)
    picture = (left + 0.1 * width, top + 0.22 * height, 0.8 * width, 0.3 * height)
    paint.bar(canvas, picture, tuple(rng.uniform(40, 200, 3)))
    for _ in range(3):
        x, y = left + rng.uniform(0.2, 0.8) * width, top + rng.uniform(0.27, 0.47) * height
        paint.dot(canvas, x, y, rng.uniform(0.03, 0.08) * height, tuple(rng.uniform(20, 235, 3)))
    lines = (left + 0.1 * width, top + 0.57 * height, 0.8 * width, 0.36 * height)
    paint.text_lines(canvas, lines, 0.05 * height, ink, rng)


def pinboard(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A cork board with papers pinned to it."""
    height, width = size
    cork = 1 + 0.12 * paint.clouds(size, rng, 0.006 * density, 2)
    canvas = paint.tinted(cork, (95.0, 135.0, 170.0))
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
        paint.bar(canvas, edge, (80.0, 110.0, 140.0))
    paint.bar(canvas, (width - frame, 0, frame, height), (80.0, 110.0, 140.0))
    return canvas


def cover(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """The cover or the spine of a book."""
    height, width = size
    colour = rng.uniform(30, 190, 3)
    canvas = paint.tinted(1 + 0.04 * rng.standard_normal(size, np.float32), tuple(colour))
    ink = (230.0, 235.0, 240.0) if colour.mean() < 120 else (30.0, 30.0, 40.0)
    paint.lettering(canvas, paint.words(rng, 9), (0.1 * width, 0.12 * height, 0.8 * width, 0.12 * height), ink, rng)
    paint.lettering(canvas, paint.words(rng, 7), (0.15 * width, 0.28 * height, 0.7 * width, 0.08 * height), ink, rng)
    paint.bar(canvas, (0.15 * width, 0.45 * height, 0.7 * width, 0.35 * height), tuple(rng.uniform(60, 230, 3)))
    for _ in range(5):
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.5, 0.75) * height
        paint.dot(canvas, x, y, rng.uniform(0.02, 0.09) * min(size), tuple(rng.uniform(20, 240, 3)))
    paint.lettering(canvas, paint.words(rng, 5), (0.3 * width, 0.86 * height, 0.4 * width, 0.06 * height), ink, rng)
    return canvas


def screen(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A monitor with windows full of text and a plot."""
    height, width = size
    canvas = np.full((*size, 3), 25, np.uint8)
    edge = 0.012 * density
    if min(size) < 4 * edge:
        return canvas
    paint.bar(canvas, (edge, edge, width - 2 * edge, height - 2 * edge), (110.0, 70.0, 40.0))
    for left, top, w, h, ground, ink in (
        (0.05, 0.08, 0.45, 0.8, (40.0, 40.0, 40.0), (200.0, 220.0, 200.0)),
        (0.53, 0.05, 0.42, 0.5, (245.0, 245.0, 245.0), (60.0, 50.0, 40.0)),
        (0.57, 0.6, 0.36, 0.32, (250.0, 250.0, 250.0), (150.0, 80.0, 40.0)),
    ):
        box = (left * width, top * height, w * width, h * height)
        paint.bar(canvas, box, ground)
        paint.bar(canvas, (box[0], box[1], box[2], 0.03 * height), (160.0, 160.0, 165.0))
        inner = (box[0] + 0.02 * width, box[1] + 0.06 * height, box[2] - 0.05 * width, box[3] - 0.1 * height)
        paint.text_lines(canvas, inner, 0.035 * height, ink, rng)
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
            paint.bar(canvas, (x + 0.1 * pitch, y + 0.1 * pitch, w - 0.2 * pitch, 0.8 * pitch), (grey, grey, grey))
            letter = paint.words(rng, 3)[0]
            box = (x + 0.25 * pitch, y + 0.2 * pitch, 0.4 * pitch, 0.4 * pitch)
            paint.lettering(canvas, letter, box, (40.0, 40.0, 40.0), rng)
            x += w
        y += pitch
    return canvas


def paper(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A printed page."""
    height, width = size
    canvas = np.full((*size, 3), 238, np.uint8)
    ink = (50.0, 45.0, 45.0)
    paint.lettering(canvas, paint.words(rng, 12), (0.1 * width, 0.06 * height, 0.8 * width, 0.05 * height), ink, rng)
    for column in (0.1, 0.53):
        box = (column * width, 0.16 * height, 0.37 * width, 0.76 * height)
        paint.text_lines(canvas, box, 0.018 * height, ink, rng)
    paint.bar(canvas, (0.12 * width, 0.3 * height, 0.33 * width, 0.14 * height), (225.0, 225.0, 225.0))
    paint.dot(canvas, 0.28 * width, 0.37 * height, 0.05 * height, (120.0, 80.0, 60.0))
    return canvas


def poster(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A poster: heading, shapes, print."""
    height, width = size
    ground = rng.uniform(120, 240, 3)
    canvas = paint.tinted(1 + 0.02 * paint.clouds(size, rng, 0.1 * density), tuple(ground))
    ink = (30.0, 30.0, 40.0)
    paint.lettering(canvas, paint.words(rng, 7), (0.08 * width, 0.04 * height, 0.84 * width, 0.14 * height), ink, rng)
    for _ in range(9):
        x, y = rng.uniform(0.15, 0.85) * width, rng.uniform(0.27, 0.6) * height
        r = rng.uniform(0.02, 0.1) * min(size)
        colour = tuple(rng.uniform(10, 245, 3))
        if rng.random() < 0.5:
            paint.dot(canvas, x, y, r, colour)
        else:
            paint.bar(canvas, (x - r, y - 0.6 * r, 2 * r, 1.2 * r), colour)
    lines = (0.1 * width, 0.7 * height, 0.8 * width, 0.24 * height)
    paint.text_lines(canvas, lines, 0.04 * height, ink, rng)
    return canvas


def wood(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A wooden top."""
    return paint.wood(size, rng, (105.0, 150.0, 190.0), density)


def board(size: Size, rng: np.random.Generator, density: float) -> np.ndarray:
    """A white board."""
    return paint.tinted(1 + 0.01 * paint.clouds(size, rng, 0.2 * density), (205.0, 212.0, 215.0))


def sign_board(area: Area, signs: Array, seed: int, density: float) -> np.ndarray:
    """A white board with signs: discs and squares with a pattern of their own around and on them.

    Args:
        area: height, width [m].
        signs: (N, 3) x, y, diameter [m].
        seed: which patterns.
        density: texels per metre.
    """
    rng = np.random.default_rng([seed, 65])
    size = round(area[0] * density), round(area[1] * density)
    canvas = board(size, rng, density)
    for x, y, diameter in signs * density:
        dark = rng.random() < 0.7
        ground, ink = ((215.0,) * 3, (30.0,) * 3) if dark else ((45.0,) * 3, (225.0,) * 3)
        field = 2.2 * diameter
        paint.bar(canvas, (x - field / 2, y - field / 2, field, field), ground)
        for _ in range(4):
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.75, 0.95) * diameter
            spot = x + far * np.cos(angle), y + far * np.sin(angle)
            paint.dot(canvas, *spot, rng.uniform(0.06, 0.14) * diameter, ink)
        paint.dot(canvas, x, y, diameter / 2, ink)
        for _ in range(2):
            spot = x + rng.uniform(-0.2, 0.2) * diameter, y + rng.uniform(-0.2, 0.2) * diameter
            paint.dot(canvas, *spot, rng.uniform(0.04, 0.08) * diameter, ground)
    return canvas
