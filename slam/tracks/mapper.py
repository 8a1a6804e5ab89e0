"""Birth and death of landmarks after a frame (paper A, IV), in the table of tracks and in the back end alike.

New landmarks are evenly spread and have a well-known depth. Landmarks are erased if they move, have no place in the map
(see `take_census`), or if the map is full.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.checks import in_front
from slam.data import BoolArray, IdArray, IndexArray, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.arrays import Array, among, changed, isin
from slam.geometry.rig import MINIMAL_POINTS, StereoRig
from slam.geometry.se3 import inverse, transform
from slam.interfaces import Backend, MapBackend
from slam.third_party import checked
from slam.tracks.config import MapConfig
from slam.tracks.kernels import births, census
from slam.tracks.localizer import Localizer
from slam.tracks.monocular import depths_by_motion, frame_covariance, unclaimed
from slam.tracks.step import LandmarkMatches, Step
from slam.tracks.table import LandmarkTable, Tracks


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
        tracks, view = step.tracks, self._view(backend, step)
        rows = tracks.mapped
        going, known = self._census(view, step)
        going |= isin(tracks.ids[rows], step.labels.landmarks)
        erased = tracks.ids[rows[going]]
        tracks.erase_landmarks(rows[going])
        # From an unknown pose nothing is added, unless the place is not in the map.
        known_pose = not step.tracking.unmeasured or step.tracking.in_unknown_place(self.config.restart_after)
        if known_pose or len(tracks.mapped) < MINIMAL_POINTS:
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

    def _census(self, view: MapView, step: Step) -> tuple[BoolArray, BoolArray]:
        """`take_census`; none is expected in the frame if its pose was not measured."""
        c, tracks, rows, T = self.config, step.tracks, step.tracks.mapped, step.estimate.T_world_left
        matches, ids = step.matches.select(isin(step.matches.ids, step.report.used)), tracks.ids[rows]
        at = np.searchsorted(ids, matches.ids)
        tracks.renew(
            rows[at], step.features, matches.rows, c.descriptor_update, T[:3, 3], self._localizer.config.rematch_after
        )
        expected = self._localizer.similar_view(T, tracks.seen_from[rows], view.positions)
        expected &= not step.tracking.unmeasured
        withheld = isin(ids, step.suspects)
        return take_census(
            tracks, rows, view, expected, among(len(ids), at), withheld, step.index, step.features, self.rig, c
        )

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
    wanted, rows, left = config.target_in_view - len(occupied), np.flatnonzero(free), rig.left
    if wanted <= 0 or not len(rows):
        return rows[:0]
    rows = rows[np.argsort(-features.response[rows], kind="stable")]
    uv, size = np.ascontiguousarray(features.uv_left), (left.width, left.height)
    return births(uv, rows, np.ascontiguousarray(occupied), wanted, float(config.separation), tuple(config.grid), size)


def depth_is_known(
    rig: StereoRig, features: StereoFeatures, rows: IndexArray, pixel_sigma: float, limit: float
) -> BoolArray:
    """Which rows (K,) of stereo features have a positive depth whose relative standard deviation is below the limit."""
    points = rig.triangulate(features.uv_left[rows], features.uv_right[rows])
    return np.asarray(rig.depth_deviation(points, pixel_sigma) < limit * points[:, 2])


def surplus_landmarks(landmarks: LandmarkTable, config: MapConfig) -> IndexArray:
    """Rows (K,) of the landmarks to erase so that `max_landmarks` remain, of a map that has more.

    First those that were measured in a single frame, then the others by their last measurement, oldest first; those
    measured in the newest frame last.
    """
    now = landmarks.last_seen == landmarks.last_seen.max()
    order = np.lexsort((landmarks.last_seen, landmarks.seen > 1, now))
    return np.sort(order[: len(order) - config.max_landmarks])


def take_census(
    table: LandmarkTable, rows: IndexArray, view: MapView, expected: BoolArray, measured: BoolArray,
    withheld: BoolArray, frame: int, features: StereoFeatures, rig: StereoRig, config: MapConfig,
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Count a frame for the landmarks at `rows` (N,), in place; which of them go, and which features (F,) are of one.

    An `expected` landmark (N,) that was not `measured` (N,) was missed, unless it is near the border, hidden by nearer
    features, or `withheld` (N,) from the update. A landmark goes if it

    - duplicates another one in view that was seen more often, or as often and is older;
    - is not continuously detected although in view (paper A, IV): missed too often in a row, seen in too small a share
      of the frames, or never confirmed; or was not seen for longer than a map remembers. Where no feature could take
      its place it stays, and one of a loaded map until this run has seen it;
    - is out of view, and one of the two has just gone out of view that are closer than `MapConfig.spacing` allows.
    """
    t, c, f = table, config, features
    counts = t.seen, t.in_view, t.missed, t.last_seen, t.out_of_view, t.unseen
    seen = np.ascontiguousarray(f.uv_left), f.descriptors, f.laplacian, f.by_column
    inside = expected & rig.left.in_image(view.uv_left, c.view_margin)
    limits = c.occlusion_radius, c.same_distance, c.same_descriptor
    replaceable = bool(f.has_stereo.any() or not len(f))
    kept = c.erase_missed, c.erase_share, c.confirmed, c.forget_after, float(c.spacing)
    return census(
        rows, counts, t.seen_from, t.descriptors, t.laplacian, tuple(view), inside, measured, withheld, frame, seen,
        limits, replaceable, kept,
    )  # fmt: skip
