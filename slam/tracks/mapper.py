"""Updates the map after a frame: counts, erases and adds landmarks, both in the system's rows and in the back end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.checks import in_front
from slam.data import BoolArray, IdArray, IndexArray
from slam.errors import ConfigurationError
from slam.geometry.arrays import Array, isin
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.rig import StereoRig
from slam.interfaces import Backend, MapBackend
from slam.third_party import checked
from slam.tracks.config import MapConfig
from slam.tracks.localizer import LandmarkMatches, Localizer
from slam.tracks.management import (
    bad_landmarks,
    crowded_landmarks,
    doubled_landmarks,
    known_features,
    new_landmarks,
    surplus_landmarks,
)
from slam.tracks.monocular import depths_by_motion, frame_covariance, unclaimed
from slam.tracks.step import Step
from slam.tracks.table import LandmarkTable, Tracks
from slam.tracks.visibility import MapView, expected_landmarks


class Mapper:
    """Keeps the map of a system; within a step, nothing else adds landmarks to a back end or removes them.

    Args:
        rig: the cameras.
        config: settings.
        localizer: says which landmarks are seen from a similar viewpoint as before.
        backend: the first one; it must have `place` if `config.monocular` is true.

    Raises:
        ConfigurationError: the back end cannot place landmarks.
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
        tracks = step.tracks
        view = self._view(backend, step)
        self._count(view, step)
        rows, landmarks = tracks.mapped, tracks.landmarks()
        bad = isin(landmarks.ids, step.labels.landmarks)
        if step.features.has_stereo.any() or not len(step.features):  # else nothing can take their place
            bad |= bad_landmarks(landmarks, self.config)
        bad |= doubled_landmarks(view, landmarks, self.config)
        bad |= crowded_landmarks(landmarks, view.positions, self.config)
        known = known_features(view, landmarks, step.features, self.config)
        erased = landmarks.ids[bad]
        tracks.erase_landmarks(rows[bad])
        step = self._add(backend, step, known)
        if len(tracks.mapped) > self.config.max_landmarks:
            surplus = tracks.mapped[surplus_landmarks(tracks.landmarks(), self.config)]
            erased = np.concatenate([erased, tracks.ids[surplus]])
            tracks.erase_landmarks(surplus)
        if len(erased):  # once a frame: it costs a filter a copy of its covariance
            backend.remove(erased)
        return replace(step, erased=erased)

    def insert(
        self, backend: Backend, tracks: Tracks, landmarks: LandmarkTable, positions: Array, covariances: Array
    ) -> Tracks:
        """Add the landmarks of an old place (M,) to the map, as from a saved map; those already in it are unchanged.

        Their positions (M, 3) [m] and covariances (M, 3, 3) [m²] are in the back end's world; ids are −1 where a
        landmark needs a new one.
        """
        assert isinstance(backend, MapBackend)  # only such back ends start in a map
        old = landmarks.ids
        new = np.flatnonzero(~np.isin(old, tracks.ids) | (old < 0))
        ids, without = old[new], old[new] < 0
        ids[without] = self._new_ids(int(without.sum()))
        backend.insert(ids, positions[new], covariances[new])
        return tracks.with_landmarks(replace(landmarks.select(new), ids=ids))

    def reconcile(self, backend: Backend, tracks: Tracks | None) -> Tracks | None:
        """Make table and back end agree after an interrupted step: landmarks that only one of them has are erased.

        The back end is as that step left it, the landmarks are those before it; those that stay are returned.
        """
        known = backend.estimate().ids
        strangers = known if tracks is None else np.setdiff1d(known, tracks.ids)
        if len(strangers):
            backend.remove(strangers)
        if tracks is not None:
            tracks = tracks.begun(0, tracks.dof.shape[1])
            tracks.erase_landmarks(np.flatnonzero(~np.isin(tracks.ids, known)))
        return tracks

    def _view(self, backend: Backend, step: Step) -> MapView:
        """The map as the camera sees it."""
        ids = step.tracks.ids[step.tracks.mapped]
        positions = checked(backend, "positions", backend.positions(ids), n=len(ids))
        return MapView.of(self.rig, step.estimate.T_world_left, positions, step.features, self._localizer.pixel_sigma)

    def _count(self, view: MapView, step: Step) -> None:
        """Count landmarks as seen or missed, in place, unless the frame's pose was not measured."""
        m, tracks, rows, matches = self.config, step.tracks, step.tracks.mapped, step.matches
        matches = matches.select(isin(matches.ids, step.report.used))
        expected = rows[:0]
        if not step.tracking.unmatched:
            size = (self.rig.width, self.rig.height)
            shown = expected_landmarks(view, step.features, size, m.view_margin, m.occlusion_radius)
            shown &= self._localizer.similar_view(view.T_world_left, tracks.seen_from[rows], view.positions)
            expected = rows[shown]
        tracks.count_frame(
            step.index, expected, tracks.rows(matches.ids), step.features, matches.rows, m.descriptor_update,
            view.T_world_left[:3, 3], rows[~view.in_image], self._localizer.config.rematch_after,
            rows[isin(tracks.ids[rows], step.suspects)],
        )  # fmt: skip

    def _add(self, backend: Backend, step: Step, known: BoolArray) -> Step:
        """Turn features that are no landmarks yet into landmarks, unless the pose is unknown.

        Features that move, or whose motion label is undecided, are left out.
        """
        features, matches = step.features, step.matches
        if len(step.tracks.mapped) >= MINIMAL_POINTS and not step.tracking.may_add(self.config.restart_after):
            return step
        free = ~known
        free[matches.rows] = free[step.labels.moving] = free[step.labels.undecided] = False
        occupied = features.uv_left[matches.rows]
        rows = new_landmarks(features, free, occupied, self.rig, self._localizer.pixel_sigma, self.config)
        step = self._with_new(step, rows)
        if len(rows):
            backend.add(step.added.observations(features))
        wanted = self.config.monocular or (self.config.monocular is None and not features.has_stereo.any())
        if not (wanted and isinstance(backend, MapBackend) and len(matches) >= MINIMAL_POINTS):
            return step
        return self._add_monocular(backend, step, np.flatnonzero(free & ~features.has_stereo))

    def _add_monocular(self, backend: Backend, step: Step, rows: IndexArray) -> Step:
        """Turn features `rows` without a stereo match into landmarks once two views give depth (paper B, 2.2)."""
        landmarks, features, matches = step.tracks.landmarks(), step.features, step.matches
        T, sigma = step.estimate.T_world_left, self._localizer.pixel_sigma
        view = self._view(backend, step)
        rows = unclaimed(view, landmarks, features, rows)
        there = isin(matches.ids, landmarks.ids)
        local, stereo = view.local[landmarks.rows(matches.ids[there])], features.has_stereo[matches.rows[there]]
        P = frame_covariance(self.rig, local, stereo, sigma)
        views, found, depths = depths_by_motion(
            self.rig, step.views, features.select(rows), T, P, step.index, sigma, self.config.max_depth_error
        )
        front = np.flatnonzero(in_front(depths.local))
        wanted = max(self.config.target_in_view - len(matches) - len(step.added), 0)
        best = front[np.sort(np.argsort(-features.response[rows[found[front]]], kind="stable")[:wanted])]
        step, count = replace(self._with_new(step, rows[found[best]]), views=views), len(step.added)
        if len(best):
            backend.place(step.added.ids[count:], depths.local[best], depths.covariances[best])  # type: ignore[attr-defined]
        return step

    def _with_new(self, step: Step, rows: IndexArray) -> Step:
        """A step whose features `rows` (M,) are landmarks, with ids that were never used."""
        ids = self._new_ids(len(rows))
        step.tracks.enter_landmarks(step.index, ids, step.features, rows, step.estimate.T_world_left[:3, 3])
        return replace(step, added=step.added.joined(LandmarkMatches(ids, rows)))

    def _new_ids(self, count: int) -> IdArray:
        """Ids that were never used."""
        ids = np.arange(self.next_id, self.next_id + count, dtype=np.int64)
        self.next_id += count
        return ids
