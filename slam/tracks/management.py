"""Map management (paper A, IV): which features become landmarks, and which landmarks are erased.

New ones are evenly spread and have a well-known depth. Bad, redundant and doubled ones are erased, and the oldest of a
full map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import StereoFeatures
from slam.geometry.arrays import Array, BoolArray
from slam.geometry.rig import StereoRig
from slam.tracks.config import MapConfig
from slam.tracks.follow import crowded, pairs_in_boxes
from slam.tracks.table import LandmarkTable
from slam.tracks.visibility import MapView


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


_BLOCK = 256  # cost: landmarks compared with all others at once
_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


def bad_landmarks(landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) are to be erased: not continuously detected although in view (paper A, IV).

    Those are the ones that were missed too often in a row, are seen in too small a share of the frames, or were never
    confirmed; and those not seen for longer than a map remembers.
    """
    lost = landmarks.missed >= config.erase_missed
    tested = landmarks.in_view > config.erase_missed
    rare = tested & (landmarks.seen < config.erase_share * landmarks.in_view)
    unconfirmed = (landmarks.seen < config.confirmed) & (landmarks.unseen > config.erase_missed)
    unconfirmed &= landmarks.last_seen >= 0  # a loaded map's landmarks stay until this run has seen them
    unseen = landmarks.last_seen.max(initial=0) - landmarks.last_seen
    forgotten = unseen > config.forget_after if config.forget_after else np.zeros(len(landmarks), bool)
    return np.asarray(lost | rare | unconfirmed | forgotten)


def crowded_landmarks(landmarks: LandmarkTable, positions: Array, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) at `positions` (N, 3) [m] are redundant once out of view; see `MapConfig.spacing`.

    Landmarks that have just gone out of view are compared with each other and with all others out of view. Those of a
    loaded map that this run has not seen yet count among the others only.
    """
    out = np.zeros(len(landmarks), bool)
    gone = np.flatnonzero((landmarks.unseen > config.erase_missed) & np.isfinite(landmarks.seen_from[:, 0]))
    just = gone[(landmarks.unseen[gone] <= 2 * config.erase_missed) & (landmarks.last_seen[gone] >= 0)]
    if not len(just) or not config.spacing:
        return out
    reach = config.spacing * np.linalg.norm(positions - landmarks.seen_from, axis=1)
    rank = np.lexsort((-np.arange(len(out)), landmarks.seen)).argsort()  # among equals, the older is better
    for some in np.split(just, range(_BLOCK, len(just), _BLOCK)):
        gap = positions[some][:, None] - positions[gone][None]
        near = np.einsum("ijk,ijk->ij", gap, gap) < np.minimum(reach[some][:, None], reach[gone][None]) ** 2
        first, second = np.nonzero(near & (some[:, None] != gone[None]))
        one, other = some[first], gone[second]
        out[np.where(rank[one] < rank[other], one, other)] = True
    return out


def surplus_landmarks(landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) to erase so that `max_landmarks` remain.

    First those that were measured in a single frame, then the others by their last measurement, oldest first; those
    measured in the newest frame last.
    """
    out = np.zeros(len(landmarks), bool)
    surplus = len(landmarks) - config.max_landmarks
    if surplus > 0:
        now = landmarks.last_seen == landmarks.last_seen.max()
        order = np.lexsort((landmarks.last_seen, landmarks.seen > 1, now))
        out[order[:surplus]] = True
    return out


def known_features(view: MapView, landmarks: LandmarkTable, features: StereoFeatures, config: MapConfig) -> BoolArray:
    """Which unmatched features (F,) have the position and descriptor of an existing landmark.

    Positions are the same if they are within `same_distance`, or differ in depth by no more than stereo's uncertainty.
    """
    out = np.zeros(len(features), bool)
    feature, rows = _near_landmarks(features.uv_left, view)
    offset = view.points[feature] - view.local[rows]
    along = np.abs(offset[:, 2]) < SIGMAS * view.depth_sigma[feature]
    same = along | (np.linalg.norm(offset, axis=1) < config.same_distance)
    same &= _alike(landmarks, rows, features.descriptors[feature], features.laplacian[feature], config)
    out[feature[same]] = True
    return out


def doubled_landmarks(view: MapView, landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
    """Which landmarks in view (N,) duplicate another one that was seen more often, or as often and is older."""
    out = np.zeros(len(landmarks), bool)
    shown = np.flatnonzero(view.in_image)
    one, other = _near_landmarks(view.uv_left[shown], view)
    one = shown[one]
    less = (landmarks.seen[one] < landmarks.seen[other]) | (
        (landmarks.seen[one] == landmarks.seen[other]) & (one > other)
    )
    one, other = one[less], other[less]
    same = np.linalg.norm(view.positions[one] - view.positions[other], axis=1) < config.same_distance
    same &= _alike(landmarks, one, landmarks.descriptors[other], landmarks.laplacian[other], config)
    out[one[same]] = True
    return out


def _near_landmarks(uv: Array, view: MapView) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of pixels (P, 2) and landmarks in view that are near each other in the image, as rows of both."""
    shown = np.flatnonzero(view.in_image)
    if not len(uv) or not len(shown):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    at, which = pairs_in_boxes(uv, np.full((len(uv), 2), _SAME_PIXELS), view.uv_left[shown])
    return at, shown[which]


def _alike(
    landmarks: LandmarkTable,
    rows: NDArray[np.intp],
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    config: MapConfig,
) -> BoolArray:
    """Whether landmarks at `rows` (P,) match descriptors (P, D) and signs of the Laplacian (P,), pair by pair."""
    distance = np.linalg.norm(landmarks.descriptors[rows] - descriptors, axis=1)
    return np.asarray((distance < config.same_descriptor) & (landmarks.laplacian[rows] == laplacian))
