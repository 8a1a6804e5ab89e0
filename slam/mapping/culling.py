"""Which landmarks are erased (paper A, IV), and which the map can do without."""

from __future__ import annotations

import numpy as np

from slam.geometry.arrays import Array, BoolArray
from slam.landmarks import LandmarkRows
from slam.mapping.config import MapConfig

_BLOCK = 256  # cost: landmarks that are compared with all others at once


def bad_landmarks(landmarks: LandmarkRows, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) are to be erased: not continuously detected although in view (paper A, IV)."""
    lost = landmarks.missed >= config.erase_missed
    tested = landmarks.in_view > config.erase_missed
    rare = tested & (landmarks.seen < config.erase_share * landmarks.in_view)
    unconfirmed = (landmarks.seen < config.confirmed) & (landmarks.unseen > config.erase_missed)
    unconfirmed &= landmarks.last_seen >= 0  # what an earlier run kept stays until this one has seen it
    unseen = landmarks.last_seen.max(initial=0) - landmarks.last_seen
    forgotten = unseen > config.forget_after if config.forget_after else np.zeros(len(landmarks), bool)
    return np.asarray(lost | rare | unconfirmed | forgotten)


def crowded_landmarks(landmarks: LandmarkRows, positions: Array, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) at `positions` (N, 3) the map can do without, now that they are out of view; see `spacing`.

    Those are compared that have just gone out of view, with each other and with all that did before; those that an
    earlier run kept and this one has not seen yet have not gone out of view.
    """
    out = np.zeros(len(landmarks), bool)
    gone = np.flatnonzero((landmarks.unseen > config.erase_missed) & np.isfinite(landmarks.seen_from[:, 0]))
    just = gone[(landmarks.unseen[gone] <= 2 * config.erase_missed) & (landmarks.last_seen[gone] >= 0)]
    if not len(just) or not config.spacing:
        return out
    reach = config.spacing * np.linalg.norm(positions - landmarks.seen_from, axis=1)
    rank = np.lexsort((-np.arange(len(out)), landmarks.seen)).argsort()  # of equals the older one is the better
    for some in np.split(just, range(_BLOCK, len(just), _BLOCK)):
        gap = positions[some][:, None] - positions[gone][None]
        near = np.einsum("ijk,ijk->ij", gap, gap) < np.minimum(reach[some][:, None], reach[gone][None]) ** 2
        first, second = np.nonzero(near & (some[:, None] != gone[None]))
        one, other = some[first], gone[second]
        out[np.where(rank[one] < rank[other], one, other)] = True
    return out


def surplus_landmarks(landmarks: LandmarkRows, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) to erase so that `max_landmarks` remain: those measured longest ago.

    Among those not measured now, the ones that were measured in one frame only go before all others.
    """
    out = np.zeros(len(landmarks), bool)
    surplus = len(landmarks) - config.max_landmarks
    if surplus > 0:
        now = landmarks.last_seen == landmarks.last_seen.max()
        order = np.lexsort((landmarks.last_seen, landmarks.seen > 1, now))
        out[order[:surplus]] = True
    return out
