"""Which landmarks are erased: bad ones (paper A, IV), redundant ones, and the oldest of a full map."""

from __future__ import annotations

import numpy as np

from slam.geometry.arrays import Array, BoolArray
from slam.mapping.config import MapConfig
from slam.tracks.table import LandmarkTable

_BLOCK = 256  # cost: landmarks compared with all others at once


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
