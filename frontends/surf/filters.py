"""The box filters of the fast Hessian detector, on OpenCV's conventions: sizes, rounding, response scale."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Filters(NamedTuple):
    """The filters of one octave, a row per layer (L); the first and the last layer are searched for no maxima."""

    step: int  # distance of the octave's samples [px]
    sizes: NDArray[np.int64]  # of the filters (L,) [px]
    centre: NDArray[np.int64]  # grid steps from a filter's first pixel to its nominal centre (L,)
    corners: NDArray[np.uint64]  # of the boxes along each axis (L, 10) [px], k/9 of the size, rounded half to even
    weights: NDArray[np.float32]  # of DxxDyy and Dxy² (L, 2): box sums divided by their areas, pixels on 0..255
    offsets: NDArray[np.uint64]  # of the 32 box corners in the flat integral image, from the top left (L, 32)
    parts: NDArray[np.bool_]  # which column phases of the three vertical parts a layer reads (L, step, 3)
    columns: NDArray[np.uint64]  # ten columns (L, 10) read in the buffer (3, step, n) of these: see `_read_columns`


@lru_cache(maxsize=64)
def make_filters(octave: int, layers: int, scale: float, stride: int) -> Filters:
    """Filters of one octave.

    Args:
        octave: 0-based.
        layers: number of layers searched for maxima.
        scale: factor that brings pixel values to 0..255.
        stride: width of the integral image.
    """
    sizes = layer_sizes(octave, layers)
    corners = np.rint(sizes[:, None] * np.arange(10) / 9.0).astype(np.int64)
    area = (corners[:, 3] - corners[:, 0]) * (corners[:, 7] - corners[:, 2])
    area_xy = (corners[:, 4] - corners[:, 1]) ** 2
    weights = np.stack([(scale / area) ** 2, 0.81 * (scale / area_xy) ** 2], axis=1).astype(np.float32)
    step = 1 << octave
    parts, columns = _read_columns(corners, step, -(-stride // step))
    offsets = _corner_offsets(corners, stride)
    return Filters(step, sizes, sizes // 2 // step, corners.astype(np.uint64), weights, offsets, parts, columns)


def layer_sizes(octave: int, layers: int) -> NDArray[np.int64]:
    """Filter sizes [px] of one octave (0-based): the layers searched for maxima and one more on either side."""
    return np.array([(9 + 6 * layer) << octave for layer in range(layers + 2)], dtype=np.int64)


#: Boxes (top, bottom, left, right) by their numbered corners: Dxx whole and middle lobe, Dyy likewise, Dxy's four.
BOXES = (
    (2, 7, 0, 9), (2, 7, 3, 6), (0, 9, 2, 7), (3, 6, 2, 7),
    (1, 4, 1, 4), (5, 8, 5, 8), (1, 4, 5, 8), (5, 8, 1, 4),
)  # fmt: skip


def _corner_offsets(corners: NDArray[np.int64], stride: int) -> NDArray[np.uint64]:
    """Flat offsets (L, 32) of the boxes' corners: top left, top right, bottom left, bottom right of each."""
    top, bottom, left, right = (corners[:, [box[k] for box in BOXES]] for k in range(4))
    offsets = [top * stride + left, top * stride + right, bottom * stride + left, bottom * stride + right]
    return np.ascontiguousarray(np.stack(offsets, axis=2).reshape(len(corners), -1)).astype(np.uint64)


def _read_columns(corners: NDArray[np.int64], step: int, n: int) -> tuple[NDArray[np.bool_], NDArray[np.uint64]]:
    """`Filters.parts` and `Filters.columns`: corners 0, 3, 6, 9 of Dxx, 2, 7 of Dyy, 1, 4, 5, 8 of Dxy."""
    part = np.array([0, 0, 0, 0, 1, 1, 2, 2, 2, 2])
    read = corners[:, [0, 3, 6, 9, 2, 7, 1, 4, 5, 8]]
    parts = np.zeros((len(corners), step, 3), np.bool_)
    parts[np.arange(len(corners))[:, None], read % step, part] = True
    return parts, ((part * step + read % step) * n + read // step).astype(np.uint64)
