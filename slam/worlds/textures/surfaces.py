"""Textures of walls, floors, furniture and vehicles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.geometry.se3 import Array
from slam.worlds.textures import layout


@dataclass(frozen=True)
class Shelves:
    """A wall of bookshelves full of books.

    Attributes:
        width, height: size [m].
        seed: which books.
    """

    width: float
    height: float
    seed: int

    @cached_property
    def books(self) -> layout.Books:
        """Where the books stand."""
        return layout.fill_shelves(self.width, self.height, self.seed)

    def marks(self) -> Array:
        """Library labels, and the upper left corners of books."""
        b = self.books
        middle = b.left + b.width / 2
        return np.concatenate(
            [
                layout.marks(middle, b.top + b.height - b.label, 0.8 * b.width),
                layout.marks(b.left + b.lean, b.top, 0.6 * b.width),
            ]
        )

    @property
    def bays(self) -> int:
        """How many bays there are."""
        return max(1, round(self.width / layout.BAY))

    def parts(self) -> list[ShelfBay]:
        """Its bays, from the left."""
        return [ShelfBay(self, number) for number in range(self.bays)]

    def paint(self, density: float) -> np.ndarray:
        """The picture, BGR."""
        return np.concatenate([part.paint(density) for part in self.parts()], axis=1)


@dataclass(frozen=True)
class ShelfBay:
    """One bay of a wall of bookshelves, between the middles of its uprights: painted when it comes into view.

    Attributes:
        shelves: the wall.
        number: of the bay, from the left.
    """

    shelves: Shelves
    number: int

    @property
    def last(self) -> bool:
        """Whether the wall ends with it."""
        return self.number == self.shelves.bays - 1

    @property
    def left(self) -> float:
        """Where it begins on the wall [m]."""
        return self.number * layout.BAY + layout.UPRIGHT / 2 if self.number else 0.0

    @property
    def width(self) -> float:
        """Its width [m]."""
        return (self.shelves.width if self.last else (self.number + 1) * layout.BAY + layout.UPRIGHT / 2) - self.left

    @property
    def height(self) -> float:
        """Its height [m]."""
        return self.shelves.height

    def marks(self) -> Array:
        """None: the whole wall has them."""
        return np.zeros((0, 3))

    def paint(self, density: float) -> np.ndarray:
        """The picture, BGR."""
        from slam.worlds.textures import books

        return books.paint_bay(
            (self.height, self.width), self.shelves.books.moved(-self.left), self.number, self.last, self.shelves.seed,
            density,
        )  # fmt: skip


@dataclass(frozen=True)
class Material:
    """A material with things scattered over it.

    Attributes:
        width, height: size [m].
        material: name of the material, one of `slam.worlds.textures.materials.RECIPES`.
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
        """The scattered things."""
        return layout.scattered(self.width, self.height, self.density, self.sizes, self.seed)

    def paint(self, density: float) -> np.ndarray:
        """The picture, BGR."""
        from slam.worlds.textures import materials

        return materials.paint_material(self.material, (self.height, self.width), self.marks(), self.seed, density)


@dataclass(frozen=True)
class Facade:
    """The front of a house, with windows and a door.

    Attributes:
        width, height: size [m].
        seed: which house.
    """

    width: float
    height: float
    seed: int

    @cached_property
    def windows(self) -> Array:
        """Windows (M, 4): left, top, width, height [m]."""
        return layout.windows(self.width, self.height, self.seed)

    def marks(self) -> Array:
        """Corners of the windows, and what is scattered on the wall."""
        left, top, width, height = self.windows.T
        corners = [layout.marks(left + a * width, top + b * height, 0.25) for a in (0, 0.5, 1) for b in (0, 1)]
        return np.concatenate([*corners, layout.scattered(self.width, self.height, 0.4, (0.1, 0.4), self.seed)])

    def paint(self, density: float) -> np.ndarray:
        """The picture, BGR."""
        from slam.worlds.textures import outdoors

        spots = self.marks()[6 * len(self.windows) :]
        return outdoors.paint_facade((self.height, self.width), self.windows, spots, self.seed, density)


@dataclass(frozen=True)
class SignBoard:
    """A white board with signs in rows and columns, none like the others: features that are known beforehand.

    Attributes:
        width, height: size [m].
        rows, columns: of signs.
        seed: which signs.
    """

    width: float
    height: float
    rows: int
    columns: int
    seed: int

    def marks(self) -> Array:
        """The signs, in rows."""
        rng = np.random.default_rng([self.seed, 24])
        x, y = np.meshgrid((np.arange(self.columns) + 0.5) / self.columns, (np.arange(self.rows) + 0.5) / self.rows)
        place = np.stack([x.ravel() * self.width, y.ravel() * self.height], axis=1)
        place += rng.uniform(-0.015, 0.015, place.shape)
        return layout.marks(place[:, 0], place[:, 1], rng.uniform(0.03, 0.05, len(place)))

    def paint(self, density: float) -> np.ndarray:
        """The picture, BGR."""
        from slam.worlds.textures import things

        return things.sign_board((self.height, self.width), self.marks(), self.seed, density)
