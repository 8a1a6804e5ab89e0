"""Updates the map after a frame: counts, erases and adds landmarks, both in the system's rows and in the back end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import BoolArray, IdArray, IndexArray
from slam.errors import ConfigurationError
from slam.geometry.arrays import isin
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.rig import StereoRig
from slam.interfaces import Backend, MapBackend
from slam.mapping.atlas.loop_closer import Found
from slam.mapping.config import MapConfig
from slam.mapping.known_landmarks import in_front
from slam.mapping.management import (
    bad_landmarks,
    crowded_landmarks,
    doubled_landmarks,
    known_features,
    new_landmarks,
    surplus_landmarks,
)
from slam.mapping.monocular import depths_by_motion, frame_covariance, unclaimed
from slam.mapping.step import Step
from slam.third_party import checked
from slam.tracks.localizer import LandmarkMatches, Localizer
from slam.tracks.table import LandmarkTable
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
        view = self._view(backend, step.landmarks, step)
        landmarks = self._count(step.landmarks, view, step)
        bad = isin(landmarks.ids, step.labels.landmarks)
        if step.features.has_stereo.any() or not len(step.features):  # else nothing can take their place
            bad |= bad_landmarks(landmarks, self.config)
        bad |= doubled_landmarks(view, landmarks, self.config)
        bad |= crowded_landmarks(landmarks, view.positions, self.config)
        known = known_features(view, landmarks, step.features, self.config)
        erased, landmarks = landmarks.ids[bad], landmarks.select(~bad)
        step = self._add(backend, replace(step, landmarks=landmarks), known)
        surplus = surplus_landmarks(step.landmarks, self.config)
        erased = np.concatenate([erased, step.landmarks.ids[surplus]])
        if len(erased):  # once a frame: it costs a filter a copy of its covariance
            backend.remove(erased)
        return replace(step, landmarks=step.landmarks.select(~surplus), erased=erased)

    def insert(self, backend: Backend, landmarks: LandmarkTable, place: Found) -> LandmarkTable:
        """Add landmarks of an old place to the map, as from a saved map; those already in it are unchanged."""
        assert isinstance(backend, MapBackend)  # only such back ends start in a map
        old = place.landmarks.ids
        new = np.flatnonzero(~np.isin(old, landmarks.ids) | (old < 0))
        ids, without = old[new], old[new] < 0
        ids[without] = self._new_ids(int(without.sum()))
        backend.insert(ids, place.positions[new], place.covariances[new])
        return landmarks.joined(replace(place.landmarks.select(new), ids=ids))

    def reconcile(self, backend: Backend, landmarks: LandmarkTable | None) -> LandmarkTable | None:
        """Make rows and back end agree after an interrupted step: landmarks that only one of them has are erased.

        The back end is as that step left it, the rows are those before it; those that stay are returned.
        """
        known = backend.estimate().ids
        kept = np.zeros(0, np.int64) if landmarks is None else landmarks.ids
        strangers = np.setdiff1d(known, kept)
        if len(strangers):
            backend.remove(strangers)
        return None if landmarks is None else landmarks.select(np.isin(kept, known))

    def _view(self, backend: Backend, landmarks: LandmarkTable, step: Step) -> MapView:
        """The map as the camera sees it."""
        positions = checked(backend, "positions", backend.positions(landmarks.ids), n=len(landmarks))
        pose = step.estimate.T_world_left
        return MapView.of(self.rig, pose, positions, step.features, self._localizer.pixel_sigma)

    def _count(self, landmarks: LandmarkTable, view: MapView, step: Step) -> LandmarkTable:
        """Count landmarks as seen or missed, unless the frame's pose was not measured."""
        m, matches = self.config, step.matches
        measured = isin(matches.ids, step.report.used)
        expected = landmarks.ids[:0]
        if not step.tracking.unmatched:
            size = (self.rig.width, self.rig.height)
            shown = expected_landmarks(view, step.features, size, m.view_margin, m.occlusion_radius)
            shown &= self._localizer.similar_view(view.T_world_left, landmarks, view.positions)
            expected = landmarks.ids[shown]
        ids, rows = matches.ids[measured], matches.rows[measured]
        place = view.T_world_left[:3, 3], view.in_image, self._localizer.config.rematch_after
        return landmarks.after_frame(
            step.index, expected, ids, step.features, rows, m.descriptor_update, *place, step.suspects
        )

    def _add(self, backend: Backend, step: Step, known: BoolArray) -> Step:
        """Turn features that are no landmarks yet into landmarks, unless the pose is unknown.

        Features that move, or whose motion label is undecided, are left out.
        """
        landmarks, features, matches = step.landmarks, step.features, step.matches
        if len(landmarks) >= MINIMAL_POINTS and not step.tracking.may_add(self.config.restart_after):
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
        landmarks, features, matches = step.landmarks, step.features, step.matches
        T, sigma = step.estimate.T_world_left, self._localizer.pixel_sigma
        view = self._view(backend, landmarks, step)
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
        landmarks = step.landmarks.with_new(step.index, ids, step.features, rows, step.estimate.T_world_left[:3, 3])
        return replace(step, landmarks=landmarks, added=step.added.joined(LandmarkMatches(ids, rows)))

    def _new_ids(self, count: int) -> IdArray:
        """Ids that were never used."""
        ids = np.arange(self.next_id, self.next_id + count, dtype=np.int64)
        self.next_id += count
        return ids
