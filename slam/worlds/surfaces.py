"""Textured surfaces, bookshelves among them: where something stands out is known without painting them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from slam.geometry.se3 import Array

BAY = 0.9  #: width of a bay of shelves [m]
UPRIGHT = 0.03  #: thickness of the uprights between bays [m]
BOARD = 0.025  #: thickness of the boards [m]
ROW = 0.34  #: height from board to board [m]


@dataclass(frozen=True)
class Material:
    """A piece of a material, with things scattered over it."""

    width: float  # [m]
    height: float  # [m]
    material: str  # one of `slam.worlds.painting.RECIPES`
    seed: int  # which piece of it
    density: float = 0.0  # things scattered per square metre
    sizes: tuple[float, float] = (0.01, 0.04)  # smallest and largest of them [m]

    def marks(self) -> Array:
        """See `slam.worlds.geometry.Texture.marks`."""
        rng = np.random.default_rng([self.seed, 22])
        count = round(self.width * self.height * self.density)
        x, y = rng.uniform(0, self.width, count), rng.uniform(0, self.height, count)
        return np.stack([x, y, np.exp(rng.uniform(np.log(self.sizes[0]), np.log(self.sizes[1]), count))], axis=1)


@dataclass(frozen=True)
class Facade:
    """The front of a house, with windows, a door, and stains."""

    width: float  # [m]
    height: float  # [m]
    seed: int

    @property
    def stains(self) -> Material:
        """What is scattered on the wall."""
        return Material(self.width, self.height, "", self.seed, 0.4, (0.1, 0.4))

    def windows(self) -> Array:
        """The windows (M, 4): left, top, width, height [m]."""
        rng = np.random.default_rng([self.seed, 23])
        storeys, columns = max(1, int((self.height - 0.6) / 3.0)), max(1, int(self.width / rng.uniform(2.2, 3.2)))
        w, h = rng.uniform(0.9, 1.3), rng.uniform(1.3, 1.7)
        x = (np.arange(columns) + 0.5) * self.width / columns - w / 2
        y = self.height - 3.0 * (np.arange(storeys) + 1) + 0.7
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, w), np.full(grid_x.size, h)], axis=1)

    def marks(self) -> Array:
        """Corners of the windows, and the stains."""
        left, top, width, height = self.windows().T
        at = [(left + a * width, top + b * height, 0 * left + 0.25) for a in (0, 0.5, 1) for b in (0, 1)]
        return np.concatenate([*(np.stack(corner, axis=1) for corner in at), self.stains.marks()])


@dataclass(frozen=True)
class Signs(Material):
    """A board with four rows of six signs: features known beforehand."""

    def marks(self) -> Array:
        """The signs."""
        rng = np.random.default_rng([self.seed, 24])
        x, y = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4)
        place = np.stack([x.ravel() * self.width, y.ravel() * self.height], axis=1)
        place += rng.uniform(-0.015, 0.015, place.shape)
        return np.column_stack([place, rng.uniform(0.03, 0.05, len(place))])


@dataclass(frozen=True)
class Shelves:
    """A wall of bookshelves, full of books."""

    width: float  # [m]
    height: float  # [m]
    seed: int

    @property
    def bays(self) -> int:
        """Their number."""
        return max(1, round(self.width / BAY))

    def boards(self) -> Array:
        """Heights of the boards' upper faces (R,) [m] from the wall's top."""
        rows = int((self.height - 0.1) / ROW)
        return np.asarray(self.height - 0.1 - ROW * np.arange(rows, dtype=float)[::-1])

    def marks(self) -> Array:
        """The library's labels, and the upper left corners of books."""
        b = books_of(self)
        labels = np.stack([b.left + b.width / 2, b.top + b.height - b.label, 0.8 * b.width], axis=1)
        return np.concatenate([labels, np.stack([b.left + b.lean, b.top, 0.6 * b.width], axis=1)])

    def parts(self) -> list[Bay]:
        """The bays, from the left; each reaches from the middle of one upright to that of the next."""
        inside = (number * BAY + UPRIGHT / 2 for number in range(1, self.bays))
        edges = pairwise([0.0, *inside, self.width])
        return [Bay(self, number, left, right - left, self.height) for number, (left, right) in enumerate(edges)]


@dataclass(frozen=True)
class Bay:
    """One bay of a wall of bookshelves."""

    wall: Shelves
    number: int  # from the left
    left: float  # where it begins on the wall [m]
    width: float  # [m]
    height: float  # [m]


@dataclass(frozen=True, eq=False)
class Books:
    """Books on a shelf wall, a row each; lengths in metres from the wall's top-left corner."""

    left: Array  # of the spine (N,)
    top: Array
    width: Array
    height: Array
    series: np.ndarray  # books of one series look alike (N,)
    lean: Array  # how far the top leans to the right (N,)
    label: Array  # height of the centre of the library's label above the board (N,)


@lru_cache(maxsize=64)
def books_of(wall: Shelves) -> Books:
    """The books of a wall: series side by side, gaps, and leaning books beside gaps."""
    rng = np.random.default_rng([wall.seed, 21])
    rows: list[tuple[float, ...]] = []
    series = 0
    for board in wall.boards():
        for bay in range(wall.bays):
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
