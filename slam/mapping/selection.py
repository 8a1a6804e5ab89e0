"""Which features become landmarks and which landmarks are dropped (paper A, IV)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.landmarks import LandmarkRows
from slam.models import FORBID_UNKNOWN, require_not_negative
from slam.tracking.association import crowded, pairs_in_boxes
from slam.tracking.visibility import MapView

_SIGMAS = 3.0
_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


@dataclass(frozen=True)
class MapConfig:
    """Settings of the map management.

    Attributes:
        target_in_view: number of measured landmarks to keep up in each frame; fewer, and new ones are added.
        grid: cells (columns, rows) over the image; new landmarks go first where the cell has fewest.
        separation: least distance of a new landmark from the landmarks in view [px].
        max_depth_error: largest relative standard deviation of a new landmark's depth.
        erase_missed: a landmark is erased after so many frames in view without being measured ("not continuously
            detected"), and
        erase_share: where it was measured in less than this share of the frames in view (judged from
            `erase_missed` frames on). Frames in which it may be hidden, or lies near the image's border, do not count.
        confirmed: landmarks measured in fewer frames than these do not stay once they are out of view or hidden.
        spacing: of landmarks out of view (or hidden, or seen from elsewhere) that lie nearer to each other than this
            share of the distance that they were first seen from, the one measured in most frames stays; 0 for all: a
            map that grows with every look at the same place.
        forget_after: landmarks not measured for so many frames are erased wherever they are, so that nothing is seen
            again; 0 for never: the map lasts.
        view_margin: distance from the border [px] within which a landmark is not sure to be detected.
        occlusion_radius: a landmark is taken to be hidden where most features so near to it [px] are nearer to the
            camera; 0 for never.
        same_distance: landmarks so near to each other [m], or nearer than stereo can tell apart,
        same_descriptor: with descriptors so near, are one and the same.
        descriptor_update: weight of a landmark's newest descriptor against the one kept; 1 keeps the last, 0 the first.
        lost_after: where no landmark was recognised for so many frames and the prediction is vague, the camera is lost.
        restart_after: where nothing was recognised in so many frames that showed enough features for it, the place is
            taken for an unknown one: new landmarks are added from the predicted pose; again after as many frames.
        max_landmarks: size of the map; beyond it, those measured longest ago are erased.
        monocular: features without a stereo match become landmarks too, when two views give their depth (paper B, 2.2).
    """

    target_in_view: int = 80
    grid: tuple[int, int] = (8, 4)
    separation: float = 8.0
    max_depth_error: float = 0.2
    erase_missed: int = 5
    erase_share: float = 0.3
    confirmed: int = 6
    spacing: float = 0.1
    forget_after: int = 0
    view_margin: float = 16.0
    occlusion_radius: float = 12.0
    same_distance: float = 0.02
    same_descriptor: float = 0.4
    descriptor_update: float = 0.0
    lost_after: int = 5
    restart_after: int = 30
    max_landmarks: int = 1000
    monocular: bool = False

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self)
        if self.target_in_view < 3 or self.max_landmarks < self.target_in_view:
            raise ConfigurationError("map: 3 <= target_in_view <= max_landmarks is required")
        if min(self.grid) < 1 or self.separation < 0:
            raise ConfigurationError("map: grid cells must be at least 1 and separation not negative")
        if not (0 < self.max_depth_error < 1 and 0 <= self.erase_share < 1):
            raise ConfigurationError("map: max_depth_error or erase_share is out of range")
        if min(self.erase_missed, self.lost_after, self.restart_after) < 1 or self.descriptor_update > 1:
            raise ConfigurationError(
                "map: erase_missed, lost_after and restart_after >= 1 and descriptor_update <= 1 are required"
            )


def bad_landmarks(landmarks: LandmarkRows, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) are to be erased: not continuously detected although in view (paper A, IV)."""
    lost = landmarks.missed >= config.erase_missed
    judged = landmarks.in_view > config.erase_missed
    rare = judged & (landmarks.seen < config.erase_share * landmarks.in_view)
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
    gap = positions[just][:, None] - positions[gone][None]
    near = np.einsum("ijk,ijk->ij", gap, gap) < np.minimum(reach[just][:, None], reach[gone][None]) ** 2
    rank = np.lexsort((-np.arange(len(out)), landmarks.seen)).argsort()  # of equals the older one is the better
    first, second = np.nonzero(near & (just[:, None] != gone[None]))
    one, other = just[first], gone[second]
    out[np.where(rank[one] < rank[other], one, other)] = True
    return out


def surplus_landmarks(landmarks: LandmarkRows, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) to erase so that `max_landmarks` remain: those measured longest ago.

    Among those not measured now, the ones that were never recognised after their first sight go before all others.
    """
    out = np.zeros(len(landmarks), bool)
    surplus = len(landmarks) - config.max_landmarks
    if surplus > 0:
        now = landmarks.last_seen == landmarks.last_seen.max()
        order = np.lexsort((landmarks.last_seen, landmarks.seen > 1, now))
        out[order[:surplus]] = True
    return out


def known_features(view: MapView, landmarks: LandmarkRows, features: StereoFeatures, config: MapConfig) -> BoolArray:
    """Which features (F,) are landmarks although they were not recognised: the same place and the same looks.

    The place is the same within `same_distance`, or within what the depth's uncertainty allows along the line of sight.
    """
    out = np.zeros(len(features), bool)
    feature, rows = _near_landmarks(features.uv_left, view, config)
    offset = view.points[feature] - view.local[rows]
    along = np.abs(offset[:, 2]) < _SIGMAS * view.depth_sigma[feature]
    same = along | (np.linalg.norm(offset, axis=1) < config.same_distance)
    same &= _alike(landmarks, rows, features.descriptors[feature], features.laplacian[feature], config)
    out[feature[same]] = True
    return out


def doubled_landmarks(view: MapView, landmarks: LandmarkRows, config: MapConfig) -> BoolArray:
    """Which landmarks in view (N,) are the same as another that was seen more often (or is older)."""
    out = np.zeros(len(landmarks), bool)
    shown = np.flatnonzero(view.in_image)
    one, other = _near_landmarks(view.uv_left[shown], view, config)
    one = shown[one]
    less = (landmarks.seen[one] < landmarks.seen[other]) | (
        (landmarks.seen[one] == landmarks.seen[other]) & (one > other)
    )
    one, other = one[less], other[less]
    same = np.linalg.norm(view.positions[one] - view.positions[other], axis=1) < config.same_distance
    same &= _alike(landmarks, one, landmarks.descriptors[other], landmarks.laplacian[other], config)
    out[one[same]] = True
    return out


def _near_landmarks(uv: Array, view: MapView, config: MapConfig) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of pixels (P, 2) and of landmarks in view that lie near each other in the image."""
    shown = np.flatnonzero(view.in_image)
    if not len(uv) or not len(shown):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    at, which = pairs_in_boxes(uv, np.full((len(uv), 2), _SAME_PIXELS), view.uv_left[shown])
    return at, shown[which]


def _alike(
    landmarks: LandmarkRows,
    rows: NDArray[np.intp],
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    config: MapConfig,
) -> BoolArray:
    """Whether landmarks look like these descriptors (P, D) and signs of the Laplacian (P,)."""
    distance = np.linalg.norm(landmarks.descriptors[rows] - descriptors, axis=1)
    return np.asarray((distance < config.same_descriptor) & (landmarks.laplacian[rows] == laplacian))


def new_landmarks(
    features: StereoFeatures,
    free: BoolArray,
    occupied: Array,
    rig: StereoRig,
    pixel_sigma: float,
    config: MapConfig,
) -> NDArray[np.intp]:
    """Rows of the features that become landmarks.

    Args:
        features: of the frame.
        free: which of them are no landmark (N,).
        occupied: pixels of the landmarks in view (M, 2), measured ones first of all.
        rig: the cameras, for the depth's uncertainty.
        pixel_sigma: noise of uL, vL, uR [px].
        config: settings.
    """
    wanted = config.target_in_view - len(occupied)
    if wanted <= 0 or not len(features):
        return np.zeros(0, np.intp)
    rows = np.flatnonzero(free & features.has_stereo)
    rows = rows[~crowded(features.uv_left[rows], occupied, config.separation)]
    rows = rows[_depth_is_good(features, rows, rig, pixel_sigma, config.max_depth_error)]
    rows = rows[np.argsort(-features.response[rows], kind="stable")]
    return _spread(features.uv_left, rows, occupied, wanted, rig, config)


def _depth_is_good(
    features: StereoFeatures, rows: NDArray[np.intp], rig: StereoRig, pixel_sigma: float, limit: float
) -> BoolArray:
    """Which rows have a positive depth whose relative standard deviation is below the limit."""
    points = rig.triangulate(features.uv_left[rows], features.uv_right[rows])
    variance = rig.triangulation_covariance(points, pixel_sigma)[:, 2, 2]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(variance) < limit * points[:, 2])


def _spread(
    uv: Array, rows: NDArray[np.intp], occupied: Array, wanted: int, rig: StereoRig, config: MapConfig
) -> NDArray[np.intp]:
    """Pick rows (best first) so that the grid fills evenly and no two lie closer than the separation."""
    columns, lines = config.grid
    size = np.array([rig.width / columns, rig.height / lines])

    def cell(pixels: Array) -> NDArray[np.intp]:
        c = np.clip((pixels / size).astype(int), 0, (columns - 1, lines - 1))
        return c[:, 1] * columns + c[:, 0]

    load = np.bincount(cell(occupied), minlength=columns * lines)
    # Each feature's rank in its cell plus what the cell holds already: features of empty cells come first.
    cells = cell(uv[rows])
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(columns * lines))
    rank = np.empty(len(rows), int)
    rank[order] = np.arange(len(rows)) - starts[cells[order]]
    queue = rows[np.argsort(rank + load[cells], kind="stable")]
    chosen: list[int] = []
    taken = np.full((wanted, 2), np.inf)
    for row in queue:
        if len(chosen) == wanted:
            break
        gap = taken[: len(chosen)] - uv[row]
        if not (np.einsum("ij,ij->i", gap, gap) < config.separation**2).any():
            taken[len(chosen)] = uv[row]
            chosen.append(int(row))
    return np.array(chosen, np.intp)
