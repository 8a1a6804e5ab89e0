"""Painting a wall of bookshelves."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slam.worlds import brushes as paint
from slam.worlds import surfaces as layout
from slam.worlds.brushes import Colour

_WOOD = (110.0, 150.0, 190.0)
_BLACK, _CONTRAST = 14, 1.25  # so that a detector finds about as many features as in photographs of shelves
#: Cloth and paper of bindings, BGR.
_BINDINGS = np.array(
    [
        (40, 40, 130), (35, 30, 90), (120, 70, 30), (90, 45, 20), (60, 95, 40), (40, 65, 30), (45, 45, 45),
        (30, 30, 35), (60, 100, 160), (45, 75, 120), (150, 160, 170), (190, 205, 215), (215, 225, 230),
        (90, 130, 200), (40, 130, 190), (140, 110, 60), (110, 80, 110), (70, 60, 140), (160, 140, 110), (30, 90, 140),
    ], float,
)  # fmt: skip
_INKS = ((225.0, 235.0, 240.0), (90.0, 190.0, 220.0), (25.0, 25.0, 25.0), (50.0, 50.0, 160.0))


def paint_bay(bay: layout.Bay, density: float) -> np.ndarray:
    """The picture of one bay of a wall of shelves, BGR uint8, `density` texels per metre."""
    area, number, last, seed = (bay.height, bay.width), bay.number, bay.last, bay.wall.seed
    books = layout.books_of(bay.wall)
    books = replace(books, left=books.left - bay.left)
    rng = np.random.default_rng([seed, 61, number])
    size = round(area[0] * density), round(area[1] * density)
    cloth = 1 + 0.04 * rng.standard_normal(size, np.float32) + 0.04 * paint.clouds(size, rng, 0.012 * density, 2)
    canvas = paint.tinted(0.32 * cloth, _WOOD)  # the back board, seen between and above the books
    for i in np.flatnonzero((books.left >= 0) & (books.left < area[1])).tolist():
        _book(canvas, cloth, books, i, density, np.random.default_rng([seed, 62, int(books.series[i])]), rng)
    _shadows(canvas, area[0], density)
    _woodwork(canvas, area[0], (number == 0, last), density, rng)
    return cv2.convertScaleAbs(cv2.subtract(canvas, (_BLACK, _BLACK, _BLACK, 0)), alpha=_CONTRAST)


def _book(
    canvas: np.ndarray, cloth: np.ndarray, books: layout.Books, i: int, density: float, looks: np.random.Generator,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """One book: its spine painted upright, leaned over if it leans, and put in its place."""
    width, height = books.width[i] * density, books.height[i] * density
    shape = max(4, round(height)), max(4, round(width))
    left, top, lean = books.left[i] * density, books.top[i] * density, books.lean[i] * density
    x0, y0 = max(int(left) - 1, 0), max(int(top) - 1, 0)
    label = (books.height[i] - books.label[i]) * density
    spine = _spine(cloth[y0 : y0 + shape[0], x0 : x0 + shape[1]], label, density, looks, rng)
    shape = spine.shape[:2]
    target = np.array([[left + lean, top], [left + lean + width, top], [left + width, top + height]], np.float32)
    source = np.array([[0, 0], [shape[1], 0], [shape[1], shape[0]]], np.float32)
    M = cv2.getAffineTransform(source - 0.5, target - np.array([x0, y0], np.float32) - 0.5)
    part = canvas[y0 : int(top + height) + 3, x0 : int(left + lean + width) + 3]
    size = part.shape[1], part.shape[0]
    drawn = cv2.warpAffine(spine, M, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    share = cv2.warpAffine(np.ones(shape, np.float32), M, size, flags=cv2.INTER_LINEAR)
    cv2.blendLinear(drawn, part, share, 1 - share, part)


def _spine(
    cloth: np.ndarray, label: float, density: float, looks: np.random.Generator, rng: np.random.Generator
) -> np.ndarray:
    """A spine: binding, bands, title, author and the library's label, `label` texels below its top."""
    height, width = cloth.shape
    colour = _BINDINGS[looks.integers(len(_BINDINGS))] * looks.uniform(0.75, 1.2)
    canvas = paint.tinted(cloth, (colour[0], colour[1], colour[2]))
    bright = float(colour.mean()) > 120
    ink = _INKS[2 + int(looks.integers(2))] if bright else _INKS[int(looks.integers(2))]
    _bands(canvas, ink, colour, looks)
    _title(canvas, ink, looks)
    edge = np.minimum(np.arange(width) + 0.5, width - np.arange(width) - 0.5) / max(0.25 * width, 1.0)
    round_back = np.repeat(0.45 + 0.55 * np.sqrt(np.clip(edge, 0, 1)), 3).astype(np.float32)
    canvas = cv2.multiply(canvas, np.tile(round_back.reshape(1, width, 3), (height, 1, 1)), dtype=cv2.CV_8U)
    _label(canvas, label, density, rng)
    return canvas


def _bands(canvas: np.ndarray, ink: Colour, colour: np.ndarray, looks: np.random.Generator) -> None:
    """Bands and fields across a spine."""
    height, width = canvas.shape[:2]
    if looks.random() < 0.45:
        top = looks.uniform(0.06, 0.2)
        field = tuple(np.clip(colour * (0.45, 1.7)[int(looks.integers(2))], 0, 250))
        paint.bar(canvas, (0, top * height, width, looks.uniform(0.1, 0.25) * height), field)
    for _ in range(int(looks.integers(0, 4))):
        paint.bar(canvas, (0, looks.uniform(0.03, 0.7) * height, width, looks.uniform(0.004, 0.014) * height), ink)


def _title(canvas: np.ndarray, ink: Colour, looks: np.random.Generator) -> None:
    """Title and author, running down the spine; short ones across it where it is thick."""
    height, width = canvas.shape[:2]
    turned = cv2.rotate(canvas, cv2.ROTATE_90_COUNTERCLOCKWISE)
    high = looks.uniform(0.4, 0.7) * width
    start, end = looks.uniform(0.08, 0.2) * height, 0.62 * height
    text = paint.words(looks, int(looks.integers(7, 16)))
    paint.lettering(turned, text, (start, (width - high) / 2, end - start, high), ink, looks)
    canvas[:] = cv2.rotate(turned, cv2.ROTATE_90_CLOCKWISE)
    if width > 14:
        name = paint.words(looks, 5).replace(" ", "")
        paint.lettering(canvas, name, (0.1 * width, 0.66 * height, 0.8 * width, 0.05 * height), ink, looks)
    if looks.random() < 0.5:
        paint.dot(canvas, width / 2, 0.045 * height, 0.25 * width, ink)


def _label(canvas: np.ndarray, label: float, density: float, rng: np.random.Generator) -> None:
    """The library's label: white, with the shelf mark in two or three lines."""
    width = canvas.shape[1]
    high = 0.03 * density
    box = (0.08 * width, label - high / 2, 0.84 * width, high)
    paint.bar(canvas, box, (225.0, 235.0, 238.0))
    lines = 3
    for i in range(lines):
        text = "".join(str(d) for d in rng.integers(0, 10, 4 if width > 15 else 2))
        line = (box[0] + 1, box[1] + (i + 0.15) * high / lines, box[2] - 2, 0.7 * high / lines)
        paint.lettering(canvas, text, line, (30.0, 30.0, 30.0), rng)


def _shadows(canvas: np.ndarray, high: float, density: float) -> None:
    """The shade under each board, and the light falling off downwards."""
    y = np.arange(canvas.shape[0], dtype=np.float32) / density
    light = 1.0 - 0.18 * y / max(high, 1e-6)
    for board in layout.shelf_rows(high):
        below = y - (board - layout.ROW + layout.BOARD)
        light *= np.where((below > 0) & (below < 0.12), 0.45 + 0.55 * np.clip(below / 0.12, 0, 1) ** 0.6, 1.0)
    for row, share in enumerate(light):
        canvas[row] = cv2.convertScaleAbs(canvas[row], alpha=float(share))


def _woodwork(
    canvas: np.ndarray, high: float, ends: tuple[bool, bool], density: float, rng: np.random.Generator
) -> None:
    """Boards with labels on their edges, plinth, top, and the bay's share of the uprights beside it.

    `ends` says whether the wall ends on its left and on its right.
    """
    height, width = canvas.shape[:2]
    thick = round(layout.BOARD * density)
    for board in layout.shelf_rows(high):
        y = round(board * density)
        wood = paint.wood((thick, width), rng, _WOOD, density)
        wood[-2:] //= 2
        canvas[y : y + thick] = wood[: height - y]
        _board_label(canvas, y, thick, density, rng)
    base = round((high - 0.1 + layout.BOARD) * density)
    canvas[base:] = (0.7 * paint.wood((height - base, width), rng, _WOOD, density)).astype(np.uint8)
    top = round((layout.shelf_rows(high)[0] - layout.ROW) * density)
    canvas[: max(top, thick)] = paint.wood((max(top, thick), width), rng, _WOOD, density)
    half = layout.UPRIGHT / 2
    wide, narrow = (round(share * half * density) for share in (2, 1))
    on_left = wide if ends[0] else narrow
    on_right = wide if ends[1] else narrow
    for x, thick in ((0, on_left), (width - on_right, on_right)):
        canvas[:, x : x + thick] = paint.wood((thick, height), rng, _WOOD, density).transpose(1, 0, 2)
    canvas[:, on_left : on_left + 3] //= 2


def _board_label(canvas: np.ndarray, y: int, thick: int, density: float, rng: np.random.Generator) -> None:
    """A small paper label on a board's edge."""
    box = (rng.uniform(0.1, 0.7) * density, y + 0.12 * thick, 0.09 * density, 0.76 * thick)
    paint.bar(canvas, box, (205.0, 235.0, 240.0))
    inner = (box[0] + 3, box[1] + 3, box[2] - 6, box[3] - 6)
    paint.lettering(canvas, paint.words(rng, 6), inner, (40, 40, 40), rng)
