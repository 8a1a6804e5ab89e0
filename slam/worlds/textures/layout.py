"""Where things stand on a textured surface, without painting it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.geometry.se3 import Array

BAY = 0.9  #: width of a bay of shelves [m]
UPRIGHT = 0.03  #: thickness of the uprights between bays [m]
BOARD = 0.025  #: thickness of the boards [m]
ROW = 0.34  #: height from board to board [m]


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

    def moved(self, right: float) -> Books:
        """All books so much farther to the right."""
        return replace(self, left=self.left + right)


def shelf_rows(height: float) -> Array:
    """Heights of the boards' upper faces (R,) [m] from the wall's top, for a wall of this height."""
    return np.asarray(height - 0.1 - ROW * np.arange(int((height - 0.1) / ROW), dtype=float)[::-1])


def fill_shelves(width: float, height: float, seed: int) -> Books:
    """Fill a wall of shelves with books: series side by side, gaps, and leaning books beside gaps."""
    rng = np.random.default_rng([seed, 21])
    rows: list[tuple[float, ...]] = []
    series = 0
    for board in shelf_rows(height):
        for bay in range(max(1, round(width / BAY))):
            x, end = bay * BAY + UPRIGHT, min((bay + 1) * BAY, width) - 0.01
            if rng.random() < 0.35:
                end -= rng.uniform(0.1, 0.45)  # a part of the board is empty
            while x < end:
                series += 1
                volumes = int(rng.integers(3, 9)) if rng.random() < 0.18 else 1
                thick, high = _book_size(rng)
                if x + thick > end:
                    break
                for _ in range(min(volumes, int((end - x) / (thick + 0.002)) or 1)):
                    lean = rng.uniform(0.02, 0.06) if volumes == 1 and rng.random() < 0.03 else 0.0
                    rows.append((x, board - high, thick, high, series, lean, rng.normal(0.045, 0.003)))
                    x += thick + lean + rng.uniform(0.0005, 0.002)
    left, top, wide, tall, kind, lean, label = np.array(rows).T
    return Books(left, top, wide, tall, kind.astype(int), lean, label)


def _book_size(rng: np.random.Generator) -> tuple[float, float]:
    """Thickness and height of a book [m]."""
    return float(np.clip(np.exp(rng.normal(np.log(0.028), 0.4)), 0.012, 0.07)), float(rng.uniform(0.19, 0.29))


def scattered(width: float, height: float, density: float, sizes: tuple[float, float], seed: int) -> Array:
    """Marks (M, 3) spread at random over a surface: x, y, size [m]; `density` per square metre."""
    rng = np.random.default_rng([seed, 22])
    count = round(width * height * density)
    x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
    return np.stack([x, y, np.exp(rng.uniform(np.log(sizes[0]), np.log(sizes[1]), count))], axis=1)


def marks(x: Array, y: Array, size: Array | float) -> Array:
    """Marks (M, 3) from columns."""
    return np.stack(np.broadcast_arrays(x, y, size), axis=1).astype(float)


def windows(width: float, height: float, seed: int) -> Array:
    """Windows of a house front (M, 4): left, top, width, height [m]."""
    rng = np.random.default_rng([seed, 23])
    storeys, columns = max(1, int((height - 0.6) / 3.0)), max(1, int(width / rng.uniform(2.2, 3.2)))
    w, h = rng.uniform(0.9, 1.3), rng.uniform(1.3, 1.7)
    x = (np.arange(columns) + 0.5) * width / columns - w / 2
    y = height - 3.0 * (np.arange(storeys) + 1) + 0.7
    grid_x, grid_y = np.meshgrid(x, y)
    return np.stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, w), np.full(grid_x.size, h)], axis=1)
