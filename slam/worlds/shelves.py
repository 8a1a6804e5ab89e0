"""Painting one bay of a wall of bookshelves."""

from __future__ import annotations

import cv2
import numpy as np

from slam.worlds.brushes import Colour, Page, Rng, clouds, tinted, wood, words
from slam.worlds.surfaces import BOARD, ROW, UPRIGHT, Bay, books_of

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


def paint_bay(bay: Bay, density: float) -> np.ndarray:
    """The picture of one bay, BGR uint8, `density` texels per metre."""
    books, seed = books_of(bay.wall), bay.wall.seed
    rng = np.random.default_rng([seed, 61, bay.number])
    size = round(bay.height * density), round(bay.width * density)
    cloth = 1 + 0.04 * rng.standard_normal(size, np.float32) + 0.04 * clouds(size, rng, 0.012 * density, 2)
    page = Page(tinted(0.32 * cloth, _WOOD), rng, density)  # the back board, seen between and above the books
    left = books.left - bay.left
    for i in np.flatnonzero((left >= 0) & (left < bay.width)).tolist():
        spine = books.width[i] * density, books.height[i] * density
        place = left[i] * density, books.top[i] * density, books.lean[i] * density
        label = (books.height[i] - books.label[i]) * density
        _book(page, cloth, spine, place, label, np.random.default_rng([seed, 62, int(books.series[i])]))
    _shadows(page, bay)
    _woodwork(page, bay)
    return cv2.convertScaleAbs(cv2.subtract(page.picture, (_BLACK, _BLACK, _BLACK, 0)), alpha=_CONTRAST)


def _book(
    page: Page,
    cloth: np.ndarray,
    size: tuple[float, float],
    place: tuple[float, float, float],
    label: float,
    looks: Rng,
) -> None:
    """One book of a width and height: its spine painted upright, leaned over if it leans, and put in its place."""
    (width, height), (left, top, lean) = size, place
    rows, columns = max(4, round(height)), max(4, round(width))
    x0, y0 = max(int(left) - 1, 0), max(int(top) - 1, 0)
    spine = _spine(cloth[y0 : y0 + rows, x0 : x0 + columns], label, page.density, looks, page.rng)
    rows, columns = spine.shape[:2]
    target = np.array([[left + lean, top], [left + lean + width, top], [left + width, top + height]], np.float32)
    source = np.array([[0, 0], [columns, 0], [columns, rows]], np.float32)
    M = cv2.getAffineTransform(source - 0.5, target - np.array([x0, y0], np.float32) - 0.5)
    part = page.picture[y0 : int(top + height) + 3, x0 : int(left + lean + width) + 3]
    shape = part.shape[1], part.shape[0]
    drawn = cv2.warpAffine(spine, M, shape, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    share = cv2.warpAffine(np.ones((rows, columns), np.float32), M, shape, flags=cv2.INTER_LINEAR)
    cv2.blendLinear(drawn, part, share, 1 - share, part)


def _spine(cloth: np.ndarray, label: float, density: float, looks: Rng, rng: Rng) -> np.ndarray:
    """A spine: binding, bands, title, author and the library's label, `label` texels below its top."""
    height, width = cloth.shape
    colour = _BINDINGS[looks.integers(len(_BINDINGS))] * looks.uniform(0.75, 1.2)
    page = Page(tinted(cloth, colour), looks)
    bright = float(colour.mean()) > 120
    ink = _INKS[2 + int(looks.integers(2))] if bright else _INKS[int(looks.integers(2))]
    if looks.random() < 0.45:
        top = looks.uniform(0.06, 0.2)
        field = np.clip(colour * (0.45, 1.7)[int(looks.integers(2))], 0, 250)
        page.bar(page.part(0, top, 1, looks.uniform(0.1, 0.25)), field)
    for _ in range(int(looks.integers(0, 4))):
        page.bar(page.part(0, looks.uniform(0.03, 0.7), 1, looks.uniform(0.004, 0.014)), ink)
    _title(page, ink)
    edge = np.minimum(np.arange(width) + 0.5, width - np.arange(width) - 0.5) / max(0.25 * width, 1.0)
    round_back = np.repeat(0.45 + 0.55 * np.sqrt(np.clip(edge, 0, 1)), 3).astype(np.float32)
    shade = np.tile(round_back.reshape(1, width, 3), (height, 1, 1))
    page = Page(cv2.multiply(page.picture, shade, dtype=cv2.CV_8U), rng)
    _, top, wide, high = mark = (0.08 * width, label - 0.03 * density / 2, 0.84 * width, 0.03 * density)
    page.bar(mark, (225.0, 235.0, 238.0))  # the library's label, with the shelf mark in three lines
    for i in range(3):
        text = "".join(str(d) for d in rng.integers(0, 10, 4 if width > 15 else 2))
        page.write(text, (mark[0] + 1, top + (i + 0.15) * high / 3, wide - 2, 0.7 * high / 3), (30.0, 30.0, 30.0))
    return page.picture


def _title(page: Page, ink: Colour) -> None:
    """Title and author, running down the spine; short ones across it where it is thick."""
    looks, height, width = page.rng, page.height, page.width
    turned = Page(cv2.rotate(page.picture, cv2.ROTATE_90_COUNTERCLOCKWISE), looks)
    high = looks.uniform(0.4, 0.7) * width
    start, end = looks.uniform(0.08, 0.2) * height, 0.62 * height
    turned.title(int(looks.integers(7, 16)), (start, (width - high) / 2, end - start, high), ink)
    page.picture[:] = cv2.rotate(turned.picture, cv2.ROTATE_90_CLOCKWISE)
    if width > 14:
        page.write(words(looks, 5).replace(" ", ""), page.part(0.1, 0.66, 0.8, 0.05), ink)
    if looks.random() < 0.5:
        page.dot(width / 2, 0.045 * height, 0.25 * width, ink)


def _shadows(page: Page, bay: Bay) -> None:
    """The shade under each board, and the light falling off downwards."""
    y = np.arange(page.height, dtype=np.float32) / page.density
    light = 1.0 - 0.18 * y / max(bay.height, 1e-6)
    for board in bay.wall.boards():
        below = y - (board - ROW + BOARD)
        light *= np.where((below > 0) & (below < 0.12), 0.45 + 0.55 * np.clip(below / 0.12, 0, 1) ** 0.6, 1.0)
    for row, share in enumerate(light):
        page.picture[row] = cv2.convertScaleAbs(page.picture[row], alpha=float(share))


def _woodwork(page: Page, bay: Bay) -> None:
    """Boards with labels on their edges, plinth, top, and the bay's share of the uprights beside it."""
    canvas, rng, density = page.picture, page.rng, page.density
    height, width = canvas.shape[:2]
    boards, thick = bay.wall.boards(), round(BOARD * density)
    for board in boards:
        y = round(board * density)
        edge = wood((thick, width), rng, density, _WOOD)
        edge[-2:] //= 2
        canvas[y : y + thick] = edge[: height - y]
        x, top, wide, high = label = (rng.uniform(0.1, 0.7) * density, y + 0.12 * thick, 0.09 * density, 0.76 * thick)
        page.bar(label, (205.0, 235.0, 240.0))
        page.title(6, (x + 3, top + 3, wide - 6, high - 6), (40, 40, 40))
    base = round((bay.height - 0.1 + BOARD) * density)
    canvas[base:] = (0.7 * wood((height - base, width), rng, density, _WOOD)).astype(np.uint8)
    top = max(round((boards[0] - ROW) * density), thick)
    canvas[:top] = wood((top, width), rng, density, _WOOD)
    wide, narrow = (round(share * UPRIGHT / 2 * density) for share in (2, 1))
    left, right = wide if bay.number == 0 else narrow, wide if bay.number == bay.wall.bays - 1 else narrow
    for x, thick in ((0, left), (width - right, right)):
        canvas[:, x : x + thick] = wood((thick, height), rng, density, _WOOD).transpose(1, 0, 2)
    canvas[:, left : left + 3] //= 2
