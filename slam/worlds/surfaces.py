"""Textured surfaces: where something stands out on them is known without painting them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry.se3 import Array


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
class Signs:
    """A white board with four rows of six signs, of which none is like the others: features known beforehand."""

    width: float  # [m]
    height: float  # [m]
    seed: int

    def marks(self) -> Array:
        """The signs."""
        rng = np.random.default_rng([self.seed, 24])
        x, y = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4)
        place = np.stack([x.ravel() * self.width, y.ravel() * self.height], axis=1)
        place += rng.uniform(-0.015, 0.015, place.shape)
        return np.column_stack([place, rng.uniform(0.03, 0.05, len(place))])
