"""How many features, and where: the adaptive D_threshold and the spreading over the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.runtime.compilation import kernel

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


def spread(uv: NDArray[np.float64], limit: int, grid: tuple[int, int], size: tuple[int, int]) -> NDArray[np.intp]:
    """Rows of at most `limit` features, spread over the image.

    Args:
        uv: pixels (N, 2), strongest first.
        limit: number to keep.
        grid: columns and rows of cells; each has an equal share of `limit`. What some cells leave over goes to the
            strongest of the others.
        size: width and height of the image [px].

    Returns:
        Indices (K,), ascending, so still strongest first.
    """
    if len(uv) <= limit:
        return np.arange(len(uv))
    return np.flatnonzero(_served(uv, limit, grid, size))


@kernel
def _served(uv, limit, grid, size):
    """Which features (N,) are kept: the share of each cell first, then the strongest of the others."""
    kept, count = np.zeros(len(uv), np.bool_), np.zeros((grid[1], grid[0]), np.int64)
    share = -(-limit // (grid[0] * grid[1]))
    for k in range(len(uv)):
        column = min(max(int(uv[k, 0] * (grid[0] / size[0])), 0), grid[0] - 1)
        row = min(max(int(uv[k, 1] * (grid[1] / size[1])), 0), grid[1] - 1)
        if limit > 0 and count[row, column] < share:
            kept[k] = True
            limit -= 1
        count[row, column] += 1
    for k in range(len(uv)):
        if limit > 0 and not kept[k]:
            kept[k] = True
            limit -= 1
    return kept
