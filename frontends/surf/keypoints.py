"""Features before they are matched: how many and where, and rows of them, for OpenCV's users ``cv2.KeyPoint``.

The adaptive D_threshold (paper A, III.A) says how many; they are spread over the image.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam.errors import SequenceError
from slam.geometry.arrays import Table
from slam.runtime.compilation import kernel

if TYPE_CHECKING:
    import cv2

#: Angle of upright features [rad]: OpenCV's convention, 270 degrees.
UPRIGHT_ANGLE = 1.5 * np.pi

_NO_ANGLE = -1.0  # fixed: of a cv2.KeyPoint [degrees]


@dataclass(frozen=True, eq=False)
class Keypoints(Table):
    """Detected features, a row each, by falling response.

    As a sequence its items are ``cv2.KeyPoint``: ``cv2.drawKeypoints`` and the like take it as it is.
    """

    uv: NDArray[np.float64]  # pixels (N, 2), the centre of the first pixel at (0, 0)
    size: NDArray[np.float64]  # diameter (N,) [px]: the side of the box filter that responded most
    angle: NDArray[np.float64]  # (N,) [rad] in 0..2π, y down; `UPRIGHT_ANGLE` where upright; NaN where not measured
    response: NDArray[np.float64]  # determinant of the Hessian (N,), on OpenCV's scale for 8-bit images
    laplacian: NDArray[np.int8]  # its sign (N,), +1 for a dark blob on bright ground, 0 where not known
    octave: NDArray[np.int8]  # 0-based octave (N,)

    def __getitem__(self, row: int) -> cv2.KeyPoint:
        import cv2

        degrees = np.nan_to_num(np.rad2deg(self.angle[row]), nan=_NO_ANGLE)
        x, y, size, turn, response = map(float, (*self.uv[row], self.size[row], degrees, self.response[row]))
        return cv2.KeyPoint(x, y, size, turn, response, int(self.octave[row]), int(self.laplacian[row]))

    def __iter__(self) -> Iterator[cv2.KeyPoint]:
        return (self[row] for row in range(len(self)))

    def __repr__(self) -> str:
        return f"Keypoints({len(self)} features)"

    @classmethod
    def from_cv2(cls, keypoints: Iterable[cv2.KeyPoint]) -> Keypoints:
        """Of OpenCV's key points, of any detector, in their order.

        Raises SequenceError where something else is among them, or a place or size is impossible.
        """
        if isinstance(keypoints, Keypoints):
            return keypoints
        try:
            rows = [(*k.pt, k.size, k.angle, k.response, k.class_id, k.octave & 0xFF) for k in keypoints]
        except (TypeError, AttributeError):
            raise SequenceError("key points must be cv2.KeyPoint objects") from None
        table = np.array(rows, float).reshape(-1, 7)
        if not np.isfinite(table).all() or (table[:, 2] <= 0).any():
            raise SequenceError("a key point has no finite place, or no size")
        u, v, size, degrees, response, sign, octave = table.T
        angle = np.where(degrees < 0, np.nan, np.deg2rad(degrees))
        laplacian = np.where(np.abs(sign) == 1, sign, 0).astype(np.int8)
        uv = np.stack([u, v], axis=1)
        return cls(uv, size.copy(), angle, response.copy(), laplacian, octave.astype(np.uint8).astype(np.int8))


_DEAD_BAND = 0.15  # relative error of the count that is left alone
_LARGEST_STEP = 4.0  # the threshold changes by at most this factor
_GAIN = 0.8  # the count falls more slowly than the threshold rises, so that this damps


def adapted_threshold(threshold: float, count: int, target: int, least: float, most: float) -> float:
    """D_threshold for the next image (paper A, III.A) after `count` features were found at `threshold`.

    The logarithm of the threshold moves in proportion to that of ``count / target``, which damps it; a count within
    15 % of the target leaves it alone, so that it does not oscillate.
    """
    ratio = max(count, 1) / target
    if abs(ratio - 1.0) > _DEAD_BAND:
        threshold = max(threshold, 1e-3) * float(np.clip(ratio**_GAIN, 1 / _LARGEST_STEP, _LARGEST_STEP))
    return float(np.clip(threshold, least, most))


@kernel
def spread(uv, limit, grid, size):
    """Which features (N,) are kept so that they are spread over the image: `limit` at most, of those the strongest.

    `uv` are pixels (N, 2), strongest first; `grid` has columns and rows of cells in an image of width and height `size`
    [px]. Each cell has an equal share of `limit`; what some leave over goes to the strongest of the others.
    """
    kept, count = np.zeros(len(uv), np.bool_), np.zeros((grid[1], grid[0]), np.int64)
    share = -(-limit // (grid[0] * grid[1]))
    for k in range(len(uv)):
        column = min(max(int(uv[k, 0] * (grid[0] / size[0])), 0), grid[0] - 1)
        row = min(max(int(uv[k, 1] * (grid[1] / size[1])), 0), grid[1] - 1)
        kept[k] = limit > 0 and count[row, column] < share
        limit -= kept[k]
        count[row, column] += 1
    for k in range(len(uv)):
        if limit > 0 and not kept[k]:
            kept[k] = True
            limit -= 1
    return kept
