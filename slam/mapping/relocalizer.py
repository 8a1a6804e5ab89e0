"""Starts a back end in a known map: for a kidnapped camera that was found again, or in a map from a file.

With a map from a file, no estimator runs until the camera has been found in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slam import registry
from slam.data import (
    Estimate,
    FrameResult,
    FrameStatus,
    Observations,
    Prediction,
    StereoFeatures,
    UpdateReport,
    UpdateStatus,
)
from slam.errors import ConfigurationError, SlamError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import LEAST_VARIANCE, Array
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend, MapBackend
from slam.mapping.map_io import SavedMap
from slam.models import EstimatorModels
from slam.tracking.localizer import Localizer

#: Standard deviations of the initial pose [m], [rad] of a back end that starts in a map. They are wide, because the
#: back end measures the landmarks that gave that pose once more: a narrow prior would count them twice.
POSITION_SIGMA, ROTATION_SIGMA = 1.0, 0.2

REASON = "the camera has not been found in the map yet"
NEW_MAP = "the place is not in the map: a new map begins"


class Relocalizer:
    """Starts back ends of one kind in a map.

    Args:
        rig: the cameras.
        models: the back ends' noise and motion models.
        backend: name of the back ends; None if the first one was given as an object, so that no other can be made.
        options: of the back ends.
        localizer: finds landmarks in frames.

    Attributes:
        search: looks for the camera in the map that the system was started with; None without one, or once it is found.
        past: the paths of all back ends before the present one.
        restarted: indices of the frames in which another back end took over.
    """

    def __init__(
        self,
        rig: StereoRig,
        models: EstimatorModels,
        backend: str | None,
        options: Mapping[str, Any],
        localizer: Localizer,
    ) -> None:
        self._rig = rig
        self._models = models
        self._backend = backend
        self._options = options
        self._localizer = localizer
        self.search: MapSearch | None = None
        self.past: list[Trajectory] = []
        self.restarted: list[int] = []

    def search_in(self, known: SavedMap, backend: Backend) -> None:
        """Look for the camera in a map before any back end starts.

        Raises:
            ConfigurationError: the back end was not given by name, or cannot start in a prior map.
            SlamError: the map is empty, or too large for the back end.
        """
        if self._backend is None:
            raise ConfigurationError("a system that starts in a prior map needs its back end by name")
        if not len(known) and not known.keyframes:
            raise SlamError(f"{known.source}: the map holds no landmarks, so the camera cannot be found in it")
        self.search = MapSearch(known, self._rig, self._localizer, self._models.initial_pose)
        self.search.fill(backend)

    def can_restart(self, old: Backend) -> bool:
        """Whether another back end can take over from this one."""
        return self._backend is not None and isinstance(old, MapBackend)

    def restart(self, old: Backend, T_world_left: Array) -> tuple[Backend, Trajectory]:
        """A new back end at a pose (4, 4) in an old one's map; the old one would take the displacement for motion.

        Correlations between the landmarks are lost, as with a map from a file.

        Returns:
            the new back end, and the old one's path without its newest pose.
        """
        new = self.start(T_world_left)
        assert isinstance(new, MapBackend)
        whole = old.estimate()
        covariances = 0.5 * (whole.covariances + np.swapaxes(whole.covariances, 1, 2))
        short = np.maximum(LEAST_VARIANCE - np.linalg.eigvalsh(covariances)[:, 0], 0)
        new.insert(whole.ids, whole.positions, covariances + short[:, None, None] * np.eye(3))
        return new, old.trajectory().select(slice(None, -1))

    def start(self, T_world_left: Array) -> Backend:
        """A back end without landmarks at a pose (4, 4) that is only roughly known."""
        models = replace(
            self._models,
            T_world_left=T_world_left.tolist(),
            initial_position_sigma=POSITION_SIGMA,
            initial_rotation_sigma=ROTATION_SIGMA,
        )
        return self._new(models)

    def start_new_map(self, old: Backend, stamp: float) -> tuple[Backend, Trajectory, Prediction, UpdateReport]:
        """A new back end without landmarks at the old one's pose, which is exact for it: it defines its coordinates.

        A single estimator cannot hold a pose that is uncertain by many metres and degrees together with landmarks seen
        from there: linearisation fails over such angles and makes it overconfident in a wrong pose.

        Returns:
            the new back end at the time `stamp` [s], the old one's path without its newest pose, and what the new one
            predicts and reports for that time, without any landmark.
        """
        T = old.estimate(landmarks=False).T_world_left
        new = self._new(replace(self._models, T_world_left=T.tolist()))
        prediction = new.predict(stamp)
        report = replace(new.update(Observations.empty(), None), reason=NEW_MAP)
        return new, old.trajectory().select(slice(None, -1)), prediction, report

    def _new(self, models: EstimatorModels) -> Backend:
        """Another back end of the same kind."""
        assert self._backend is not None
        backend: Backend = registry.create("backends", self._backend, self._rig, models=models, **self._options)
        return backend


class MapSearch:
    """Looks for the camera in a prior map, by descriptors over the whole map and a geometric check.

    Args:
        known: the map.
        rig: the cameras.
        localizer: finds landmarks in frames.
        T_world_left: an initial guess of the camera's pose (4, 4), tried first.
    """

    def __init__(self, known: SavedMap, rig: StereoRig, localizer: Localizer, T_world_left: Array) -> None:
        self.known = known
        self._rig = rig
        self._localizer = localizer
        self._guess = T_world_left

    def locate(self, features: StereoFeatures, seed: int) -> Array | None:
        """The pose (4, 4) in the map on which enough landmarks agree, or None.

        Raises:
            SlamError: the descriptors have another length than the map's.
        """
        self.known.require_fits("", features.descriptors.shape[1])
        prediction = nowhere(features.stamp, self._guess)
        matches = self._localizer.match(prediction, self.known.rows, self.known.positions, features, seed)
        return matches.T_world_left if len(matches) >= self._localizer.config.minimum_consistent else None

    def fill(self, backend: Backend) -> None:
        """Give a back end the map.

        Raises:
            ConfigurationError: it cannot start in a prior map.
            SlamError: it cannot hold a map of this size.
        """
        if not isinstance(backend, MapBackend):
            raise ConfigurationError(f"{type(backend).__name__} cannot start in a prior map: it has no insert")
        most = getattr(backend, "most_landmarks", None)
        if most is not None and len(self.known) > most:
            name = type(backend).__name__
            raise SlamError(
                f"{self.known.source}: {len(self.known)} landmarks, but {name} takes a map of at most {most}: "
                "start in a smaller map, or with another back end"
            )
        backend.insert(self.known.ids, self.known.positions, self.known.covariances)

    def estimate(self, stamp: float) -> Estimate:
        """The map, with the guess as the pose; its covariance is so large that the pose means nothing."""
        none = nowhere(stamp, self._guess)
        k = self.known
        return Estimate(stamp, none.T_world_left, none.covariance, k.ids, k.positions, k.covariances)

    def lost(self, index: int, features: StereoFeatures) -> FrameResult:
        """The result of a frame in which the camera was not found."""
        none, rows = np.zeros(0, np.int64), np.zeros(0, np.intp)
        whole = self.estimate(features.stamp)
        estimate = replace(whole, ids=none, positions=whole.positions[:0], covariances=whole.covariances[:0])
        return FrameResult(
            index=index,
            status=FrameStatus.LOST,
            reason=REASON,
            estimate=estimate,
            report=UpdateReport.nothing(UpdateStatus.EMPTY, REASON),
            features=features,
            predicted=0,
            matched=none,
            matched_features=rows,
            added=none,
            added_features=rows,
            erased=none,
            map_size=len(self.known),
            located=False,
        )


def nowhere(stamp: float, T_world_left: Array) -> Prediction:
    """An uninformative prediction: an unknown pose, and no landmark expected anywhere."""
    none, P = np.zeros((0, 2)), np.diag(np.repeat([np.pi**2, 1e6], 3))
    return Prediction(stamp, T_world_left, P, np.zeros(0, np.int64), none, none, np.zeros((0, 2, 2)))
