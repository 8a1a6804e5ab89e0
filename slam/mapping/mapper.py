"""The map after a frame: landmarks are counted, erased and added, in the rows of the system and in the back end."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.config import SystemConfig
from slam.data import BoolArray, Estimate, IdArray, Observations, StereoFeatures, UpdateReport
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.interfaces import Backend, MapBackend
from slam.landmarks import LandmarkRows
from slam.mapping.monocular import MonocularDepth, unclaimed
from slam.mapping.selection import (
    bad_landmarks,
    crowded_landmarks,
    doubled_landmarks,
    known_features,
    new_landmarks,
    surplus_landmarks,
)
from slam.object_data import MotionLabels
from slam.tracking.localizer import LandmarkMatches, Localizer
from slam.tracking.state import Tracking
from slam.tracking.visibility import MapView, expected_landmarks

_MINIMUM_TRACKED = 3  # stereo points that fix a pose


@dataclass(frozen=True)
class Step:
    """What a frame brought.

    Attributes:
        index: of the frame.
        features: all of them.
        estimate: the camera's pose after the update.
        found: the landmarks that were recognised.
        report: of the update.
        judged: which features move.
        tracking: whether the pose is known.
        held: ids of the landmarks that were not to be measured, because they may move.
    """

    index: int
    features: StereoFeatures
    estimate: Estimate
    found: LandmarkMatches
    report: UpdateReport
    judged: MotionLabels
    tracking: Tracking
    held: IdArray = field(default_factory=lambda: np.zeros(0, np.int64))


class Mapper:
    """Keeps the map of a system; the only one that adds landmarks to a back end and removes them.

    Args:
        rig: the cameras.
        config: all settings.
        localizer: says which landmarks can look as they did.
        backend: that is to be kept; it must be able to place landmarks where left images alone are to add some.

    Raises:
        ConfigurationError: the back end cannot place landmarks.
    """

    def __init__(self, rig: StereoRig, config: SystemConfig, localizer: Localizer, backend: Backend) -> None:
        self.rig = rig
        self.config = config
        self.next_id = 0
        self._localizer = localizer
        self._monocular: MonocularDepth | None = None
        if config.map.monocular:
            if not isinstance(backend, MapBackend):
                raise ConfigurationError("map.monocular: this back end cannot place landmarks")
            self._monocular = self._new_monocular()

    def keep(
        self, backend: Backend, landmarks: LandmarkRows, step: Step
    ) -> tuple[LandmarkRows, LandmarkMatches, IdArray]:
        """Count what was seen, erase bad landmarks, add new ones (paper A, IV).

        Returns:
            the landmarks after the step, those that were added, and the ids of those that were erased.
        """
        view = self._view(backend, landmarks, step)
        landmarks = self._count(landmarks, view, step)
        bad = bad_landmarks(landmarks, self.config.map) | np.isin(landmarks.ids, step.judged.landmarks)
        bad |= doubled_landmarks(view, landmarks, self.config.map)
        bad |= crowded_landmarks(landmarks, view.positions, self.config.map)
        known = known_features(view, landmarks, step.features, self.config.map)
        landmarks, erased = _without(backend, landmarks, bad)
        landmarks, added = self._add(backend, landmarks, step, known)
        landmarks, surplus = _without(backend, landmarks, surplus_landmarks(landmarks, self.config.map))
        return landmarks, added, np.concatenate([erased, surplus])

    def reconcile(self, backend: Backend, landmarks: LandmarkRows | None) -> LandmarkRows | None:
        """Let rows and back end agree after a step that was interrupted; what only one of both has leaves it.

        Args:
            backend: as the step left it; it was predicted.
            landmarks: the rows before the step.

        Returns:
            the rows that stay.
        """
        if self._monocular is not None:
            self._monocular = self._new_monocular()
        known = backend.estimate().ids
        kept = np.zeros(0, np.int64) if landmarks is None else landmarks.ids
        strangers = np.setdiff1d(known, kept)
        if len(strangers):
            backend.remove(strangers)
        return None if landmarks is None else landmarks.select(np.isin(kept, known))

    def _new_monocular(self) -> MonocularDepth:
        return MonocularDepth(self.rig, self.config.models.pixel_sigma, self.config.map.max_depth_error)

    def _view(self, backend: Backend, landmarks: LandmarkRows, step: Step) -> MapView:
        """The map as the camera sees it."""
        positions = backend.positions(landmarks.ids)
        sigma = self.config.models.pixel_sigma
        return MapView.of(self.rig, step.estimate.T_world_left, positions, step.features, sigma)

    def _count(self, landmarks: LandmarkRows, view: MapView, step: Step) -> LandmarkRows:
        """Count what was seen and missed; a frame in which nothing is recognised says nothing of single landmarks."""
        m, found = self.config.map, step.found
        measured = np.isin(found.ids, step.report.used)
        expected = landmarks.ids[:0]
        if not step.tracking.unmatched:
            size = (self.rig.width, self.rig.height)
            shown = expected_landmarks(view, step.features, size, m.view_margin, m.occlusion_radius)
            shown &= self._localizer.similar_view(view.T_world_left, landmarks, view.positions)
            expected = landmarks.ids[shown]
        ids, rows = found.ids[measured], found.rows[measured]
        place = view.T_world_left[:3, 3], view.in_image, self.config.association.rematch_after
        return landmarks.after_frame(
            step.index, expected, ids, step.features, rows, m.descriptor_update, *place, step.held
        )

    def _add(
        self, backend: Backend, landmarks: LandmarkRows, step: Step, known: BoolArray
    ) -> tuple[LandmarkRows, LandmarkMatches]:
        """Make landmarks of features that are none yet; not where the pose is unknown, but for starting anew.

        What moves, or lies on a body that moves, becomes none, nor what is in doubt.
        """
        if len(landmarks) >= _MINIMUM_TRACKED and not step.tracking.may_add(self.config.map):
            return landmarks, LandmarkMatches.nothing()
        features, found = step.features, step.found
        free = ~known
        free[found.rows] = free[step.judged.moving] = free[step.judged.undecided] = False
        occupied = features.uv_left[found.rows]
        rows = new_landmarks(features, free, occupied, self.rig, self.config.models.pixel_sigma, self.config.map)
        added = LandmarkMatches(self._new_ids(len(rows)), rows)
        if len(added):
            backend.add(observations_of(features, added))
            landmarks = landmarks.with_new(step.index, added.ids, features, rows, self._camera(backend))
        if self._monocular is not None:
            return self._add_monocular(self._monocular, backend, landmarks, step, added, free)
        return landmarks, added

    def _add_monocular(
        self,
        monocular: MonocularDepth,
        backend: Backend,
        landmarks: LandmarkRows,
        step: Step,
        added: LandmarkMatches,
        free: BoolArray,
    ) -> tuple[LandmarkRows, LandmarkMatches]:
        """Make landmarks of features without a stereo match that two views give a depth (paper B, 2.2)."""
        features, found = step.features, step.found
        if len(found) < _MINIMUM_TRACKED:
            return landmarks, added
        estimate = backend.estimate(landmarks=False)
        view = self._view(backend, landmarks, step)
        rows = unclaimed(view, landmarks, features, np.flatnonzero(free & ~features.has_stereo))
        covariance = monocular.pose_covariance(estimate, view, landmarks, features, found)
        new = monocular.step(features, rows, estimate.T_world_left, covariance, step.index)
        wanted = max(self.config.map.target_in_view - len(found) - len(added), 0)
        best = np.sort(np.argsort(-features.response[new.rows], kind="stable")[:wanted])
        if not len(best):
            return landmarks, added
        ids = self._new_ids(len(best))
        backend.place(ids, new.local[best], new.covariances[best])  # type: ignore[attr-defined]
        landmarks = landmarks.with_new(step.index, ids, features, new.rows[best], self._camera(backend))
        both = LandmarkMatches(np.concatenate([added.ids, ids]), np.concatenate([added.rows, new.rows[best]]))
        return landmarks, both

    def _new_ids(self, count: int) -> IdArray:
        """Ids that were never used."""
        ids = np.arange(self.next_id, self.next_id + count, dtype=np.int64)
        self.next_id += count
        return ids

    @staticmethod
    def _camera(backend: Backend) -> np.ndarray:
        """The camera's place (3,)."""
        return backend.estimate(landmarks=False).T_world_left[:3, 3]


def _without(backend: Backend, landmarks: LandmarkRows, rows: BoolArray) -> tuple[LandmarkRows, IdArray]:
    """Drop landmarks from the map and from the back end."""
    erased = landmarks.ids[rows]
    if len(erased):
        backend.remove(erased)
        landmarks = landmarks.select(~rows)
    return landmarks, erased


def observations_of(features: StereoFeatures, found: LandmarkMatches) -> Observations:
    """Landmarks with the pixels of the features that they were recognised as."""
    return Observations(found.ids, features.uv_left[found.rows], features.uv_right[found.rows])
