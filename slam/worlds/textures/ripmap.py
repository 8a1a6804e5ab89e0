"""Area-averaged versions of a texture, reduced separately along its rows and its columns (a ripmap)."""

from __future__ import annotations

import math

import cv2
import numpy as np

#: Reductions are powers of the square root of two.
STEPS_PER_OCTAVE = 2


class Ripmap:
    """A texture and its reductions, each made from the full picture when it is first asked for.

    Attributes:
        picture: the full picture (H, W[, 3]) uint8.
    """

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self._levels: dict[tuple[int, int], np.ndarray] = {(0, 0): picture}

    def level(self, span: np.ndarray) -> np.ndarray:
        """The picture with texels about as wide and as high as `span` (2,), shares of the picture; none smaller."""
        size = self.picture.shape[1], self.picture.shape[0]
        key = _step(float(span[0]), size[0]), _step(float(span[1]), size[1])
        if key not in self._levels:
            smaller = [max(1, round(n * 2 ** (-k / STEPS_PER_OCTAVE))) for n, k in zip(size, key)]
            self._levels[key] = cv2.resize(self.picture, smaller, interpolation=cv2.INTER_AREA)
        return self._levels[key]


def _step(span: float, length: int) -> int:
    """The step whose texels are nearest to a share `span` of `length` texels; at least one is left."""
    reduction = min(max(span * length, 1.0), float(length))
    return round(STEPS_PER_OCTAVE * math.log2(reduction))
