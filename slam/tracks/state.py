"""Whether the camera is tracked, predicted, lost, in a place that is not in the map, or was moved unseen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.chi_square import SIGMAS
from slam.geometry.se3 import Array, inverse, log
from slam.models import EstimatorModels

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

    unmatched: int = 0  # frames since the pose was last measured
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
        """The state after a frame.

        Args:
            measured: the pose was measured.
            stands: the camera stands.
            uncertain: the prediction is too uncertain to say where in the image landmarks are.
            stereo_features: number of features with depth in the frame.
            lost_after: frames without a measured pose after which a camera with an uncertain prediction is lost.
        """
        if measured:
            return TrackingState(doubted=self.doubted, believed=self.believed, stood=stands, hidden_at=self.hidden_at)
        unmatched, enough = self.unmatched + 1, stereo_features >= ENOUGH_FEATURES
        lost = self.lost or (uncertain and unmatched >= lost_after)
        return replace(self, unmatched=unmatched, unknown=self.unknown + enough, lost=lost, showed_enough=enough)

    def believing(self, T_world_left: Array, stamp: float, hidden_at: Array | None = None) -> TrackingState:
        """A copy in which a pose (4, 4) at a time [s] is believed, and none is doubted."""
        return replace(self, doubted=NO_POSE, believed=PoseHypotheses(1, stamp, T_world_left), hidden_at=hidden_at)

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

    def may_add(self, restart_after: int) -> bool:
        """Whether new landmarks may join the map: not while the pose is unknown, unless the place is not in the map."""
        return not self.unmatched or self.in_unknown_place(restart_after)
