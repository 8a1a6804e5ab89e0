"""Starting in a map that is known: where in it is the camera? Until that is found no estimator runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import Estimate, FrameResult, FrameStatus, Prediction, StereoFeatures, UpdateReport, UpdateStatus
from slam.errors import ConfigurationError, SlamError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.interfaces import Backend, MapBackend
from slam.mapping.map_io import SavedMap
from slam.models import EstimatorModels
from slam.tracking.localizer import Localizer

#: How vague the first pose is for the back end, though it is put where the landmarks agree: they are what tells where
#: the camera is, and are measured by the back end itself, once.
POSITION_SIGMA, ROTATION_SIGMA = 1.0, 0.2  # [m], [rad]

REASON = "the camera has not been found in the map yet"


class MapSearch:
    """Looks for the camera in a known map, by descriptors over the whole map and a geometric check.

    Args:
        known: the map.
        rig: the cameras.
        localizer: finds landmarks in frames.
        T_world_left: where the camera is said to be (4, 4): tried first, no more.
    """

    def __init__(self, known: SavedMap, rig: StereoRig, localizer: Localizer, T_world_left: Array) -> None:
        self.known = known
        self._rig = rig
        self._localizer = localizer
        self._guess = T_world_left

    def locate(self, features: StereoFeatures, seed: int) -> Array | None:
        """The pose (4, 4) in the map on which landmarks agree, or None.

        Raises:
            SlamError: the descriptors are not of the length of the map's.
        """
        self.known.require_fits("", features.descriptors.shape[1])
        guess = self._guess
        if not features.has_stereo.any():
            from slam.mapping.monocular import find_pose

            found = find_pose(self._rig, self.known, features, self._localizer, seed)
            if found is None:
                return None
            guess = found
        prediction = nowhere(features.stamp, guess)
        found_landmarks = self._localizer.localize(
            prediction, self.known.rows, self.known.positions, features, seed
        )  # fmt: skip
        if len(found_landmarks) < self._localizer.config.minimum_consistent:
            return None
        return found_landmarks.T_world_left

    def fill(self, backend: Backend) -> None:
        """Give a back end the map.

        Raises:
            ConfigurationError: it cannot start in a known map.
            SlamError: it cannot hold a map of this size.
        """
        if not isinstance(backend, MapBackend):
            raise ConfigurationError(f"{type(backend).__name__} cannot start in a known map: it has no insert")
        most = getattr(backend, "most_landmarks", None)
        if most is not None and len(self.known) > most:
            name = type(backend).__name__
            raise SlamError(
                f"{self.known.source}: {len(self.known)} landmarks, but {name} takes a map of at most {most}: "
                "start in a smaller map, or with another back end"
            )
        backend.insert(self.known.ids, self.known.positions, self.known.covariances)

    def estimate(self, stamp: float) -> Estimate:
        """What is known without a pose: the map. The pose is the guess, its covariance says that it means nothing."""
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


def models_at(models: EstimatorModels, T_world_left: Array) -> EstimatorModels:
    """The models of an estimator that begins at a pose (4, 4) which is only roughly known."""
    return replace(
        models,
        T_world_left=T_world_left.tolist(),
        initial_position_sigma=POSITION_SIGMA,
        initial_rotation_sigma=ROTATION_SIGMA,
    )


def nowhere(stamp: float, T_world_left: Array) -> Prediction:
    """A prediction that says nothing: no landmark is expected anywhere."""
    none, P = np.zeros((0, 2)), np.diag(np.repeat([np.pi**2, 1e6], 3))
    return Prediction(stamp, T_world_left, P, np.zeros(0, np.int64), none, none, np.zeros((0, 2, 2)))
