"""Data of a step: a frame's result before the map changes, and the state carried to the next step."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import Estimate, IdArray, Prediction, StereoFeatures, UpdateReport
from slam.geometry.se3 import Array
from slam.landmarks import LandmarkTable
from slam.object_data import MotionLabels
from slam.rig_error import CommonError, Correction
from slam.tracking.localizer import LandmarkMatches
from slam.tracking.patch_alignment import Aligned, PatchAnchors
from slam.tracking.standing import Standing
from slam.tracking.state import TrackingState


@dataclass(frozen=True, eq=False)
class AssociatedFrame:
    """A frame whose features are matched with landmarks.

    Attributes:
        aligned: the features as measured, and the patches that they were aligned to.
        features: the same features, corrected by the calibration.
        landmarks: the map.
        prediction: of the back end.
        matches: matched landmarks, without the withheld ones.
        withheld: ids of landmarks withheld from the back end's update, because they may move.
        withheld_rows: features matched with withheld landmarks.
        standing: whether the camera stands.
    """

    aligned: Aligned
    features: StereoFeatures
    landmarks: LandmarkTable
    prediction: Prediction
    matches: LandmarkMatches
    withheld: IdArray
    withheld_rows: NDArray[np.intp]
    standing: Standing

    @classmethod
    def of_nothing_known(
        cls, features: StereoFeatures, corrected: StereoFeatures, prediction: Prediction
    ) -> AssociatedFrame:
        """A frame in an empty map, with its features as measured and corrected."""
        none, aligned = np.zeros(0, np.int64), Aligned(features, PatchAnchors.none())
        empty = LandmarkTable.empty(features.descriptors.shape[1])
        nothing = LandmarkMatches.nothing()
        return cls(aligned, corrected, empty, prediction, nothing, none, nothing.rows, Standing())

    @property
    def pose(self) -> Array:
        """The pose T_world_left (4, 4) on which the matches agree, or the predicted one."""
        return self.prediction.T_world_left if self.matches.T_world_left is None else self.matches.T_world_left


@dataclass(frozen=True, eq=False)
class Step:
    """A frame's result before the map is changed.

    Attributes:
        index: of the frame.
        features: all of them, corrected by the calibration.
        prediction: of the back end.
        matches: matched landmarks, without the withheld ones.
        withheld: ids of landmarks withheld from the back end's update, because they may move.
        withheld_rows: features matched with withheld landmarks.
        left_out: ids of matched landmarks left out of the update, because others are more informative.
        report: of the update.
        state: whether the pose is known.
        estimate: the camera's pose after the update.
        labels: which features move.
        common: the part of the pose's error that other frames share; included in the covariance of `estimate`.
        correction: of the calibration, with which the features were corrected.
        checksum: of the images; None without images, or of images that show nothing.
        repeated: the images are those of the frame before, so that its features were left out.
    """

    index: int
    features: StereoFeatures
    prediction: Prediction
    matches: LandmarkMatches
    withheld: IdArray
    withheld_rows: NDArray[np.intp]
    left_out: IdArray
    report: UpdateReport
    state: TrackingState
    estimate: Estimate
    labels: MotionLabels
    common: CommonError = field(default_factory=CommonError)
    correction: Correction | None = None
    checksum: tuple[int, int] | None = None
    repeated: bool = False


@dataclass(frozen=True, eq=False)
class Completed:
    """State carried from completed steps to the next one, besides the map.

    Attributes:
        index: of the last frame.
        state: how localization has gone.
        dimensions: length of the descriptors; None before the first feature.
        mapped: whether there ever was a landmark.
        anchors: image patches of landmarks at first sight.
        measured_at: time of the last frame whose pose was measured, or in which a new map began [s].
        checksum: of the images; None without images, or of images that show nothing.
        standing: whether the camera stands.
    """

    index: int = -1
    state: TrackingState = field(default_factory=TrackingState)
    dimensions: int | None = None
    mapped: bool = False
    anchors: PatchAnchors = field(default_factory=PatchAnchors.none)
    measured_at: float = -np.inf
    checksum: tuple[int, int] | None = None
    standing: Standing = field(default_factory=Standing)

    def after(self, step: Step, added: int, anchors: PatchAnchors, standing: Standing, new_map: bool) -> Completed:
        """The state after one more step, in which `added` landmarks joined the map, or a new map was started."""
        standing = replace(standing, T_world_left=step.estimate.T_world_left)
        dimensions = step.features.descriptors.shape[1] if len(step.features) else self.dimensions
        known = not step.state.unmatched or not self.mapped or new_map
        measured_at = step.features.stamp if known else self.measured_at
        mapped = self.mapped or added > 0
        return Completed(step.index, step.state, dimensions, mapped, anchors, measured_at, step.checksum, standing)
