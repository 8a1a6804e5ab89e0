"""Whether the camera is tracked, predicted, lost, or in a place that is not in the map."""

from __future__ import annotations

from dataclasses import dataclass

#: Number of stereo features with which the camera would be localised in a mapped place.
ENOUGH_FEATURES = 20


@dataclass(frozen=True)
class TrackingState:
    """How localization has gone recently.

    Attributes:
        unmatched: frames since the pose was last measured.
        unknown: how many of these had enough features to be localised in a mapped place.
        lost: the pose has not been measured for so long, and the prediction is so uncertain, that it is not known.
        showed_enough: the last frame had enough features to be localised in a mapped place.
    """

    unmatched: int = 0
    unknown: int = 0
    lost: bool = False
    showed_enough: bool = False

    def after(self, measured: bool, uncertain: bool, stereo_features: int, lost_after: int) -> TrackingState:
        """The state after a frame.

        Args:
            measured: the pose was measured.
            uncertain: the prediction is too uncertain to say where in the image landmarks are.
            stereo_features: number of features with depth in the frame.
            lost_after: frames without a measured pose after which a camera with an uncertain prediction is lost.
        """
        if measured:
            return TrackingState()
        unmatched = self.unmatched + 1
        enough = stereo_features >= ENOUGH_FEATURES
        lost = self.lost or (uncertain and unmatched >= lost_after)
        return TrackingState(unmatched, self.unknown + enough, lost, enough)

    def in_unknown_place(self, restart_after: int) -> bool:
        """Whether the camera has just seen `restart_after` frames of a place that is not in the map."""
        return self.showed_enough and self.unknown % restart_after == 0

    def may_add(self, restart_after: int) -> bool:
        """Whether new landmarks may join the map: not while the pose is unknown, unless the place is not in the map."""
        return not self.unmatched or self.in_unknown_place(restart_after)
