"""A frame in work: matched landmarks, whether the camera is tracked, and what the stages of a step have found out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import (
    CommonError,
    Correction,
    Estimate,
    IdArray,
    Observations,
    Prediction,
    RecentPoses,
    StereoFeatures,
    UpdateReport,
    UpdateStatus,
)
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array, inverse, log
from slam.models import EstimatorModels
from slam.object_data import MotionLabels, MovingObject
from slam.third_party import OnlinePose
from slam.tracks.standing import Standing
from slam.tracks.table import Tracks

#: Number of stereo features with which the camera would be localised in a mapped place.
ENOUGH_FEATURES = 20

#: Why a vehicle's frame is no measurement though its landmarks agree on a pose.
HIDDEN = "what is seen moves sideways past a vehicle that stood: it hides the view"

_SLACK = 0.05  # error of two poses found independently [m], [rad]
_ASIDE = 0.1  # guard: [m] by which a vehicle has moved for certain


@dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """Poses on which landmarks agreed in successive frames."""

    count: int = 0  # number of successive poses that agree with each other
    stamp: float = float("nan")  # of the last one [s]
    T_world_left: Array | None = None  # the last one (4, 4)

    def after(self, T_world_left: Array, stamp: float, models: EstimatorModels) -> PoseHypotheses:
        """A copy with one more pose, which agrees with the last one if the camera may have moved that far meanwhile."""
        if self.T_world_left is None:
            return PoseHypotheses(1, stamp, T_world_left)
        step, dt = log(inverse(self.T_world_left) @ T_world_left), stamp - self.stamp
        turn = np.linalg.norm(step[:3]) < _SLACK + SIGMAS * models.initial_angular_velocity_sigma * dt
        way = np.linalg.norm(step[3:]) < _SLACK + SIGMAS * models.initial_velocity_sigma * dt
        return PoseHypotheses(self.count + 1 if turn and way else 1, stamp, T_world_left)


NO_POSE = PoseHypotheses()


@dataclass(frozen=True, eq=False)
class TrackingState:
    """How localization has gone recently."""

    unmeasured: int = 0  # frames since the pose was last measured
    unknown: int = 0  # how many of these had enough features to be localised in a mapped place
    # the pose has not been measured for so long, and the prediction is so uncertain, that it is not known
    lost: bool = False
    showed_enough: bool = False  # the last frame had enough features to be localised in a mapped place
    doubted: PoseHypotheses = NO_POSE  # poses too far from the predictions to be believed at once
    believed: PoseHypotheses = NO_POSE  # the last pose that was believed
    stood: bool = False  # the camera stood when its pose was last measured
    # the pose (4, 4) at which a vehicle's camera stood when something hid what it saw and a new map began: what is in
    # that map is then perhaps what hides the rest. None where it was not so, or it drove on
    hidden_at: Array | None = None

    def after(
        self, measured: bool, stands: bool, uncertain: bool, stereo_features: int, lost_after: int
    ) -> TrackingState:
        """The state after a frame in which the pose was `measured` or not, and the camera `stands` or not.

        It is lost after `lost_after` frames without a measured pose, if the prediction is too `uncertain` to say where
        in the image landmarks are.
        """
        if measured:
            return TrackingState(doubted=self.doubted, believed=self.believed, stood=stands, hidden_at=self.hidden_at)
        unmeasured, enough = self.unmeasured + 1, stereo_features >= ENOUGH_FEATURES
        lost = self.lost or (uncertain and unmeasured >= lost_after)
        return changed(self, unmeasured=unmeasured, unknown=self.unknown + enough, lost=lost, showed_enough=enough)

    def believing(self, T_world_left: Array, stamp: float, hidden_at: Array | None = None) -> TrackingState:
        """A copy in which a pose (4, 4) at a time [s] is believed, and none is doubted."""
        return changed(self, doubted=NO_POSE, believed=PoseHypotheses(1, stamp, T_world_left), hidden_at=hidden_at)

    def carried(self, T_world_left: Array) -> bool | None:
        """Whether at a pose (4, 4) a vehicle would have moved sideways from where its view was hidden, as none does.

        What hides its view moves then. None where it has hardly moved, or was not hidden.
        """
        if self.hidden_at is None:
            return None
        aside, _, ahead = np.abs((inverse(self.hidden_at) @ T_world_left)[:3, 3])
        return None if max(aside, ahead) < _ASIDE else bool(aside > ahead)

    def in_unknown_place(self, restart_after: int) -> bool:
        """Whether the camera has just seen `restart_after` frames of a place that is not in the map."""
        return self.showed_enough and self.unknown % restart_after == 0


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """Landmarks found in a frame."""

    ids: IdArray  # landmark ids (K,), ascending
    rows: NDArray[np.intp]  # rows of their features (K,)
    T_world_left: Array | None = None  # the pose (4, 4) on which they agree, if there is one
    # the prediction's uncertainty does not allow that pose, but several frames agree on it: the camera was moved while
    # it saw nothing
    kidnapped: bool = False
    doubted: int = 0  # number of landmarks that agree on a pose which is too far from the prediction to be believed yet
    # ids of landmarks long out of view that were found too, but do not count yet, see `LandmarkTable.returning`
    returning: IdArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.ids)

    def joined(self, more: LandmarkMatches) -> LandmarkMatches:
        """These and matches of other landmarks."""
        ids, rows = np.concatenate([self.ids, more.ids]), np.concatenate([self.rows, more.rows])
        return changed(self, ids=ids, rows=rows)

    def select(self, rows: NDArray) -> LandmarkMatches:
        """Some of the landmarks (a mask or indices)."""
        return LandmarkMatches(self.ids[rows], self.rows[rows], self.T_world_left, doubted=self.doubted)

    def observations(self, features: StereoFeatures) -> Observations:
        """The landmarks with the pixels of the features that they were matched with."""
        return Observations(self.ids, features.uv_left[self.rows], features.uv_right[self.rows])

    @classmethod
    def nothing(cls) -> LandmarkMatches:
        """No landmark found."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.intp))


_NONE = np.zeros(0, np.int64)
_NOWHERE = Estimate(-np.inf, np.eye(4), np.eye(6), _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class Step:
    """A frame in work. Each stage returns a copy that says more.

    What a stage changes in place is the table of tracks, which is this step's own copy but for what is followed, and
    the back end, the detector and the calibration.
    """

    index: int  # of the frame
    measured: StereoFeatures  # the features as measured; those of landmarks aligned with earlier images
    features: StereoFeatures  # the same, corrected by the calibration
    prediction: Prediction  # of the back end
    tracks: Tracks  # the table of all that is followed or in the map; each stage changes it in place
    matches: LandmarkMatches  # landmarks and the features that show them, without the suspects
    standing: Standing  # whether the camera stands
    tracking: TrackingState  # whether the pose is known
    suspects: IdArray = field(default_factory=_NONE.copy)  # ids of landmarks that may move
    report: UpdateReport = field(default_factory=lambda: UpdateReport.nothing(UpdateStatus.EMPTY, ""))  # of the update
    estimate: Estimate = _NOWHERE  # the camera's pose after the update
    recent: RecentPoses | None = None  # the last poses by the back end, and how their errors hang together
    online: tuple[OnlinePose, ...] = ()  # the same as each was estimated in its time
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
