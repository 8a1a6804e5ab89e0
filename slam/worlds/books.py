"""A wall of bookshelves: where its books stand, and its picture, painted bay by bay as they come into view."""

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
        """The bays, from the left."""
        return [Bay(self, number) for number in range(self.bays)]


@dataclass(frozen=True)
class Bay:
    """One bay, between the middles of its uprights."""

    wall: Shelves
    number: int  # from the left

    @property
    def last(self) -> bool:
        """Whether the wall ends with it."""
        return self.number == self.wall.bays - 1

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
