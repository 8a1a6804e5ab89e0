"""Selects features that become landmarks (paper A, IV): evenly spread, with a well-known depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import StereoFeatures
from slam.geometry.arrays import Array, BoolArray
from slam.geometry.rig import StereoRig
from slam.mapping.config import MapConfig
from slam.tracks.follow import crowded, pairs_in_boxes


def new_landmarks(
    features: StereoFeatures, free: BoolArray, occupied: Array, rig: StereoRig, pixel_sigma: float, config: MapConfig
) -> NDArray[np.intp]:
    """Rows of the features that become landmarks.

    `free` (N,) says which features belong to no landmark; `occupied` (M, 2) are pixels of the landmarks in view, the
    measured ones first.
    """
    wanted = config.target_in_view - len(occupied)
    if wanted <= 0 or not len(features):
        return np.zeros(0, np.intp)
    rows = np.flatnonzero(free & features.has_stereo)
    rows = rows[~crowded(features.uv_left[rows], occupied, config.separation)]
    rows = rows[depth_is_known(rig, features, rows, pixel_sigma, config.max_depth_error)]
    rows = rows[np.argsort(-features.response[rows], kind="stable")]
    return _spread(features.uv_left, rows, occupied, wanted, rig, config)


def depth_is_known(
    rig: StereoRig, features: StereoFeatures, rows: NDArray[np.intp], pixel_sigma: float, limit: float
) -> BoolArray:
    """Which rows (K,) of stereo features have a positive depth whose relative standard deviation is below the limit."""
    points = rig.triangulate(features.uv_left[rows], features.uv_right[rows])
    return np.asarray(rig.depth_deviation(points, pixel_sigma) < limit * points[:, 2])


def _spread(
    uv: Array, rows: NDArray[np.intp], occupied: Array, wanted: int, rig: StereoRig, config: MapConfig
) -> NDArray[np.intp]:
    """Pick rows (best first) so that the grid fills evenly and no two lie closer than the separation."""
    if not len(rows):
        return np.zeros(0, np.intp)
    columns, lines = config.grid
    size = np.array([rig.width / columns, rig.height / lines])

    def cell(pixels: Array) -> NDArray[np.intp]:
        c = np.clip((pixels / size).astype(int), 0, (columns - 1, lines - 1))
        return c[:, 1] * columns + c[:, 0]

    load = np.bincount(cell(occupied), minlength=columns * lines)
    # Queue by each feature's rank in its cell plus the cell's landmarks: features of empty cells come first.
    cells = cell(uv[rows])
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(columns * lines))
    rank = np.empty(len(rows), int)
    rank[order] = np.arange(len(rows)) - starts[cells[order]]
    queue = rows[np.argsort(rank + load[cells], kind="stable")]
    # Pairs of features closer than the separation, ordered by place in the queue.
    first, second = pairs_in_boxes(uv[queue], np.full((len(queue), 2), config.separation), uv[queue])
    gap = uv[queue[first]] - uv[queue[second]]
    near = np.einsum("ij,ij->i", gap, gap) < config.separation**2
    begin, second = np.searchsorted(first[near], np.arange(len(queue) + 1)).tolist(), second[near]
    chosen: list[int] = []
    free = np.ones(len(queue), bool)
    for place in range(len(queue)):
        if len(chosen) == wanted:
            break
        if free[place]:
            free[second[begin[place] : begin[place + 1]]] = False
            chosen.append(int(queue[place]))
    return np.array(chosen, np.intp)
