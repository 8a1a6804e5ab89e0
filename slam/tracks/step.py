"""A frame in work: what the stages of a step have found out about it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.data import Estimate, IdArray, Prediction, StereoFeatures, UpdateReport, UpdateStatus
from slam.geometry.se3 import Array
from slam.object_data import MotionLabels, MovingObject
from slam.rig_error import CommonError, Correction
from slam.tracks.localizer import LandmarkMatches
from slam.tracks.monocular import FirstViews
from slam.tracks.standing import Standing
from slam.tracks.state import TrackingState
from slam.tracks.table import Tracks

_NONE = np.zeros(0, np.int64)
_NOWHERE = Estimate(-np.inf, np.eye(4), np.eye(6), _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class Step:
    """A frame in work. Each stage returns a copy that says more; nothing refers to a frame whose step did not end."""

    index: int  # of the frame
    measured: StereoFeatures  # the features as measured; those of landmarks aligned with earlier images
    features: StereoFeatures  # the same, corrected by the calibration
    prediction: Prediction  # of the back end
    tracks: Tracks  # the table of all that is followed or in the map; each stage changes it in place
    matches: LandmarkMatches  # landmarks and the features that show them, without the withheld ones
    standing: Standing  # whether the camera stands
    tracking: TrackingState  # whether the pose is known
    views: FirstViews | None = None  # features without depth that are followed; None for none
    suspects: IdArray = field(default_factory=_NONE.copy)  # ids of landmarks that may move
    # those of them that were matched; they are withheld from the back end's update
    withheld: LandmarkMatches = field(default_factory=LandmarkMatches.nothing)
    report: UpdateReport = field(default_factory=lambda: UpdateReport.nothing(UpdateStatus.EMPTY, ""))  # of the update
    estimate: Estimate = _NOWHERE  # the camera's pose after the update
    labels: MotionLabels = field(default_factory=lambda: MotionLabels(_NONE, _NONE, _NONE))  # which features move
    objects: tuple[MovingObject, ...] = ()  # the moving bodies
    added: LandmarkMatches = field(default_factory=LandmarkMatches.nothing)  # landmarks that joined the map
    joined: IdArray = field(default_factory=_NONE.copy)  # ids of those of a place at which another back end took over
    erased: IdArray = field(default_factory=_NONE.copy)  # ids of the landmarks that left the map
    # the part of the pose's error that other frames share; included in the covariance of `estimate`
    common: CommonError = field(default_factory=CommonError)
    correction: Correction | None = None  # of the calibration, with which the features were corrected
    repeated: bool = False  # the images are those of the frame before, so that its features were left out

    @property
    def pose(self) -> Array:
        """The pose T_world_left (4, 4) on which the matches agree, or the predicted one."""
        return self.prediction.T_world_left if self.matches.T_world_left is None else self.matches.T_world_left
