"""The response at a continuous place and size, against filters whose corners lie anywhere, written plainly."""

from __future__ import annotations

import numpy as np

from frontends.surf import Surf
from tests.frontends.scenes import photograph, texture

#: Lobes (left, top, right, bottom, weight) of the filters, in ninths of the size.
DXX = ((0, 2, 3, 7, 1), (3, 2, 6, 7, -2), (6, 2, 9, 7, 1))
DYY = tuple((top, left, bottom, right, w) for left, top, right, bottom, w in DXX)
DXY = ((1, 1, 4, 4, 1), (5, 1, 8, 4, -1), (1, 5, 4, 8, -1), (5, 5, 8, 8, 1))


def plain_response(sums: np.ndarray, x: float, y: float, size: float) -> float:
    """Determinant of the Hessian by box filters about a pixel; `sums` are those above and left of pixel corners."""

    def above(u: float, v: float) -> float:
        column, row = int(u), int(v)
        a, b = u - column, v - row
        four = sums[row : row + 2, column : column + 2]
        return float((1 - b) * ((1 - a) * four[0, 0] + a * four[0, 1]) + b * ((1 - a) * four[1, 0] + a * four[1, 1]))

    means = []
    for lobes in (DXX, DYY, DXY):
        total = 0.0
        for *corners, weight in lobes:
            left, right = (x + 0.5 + size * (c / 9 - 0.5) for c in (corners[0], corners[2]))
            top, bottom = (y + 0.5 + size * (c / 9 - 0.5) for c in (corners[1], corners[3]))
            box = above(right, bottom) - above(right, top) - above(left, bottom) + above(left, top)
            total += weight * box / ((right - left) * (bottom - top))
        means.append(total)
    xx, yy, xy = means
    return xx * yy - 0.81 * xy**2  # the weight 0.9 squared: Bay et al., 2008, Eq. 3


def test_responses_are_those_of_plain_filters_at_the_same_place():
    image = photograph(texture(120, 160, seed=5))
    surf = Surf(threshold=200)
    found = surf.localise(image, surf.detect(image))
    sums = np.pad(np.cumsum(np.cumsum(image.astype(float), axis=0), axis=1), ((1, 0), (1, 0)))
    expected = [plain_response(sums, *uv, size) for uv, size in zip(found.uv, found.size)]
    assert len(found) > 30
    off = np.abs(found.response / expected - 1)  # it was taken a last small step earlier
    assert np.median(off) < 0.003 and np.quantile(off, 0.95) < 0.02
