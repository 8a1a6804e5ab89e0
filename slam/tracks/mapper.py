"""Birth and death of landmarks after a frame (paper A, IV), in the table of tracks and in the back end alike.

New landmarks are evenly spread and have a well-known depth. Landmarks are erased if they are not continuously detected,
move, duplicate another one, crowd a place out of view, or if the map is full.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.checks import in_front
from slam.chi_square import SIGMAS
from slam.data import BoolArray, IdArray, IndexArray, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.arrays import Array, changed, isin
from slam.geometry.rig import MINIMAL_POINTS, StereoRig
from slam.geometry.se3 import inverse, transform
from slam.interfaces import Backend, MapBackend
from slam.third_party import checked
from slam.tracks.config import MapConfig
from slam.tracks.follow import apart, pairs_near
from slam.tracks.localizer import Localizer
from slam.tracks.monocular import depths_by_motion, frame_covariance, unclaimed
from slam.tracks.step import LandmarkMatches, Step
from slam.tracks.table import LandmarkTable, Tracks

_BLOCK = 256  # cost: landmarks compared with all others at once
_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


class MapView(NamedTuple):
    """The map and the frame's features as seen from one pose."""

    positions: Array  # of the landmarks (N, 3) in world coordinates [m]
    local: Array  # the same in left-camera coordinates (N, 3)
    uv_left: Array  # the landmarks' left pixels (N, 2), NaN behind the camera
    in_image: BoolArray  # which landmarks are in front of the camera and inside the left image (N,)
    points: Array  # the features in left-camera coordinates (F, 3), NaN without depth
    depth_sigma: Array  # standard deviations of the features' depths (F,) [m]

    @classmethod
    def of(
        cls, rig: StereoRig, T_world_left: Array, positions: Array, features: StereoFeatures, pixel_sigma: float
    ) -> MapView:
        """Landmarks at `positions` (N, 3) and features, seen from a pose (4, 4)."""
        local = transform(inverse(T_world_left), positions)
        uv = rig.left.project(local)
        points = rig.triangulate(features.uv_left, features.uv_right)
        return cls(positions, local, uv, rig.left.in_image(uv), points, rig.depth_deviation(points, pixel_sigma))


class Mapper:
    """Keeps the map of a system; within a step, nothing else adds landmarks to a back end or removes them.

    Raises ConfigurationError where `config.monocular` is true and the first back end has no `place`.
    """

    def __init__(self, rig: StereoRig, config: MapConfig, localizer: Localizer, backend: Backend) -> None:
        self.rig = rig
        self.config = config
        self.next_id = 0
        self._localizer = localizer
        if config.monocular and not isinstance(backend, MapBackend):
            raise ConfigurationError("map.monocular: this back end cannot place landmarks")

    def update(self, backend: Backend, step: Step) -> Step:
        """Count what was seen, erase bad landmarks, add new ones (paper A, IV)."""
        tracks, features = step.tracks, step.features
        view = self._view(backend, step)
        self._count(view, step)
        rows, landmarks = tracks.mapped, tracks.landmarks()
        doubled, known = duplicates(view, landmarks, features, self.config)
        bad = isin(landmarks.ids, step.labels.landmarks) | doubled
        if features.has_stereo.any() or not len(features):  # else nothing can take their place
            bad |= undetected_landmarks(landmarks, self.config)
        bad |= redundant_landmarks(landmarks, view.positions, self.config)
        erased = landmarks.ids[bad]
        tracks.erase_landmarks(rows[bad])
        if len(tracks.mapped) < MINIMAL_POINTS or step.tracking.may_add(self.config.restart_after):
            for taken in (step.matches.rows, step.labels.moving, step.labels.undecided):
                known[taken] = True
            step = self._add(backend, step, view, ~known)
        if len(tracks.mapped) > self.config.max_landmarks:
            surplus = tracks.mapped[surplus_landmarks(tracks.landmarks(), self.config)]
            erased = np.concatenate([erased, tracks.ids[surplus]])
            tracks.erase_landmarks(surplus)
        if len(erased):  # once a frame: it costs a filter a copy of its covariance
            backend.remove(erased)
        return changed(step, erased=erased)

    def insert(
        self, backend: Backend, tracks: Tracks, landmarks: LandmarkTable, positions: Array, covariances: Array
    ) -> Tracks:
        """Add the landmarks of an old place (M,) to the map, as from a saved map; those already in it are unchanged.

        Their positions (M, 3) [m] and covariances (M, 3, 3) [m²] are in the back end's world; ids are −1 where a
        landmark needs a new one.
        """
        assert isinstance(backend, MapBackend)  # only such back ends start in a map
        new = np.flatnonzero(~np.isin(landmarks.ids, tracks.ids) | (landmarks.ids < 0))
        ids = landmarks.ids[new]
        ids[ids < 0] = self._new_ids(int((ids < 0).sum()))
        backend.insert(ids, positions[new], covariances[new])
        return tracks.with_landmarks(changed(landmarks.select(new), ids=ids))

    def reconcile(self, backend: Backend, tracks: Tracks | None) -> Tracks | None:
        """Make table and back end agree after an interrupted step: landmarks that only one of them has are erased.

        The back end is as that step left it, the landmarks are those before it; those that stay are returned.
        """
        in_backend = backend.estimate().ids
        strangers = in_backend if tracks is None else np.setdiff1d(in_backend, tracks.ids)
        if len(strangers):
            backend.remove(strangers)
        if tracks is not None:
            tracks = tracks.begun(0, tracks.dof.shape[1])
            tracks.erase_landmarks(np.flatnonzero(~np.isin(tracks.ids, in_backend)))
        return tracks

    def _view(self, backend: Backend, step: Step) -> MapView:
        ids = step.tracks.ids[step.tracks.mapped]
        positions = checked(backend, "positions", backend.positions(ids), n=len(ids))
        T, sigma = step.estimate.T_world_left, self._localizer.models.pixel_sigma
        return MapView.of(self.rig, T, positions, step.features, sigma)

    def _count(self, view: MapView, step: Step) -> None:
        """Count landmarks as seen or missed, in place, unless the frame's pose was not measured."""
        m, tracks, rows, T = self.config, step.tracks, step.tracks.mapped, step.estimate.T_world_left
        matches = step.matches.select(isin(step.matches.ids, step.report.used))
        expected = rows[:0]
        if not step.tracking.unmeasured:
            size = (self.rig.left.width, self.rig.left.height)
            shown = expected_landmarks(view, step.features, size, m.view_margin, m.occlusion_radius)
            shown &= self._localizer.similar_view(T, tracks.seen_from[rows], view.positions)
            expected = rows[shown]
        tracks.count_frame(
            step.index, expected, tracks.rows(matches.ids), step.features, matches.rows, m.descriptor_update, T[:3, 3],
            rows[~view.in_image], self._localizer.config.rematch_after, rows[isin(tracks.ids[rows], step.suspects)],
        )  # fmt: skip

    def _add(self, backend: Backend, step: Step, view: MapView, free: BoolArray) -> Step:
        """Turn `free` features (F,) into landmarks, so far as landmarks are wanted.

        Those without a stereo match become landmarks once two views give depth (paper B, 2.2).
        """
        features, matches, c, sigma = step.features, step.matches, self.config, self._localizer.models.pixel_sigma
        occupied, stereo = features.uv_left[matches.rows], features.has_stereo
        deep = free & (view.depth_sigma < c.max_depth_error * view.points[:, 2])
        step = self._entered(step, new_landmarks(features, deep, occupied, self.rig, c))
        if len(step.added.ids):
            backend.add(step.added.observations(features))
        wanted = c.monocular or (c.monocular is None and not stereo.any())
        if not (wanted and isinstance(backend, MapBackend) and len(matches.ids) >= MINIMAL_POINTS):
            return step
        landmarks, view = step.tracks.landmarks(), self._view(backend, step)
        shown = np.flatnonzero(view.in_image)
        rows = np.flatnonzero(free & ~stereo)
        rows = unclaimed(view.uv_left[shown], landmarks.descriptors[shown], features, rows)
        in_map = isin(matches.ids, landmarks.ids)
        local = view.local[landmarks.rows(matches.ids[in_map])]
        P = frame_covariance(self.rig, local, stereo[matches.rows[in_map]], sigma)
        T = step.estimate.T_world_left
        rows, depths = depths_by_motion(
            self.rig, step.tracks, features, rows, T, P, step.index, sigma, c.max_depth_error
        )  # fmt: skip
        front, before = np.flatnonzero(in_front(depths.local)), len(step.added.ids)
        most = max(c.target_in_view - len(matches.ids) - before, 0)
        best = front[np.sort(np.argsort(-features.response[rows[front]], kind="stable")[:most])]
        step = self._entered(step, rows[best])
        if len(best):
            backend.place(step.added.ids[before:], depths.local[best], depths.covariances[best])
        return step

    def _entered(self, step: Step, rows: IndexArray) -> Step:
        """A step whose features `rows` (M,) have become landmarks, with ids that were never used."""
        ids = self._new_ids(len(rows))
        step.tracks.enter_landmarks(step.index, ids, step.features, rows, step.estimate.T_world_left[:3, 3])
        return changed(step, added=step.added.joined(LandmarkMatches(ids, rows)))

    def _new_ids(self, count: int) -> IdArray:
        ids = np.arange(self.next_id, self.next_id + count, dtype=np.int64)
        self.next_id += count
        return ids


def new_landmarks(
    features: StereoFeatures, free: BoolArray, occupied: Array, rig: StereoRig, config: MapConfig
) -> IndexArray:
    """Rows of the features that become landmarks: the grid fills evenly, and no two lie closer than the separation.

    `free` (N,) says which features have a known depth and belong to no landmark; `occupied` (M, 2) are pixels of the
    landmarks in view, the measured ones first.
    """
    wanted, uv, separation = config.target_in_view - len(occupied), features.uv_left, config.separation
    rows = np.flatnonzero(free)
    if wanted <= 0 or not len(rows):
        return rows[:0]
    at, which = pairs_near(uv[rows], separation, occupied)
    gap = uv[rows[at]] - occupied[which]
    rows = np.delete(rows, at[np.einsum("ij,ij->i", gap, gap) < separation**2])
    rows = rows[np.argsort(-features.response[rows], kind="stable")]
    columns, lines = config.grid
    size = np.array([rig.left.width / columns, rig.left.height / lines])

    def cell(pixels: Array) -> IndexArray:
        c = np.clip((pixels / size).astype(int), 0, (columns - 1, lines - 1))
        return c[:, 1] * columns + c[:, 0]

    # Queue by each feature's rank in its cell plus the cell's landmarks: features of empty cells come first.
    load, cells = np.bincount(cell(occupied), minlength=columns * lines), cell(uv[rows])
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(columns * lines))
    rank = np.empty(len(rows), int)
    rank[order] = np.arange(len(rows)) - starts[cells[order]]
    queue = rows[np.argsort(rank + load[cells], kind="stable")]
    return apart(np.ascontiguousarray(uv), queue, wanted, float(separation))


def depth_is_known(
    rig: StereoRig, features: StereoFeatures, rows: IndexArray, pixel_sigma: float, limit: float
) -> BoolArray:
    """Which rows (K,) of stereo features have a positive depth whose relative standard deviation is below the limit."""
    points = rig.triangulate(features.uv_left[rows], features.uv_right[rows])
    return np.asarray(rig.depth_deviation(points, pixel_sigma) < limit * points[:, 2])


def expected_landmarks(
    view: MapView, features: StereoFeatures, size: tuple[int, int], margin: float, radius: float
) -> BoolArray:
    """Which landmarks (N,) should have been detected: inside an image of this `size` by a `margin` [px], not hidden.

    A landmark is hidden if most of the features within `radius` [px] are clearly nearer than it is.
    """
    with np.errstate(invalid="ignore"):
        inside = ((view.uv_left >= margin) & (view.uv_left <= np.array(size) - 1 - margin)).all(axis=1)
    expected = inside & view.in_image
    rows, stereo = np.flatnonzero(expected), np.flatnonzero(np.isfinite(view.depth_sigma))
    if len(rows) and len(stereo) and radius > 0:
        at, which = pairs_near(view.uv_left[rows], radius, features.uv_left[stereo])
        feature = stereo[which]
        depth = view.points[feature, 2] + SIGMAS * view.depth_sigma[feature]
        # 0.9: a surface nearer than this share of a landmark's depth may hide it
        nearer = np.bincount(at, depth < 0.9 * view.local[rows[at], 2], minlength=len(rows))
        expected[rows[2 * nearer > np.bincount(at, minlength=len(rows))]] = False
    return np.asarray(expected)


def undetected_landmarks(landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
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
    forgotten = unseen > config.forget_after if config.forget_after else np.zeros_like(lost)
    return np.asarray(lost | rare | unconfirmed | forgotten)


def redundant_landmarks(landmarks: LandmarkTable, positions: Array, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) at `positions` (N, 3) [m] are redundant once out of view; see `MapConfig.spacing`.

    Landmarks that have just gone out of view are compared with each other and with all others out of view. Those of a
    loaded map that this run has not seen yet count among the others only.
    """
    out = np.zeros(len(landmarks.ids), bool)
    gone = np.flatnonzero((landmarks.unseen > config.erase_missed) & np.isfinite(landmarks.seen_from[:, 0]))
    just = gone[(landmarks.unseen[gone] <= 2 * config.erase_missed) & (landmarks.last_seen[gone] >= 0)]
    if not len(just) or not config.spacing:
        return out
    reach = config.spacing * np.linalg.norm(positions - landmarks.seen_from, axis=1)
    rank = np.lexsort((-np.arange(len(out)), landmarks.seen)).argsort()  # among equals, the older is better
    for block in np.split(just, range(_BLOCK, len(just), _BLOCK)):
        gap = positions[block][:, None] - positions[gone][None]
        near = np.einsum("ijk,ijk->ij", gap, gap) < np.minimum(reach[block][:, None], reach[gone][None]) ** 2
        first, second = np.nonzero(near & (block[:, None] != gone[None]))
        one, other = block[first], gone[second]
        out[np.where(rank[one] < rank[other], one, other)] = True
    return out


def surplus_landmarks(landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
    """Which landmarks (N,) to erase so that `max_landmarks` remain.

    First those that were measured in a single frame, then the others by their last measurement, oldest first; those
    measured in the newest frame last.
    """
    out = np.zeros(len(landmarks.ids), bool)
    surplus = len(out) - config.max_landmarks
    if surplus > 0:
        now = landmarks.last_seen == landmarks.last_seen.max()
        order = np.lexsort((landmarks.last_seen, landmarks.seen > 1, now))
        out[order[:surplus]] = True
    return out


def duplicates(
    view: MapView, landmarks: LandmarkTable, features: StereoFeatures, config: MapConfig
) -> tuple[BoolArray, BoolArray]:
    """Which landmarks (N,) duplicate one that was seen more often, or as often and is older; which features (F,) any.

    Positions are the same within `same_distance`; a feature's may differ in depth by stereo's uncertainty, too.
    """
    shown = np.flatnonzero(view.in_image)
    uv = np.concatenate([view.uv_left[shown], features.uv_left])
    points = np.concatenate([view.local[shown], view.points])
    slack = np.concatenate([np.zeros(len(shown)), SIGMAS * view.depth_sigma])
    looks = np.concatenate([landmarks.descriptors[shown], features.descriptors])
    signs = np.concatenate([landmarks.laplacian[shown], features.laplacian])
    row, which = pairs_near(uv, _SAME_PIXELS, view.uv_left[shown])
    offset = points[row] - points[which]
    same = (np.abs(offset[:, 2]) < slack[row]) | (np.linalg.norm(offset, axis=1) < config.same_distance)
    same &= (np.linalg.norm(looks[row] - looks[which], axis=1) < config.same_descriptor) & (signs[row] == signs[which])
    row, which = row[same], which[same]
    doubled, known = np.zeros(view.in_image.shape, bool), np.zeros(features.laplacian.shape, bool)
    seen, mark, rival = landmarks.seen[shown], row[row < len(shown)], which[row < len(shown)]
    less = (seen[mark] < seen[rival]) | ((seen[mark] == seen[rival]) & (mark > rival))
    doubled[shown[mark[less]]] = known[row[row >= len(shown)] - len(shown)] = True
    return doubled, known
