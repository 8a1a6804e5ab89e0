"""Textured surfaces: where something stands out on them is known without painting them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from slam.geometry.se3 import Array

BAY = 0.9  #: width of a bay of shelves [m]
UPRIGHT = 0.03  #: thickness of the uprights between bays [m]
BOARD = 0.025  #: thickness of the boards [m]
ROW = 0.34  #: height from board to board [m]


@dataclass(frozen=True)
class Material:
    """A piece of a material, with things scattered over it.

    Attributes:
        width, height: size [m].
        material: its name, one of `slam.worlds.painting.PAINTERS`. Some have marks of their own: ``"shelves"`` full
            of books, the ``"facade"`` of a house, and ``"signs"``, of which none is like the others.
        seed: which piece of it.
        density: things scattered per square metre.
        sizes: smallest and largest of them [m].
    """

    width: float
    height: float
    material: str
    seed: int
    density: float = 0.0
    sizes: tuple[float, float] = (0.01, 0.04)

    def marks(self) -> Array:
        """See `slam.worlds.geometry.Texture.marks`."""
        own = {"shelves": _book_marks, "facade": _house_marks, "signs": _signs}.get(self.material)
        return own(self) if own else scattered(self)

    def parts(self) -> list[Bay]:
        """The bays of a wall of shelves, from the left; of all else none."""
        count = max(1, round(self.width / BAY)) if self.material == "shelves" else 0
        return [Bay(self, number, number == count - 1) for number in range(count)]


@dataclass(frozen=True)
class Bay:
    """One bay of a wall of bookshelves, between the middles of its uprights: painted when it comes into view.

    Attributes:
        wall: the whole wall.
        number: of the bay, from the left.
        last: whether the wall ends with it.
    """

    wall: Material
    number: int
    last: bool

    @property
    def left(self) -> float:
        """Where it begins on the wall [m]."""
        return self.number * BAY + UPRIGHT / 2 if self.number else 0.0

    @property
    def width(self) -> float:
        """Its width [m]."""
        return (self.wall.width if self.last else (self.number + 1) * BAY + UPRIGHT / 2) - self.left

    @property
    def height(self) -> float:
        """Its height [m]."""
        return self.wall.height

    def marks(self) -> Array:
        """None: the whole wall has them."""
        return np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Books:
    """Books on a shelf wall, a row each; lengths in metres from the wall's top-left corner.

    Attributes:
        left, top, width, height: of the spine (N,).
        series: books of one series look alike (N,).
        lean: how far the top leans to the right (N,) [m].
        label: height of the centre of the library's label above the board (N,).
    """

    left: Array
    top: Array
    width: Array
    height: Array
    series: np.ndarray
    lean: Array
    label: Array


def shelf_rows(height: float) -> Array:
    """Heights of the boards' upper faces (R,) [m] from the wall's top, for a wall of this height."""
    return np.asarray(height - 0.1 - ROW * np.arange(int((height - 0.1) / ROW), dtype=float)[::-1])


@lru_cache(maxsize=64)
def books_of(wall: Material) -> Books:
    """The books of a wall of shelves: series side by side, gaps, and leaning books beside gaps."""
    rng = np.random.default_rng([wall.seed, 21])
    rows: list[tuple[float, ...]] = []
    series = 0
    for board in shelf_rows(wall.height):
        for bay in range(max(1, round(wall.width / BAY))):
            x, end = bay * BAY + UPRIGHT, min((bay + 1) * BAY, wall.width) - 0.01
            if rng.random() < 0.35:
                end -= rng.uniform(0.1, 0.45)  # a part of the board is empty
            while x < end:
                series += 1
                volumes = int(rng.integers(3, 9)) if rng.random() < 0.18 else 1
                thick = float(np.clip(np.exp(rng.normal(np.log(0.028), 0.4)), 0.012, 0.07))
                high = float(rng.uniform(0.19, 0.29))
                if x + thick > end:
                    break
                for _ in range(min(volumes, int((end - x) / (thick + 0.002)) or 1)):
                    lean = rng.uniform(0.02, 0.06) if volumes == 1 and rng.random() < 0.03 else 0.0
                    rows.append((x, board - high, thick, high, series, lean, rng.normal(0.045, 0.003)))
                    x += thick + lean + rng.uniform(0.0005, 0.002)
    left, top, wide, tall, kind, lean, label = np.array(rows).T
    return Books(left, top, wide, tall, kind.astype(int), lean, label)


def _book_marks(wall: Material) -> Array:
    """Library labels, and the upper left corners of books."""
    b = books_of(wall)
    return np.concatenate(
        [
            np.stack([b.left + b.width / 2, b.top + b.height - b.label, 0.8 * b.width], axis=1),
            np.stack([b.left + b.lean, b.top, 0.6 * b.width], axis=1),
        ]
    )


def scattered(m: Material) -> Array:
    """Marks (M, 3) spread at random over a surface: x, y, size [m]."""
    rng = np.random.default_rng([m.seed, 22])
    count = round(m.width * m.height * m.density)
    x, y = rng.uniform(0, m.width, count), rng.uniform(0, m.height, count)
    return np.stack([x, y, np.exp(rng.uniform(np.log(m.sizes[0]), np.log(m.sizes[1]), count))], axis=1)


def windows(house: Material) -> Array:
    """Windows of a house front (M, 4): left, top, width, height [m]."""
    rng = np.random.default_rng([house.seed, 23])
    storeys, columns = max(1, int((house.height - 0.6) / 3.0)), max(1, int(house.width / rng.uniform(2.2, 3.2)))
    w, h = rng.uniform(0.9, 1.3), rng.uniform(1.3, 1.7)
    x = (np.arange(columns) + 0.5) * house.width / columns - w / 2
    y = house.height - 3.0 * (np.arange(storeys) + 1) + 0.7
    grid_x, grid_y = np.meshgrid(x, y)
    return np.stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, w), np.full(grid_x.size, h)], axis=1)


def _house_marks(house: Material) -> Array:
    """Corners of the windows, and what is scattered on the wall."""
    left, top, width, height = windows(house).T
    corners = [
        np.stack([left + a * width, top + b * height, 0 * left + 0.25], axis=1) for a in (0, 0.5, 1) for b in (0, 1)
    ]
    return np.concatenate([*corners, scattered(house)])


def facade(width: float, height: float, seed: int) -> Material:
    """The front of a house of a size [m], with windows and a door."""
    return Material(width, height, "facade", seed, 0.4, (0.1, 0.4))


def _signs(board: Material) -> Array:
    """Four rows of six signs: features that are known beforehand."""
    rng = np.random.default_rng([board.seed, 24])
    x, y = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4)
    place = np.stack([x.ravel() * board.width, y.ravel() * board.height], axis=1)
    place += rng.uniform(-0.015, 0.015, place.shape)
    return np.column_stack([place, rng.uniform(0.03, 0.05, len(place))])
