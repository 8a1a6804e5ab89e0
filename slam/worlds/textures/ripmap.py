"""Area-averaged versions of a texture, reduced separately along its rows and its columns (a ripmap)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

#: Reductions are powers of the fourth root of two: neighbours are hardly less sharp than each other, so that a corner
#: on the seam between two of them stays in its place.
STEPS_PER_OCTAVE = 4


class Ripmap:
    """A texture and its reductions, each made when it is first asked for, from one about half as reduced.

    Attributes:
        picture: the full picture (H, W[, 3]) uint8.
    """

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self._levels: dict[tuple[int, int], np.ndarray] = {(0, 0): picture}

    def level(self, span: Sequence[float]) -> np.ndarray:
        """The picture with texels about as wide and as high as `span` (2,), shares of the picture; none smaller."""
        size = self.picture.shape[1], self.picture.shape[0]
        return self._level(_step(span[0], size[0]), _step(span[1], size[1]))

    def _level(self, across: int, down: int) -> np.ndarray:
        """The picture reduced by so many steps along its rows and its columns.

        What it is made from depends on these alone, so that it is the same whatever was asked for before.
        """
        found = self._levels.get((across, down))
        if found is None:
            source = self._level(_source(across), _source(down))
            height, width = self.picture.shape[:2]
            size = [max(1, round(n * 2 ** (-k / STEPS_PER_OCTAVE))) for n, k in ((width, across), (height, down))]
            found = cv2.resize(source, size, interpolation=cv2.INTER_AREA)
            self._levels[across, down] = found
        return found


def _step(span: float, length: int) -> int:
    """The step whose texels are nearest to a share `span` of `length` texels; at least one is left."""
    reduction = min(max(span * length, 1.0), float(length))
    return round(STEPS_PER_OCTAVE * math.log2(reduction))


def _source(step: int) -> int:
    """The step from which another is made: whole octaves, at least one and less than two before it.

    An average of averages over as many texels as that is hardly less sharp than one over the full picture's.
    """
    return STEPS_PER_OCTAVE * max(0, step // STEPS_PER_OCTAVE - 1)
