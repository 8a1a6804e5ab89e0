"""A world with a board of known corners, for tests of the renderer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from slam.worlds import WorldSequence, open_world
from slam.worlds.geometry import Parts, rectangle
from slam.worlds.scenes import assemble
from slam.worlds.world import Scene


@dataclass(frozen=True)
class Checkers:
    """A chess board; its marks are the corners of its fields."""

    width: float
    height: float
    step: float

    def marks(self) -> np.ndarray:
        x = np.arange(self.step, self.width - 0.01, self.step)
        y = np.arange(self.step, self.height - 0.01, self.step)
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, self.step)], axis=1)

    def paint(self, density: float) -> np.ndarray:
        rows = self._wave(round(self.height * density), self.height)
        columns = self._wave(round(self.width * density), self.width)
        picture = np.rint(130 + 90 * rows[:, None] * columns).astype(np.uint8)
        return np.repeat(picture[..., None], 3, axis=2)

    def _wave(self, texels: int, length: float) -> np.ndarray:
        """A square wave averaged over each texel: a chess board is the product of two."""
        fine = (np.arange(texels * 256) + 0.5) / (texels * 256) * length
        return (1 - 2 * (np.floor(fine / self.step) % 2)).reshape(texels, 256).mean(axis=1)


@pytest.fixture(scope="session")
def board_world() -> Callable[..., WorldSequence]:
    """Makes recordings, along the aisle's path, of three walls painted with chess boards, one of them turned away."""

    def make(query: str, step: float) -> WorldSequence:
        base = open_world(f"aisle?{query}")
        board = Checkers(2.0, 2.0, step)
        walls = [
            rectangle(board, (-0.6, 1.1, 2.3), (1, 0, 0), (0, 0, -1)),
            rectangle(board, (1.4, 1.1, 2.3), (0.8, 0.6, 0), (0, 0, -1)),
            rectangle(board, (3.0, 2.3, 2.3), (1, -0.3, 0), (0, 0, -1)),
        ]
        w = base.world
        values = {**base.values, "density": 1e4}
        parts = Parts(w.stamps, w.T_world_left, walls)
        scene = Scene("boards", lambda _: parts, (0.3, 3.5), 640.0)
        return WorldSequence("board", assemble("board", scene, values, parts), values)

    return make
