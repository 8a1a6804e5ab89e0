"""Whether the camera's pose is known: tracked, predicted, lost, or in a place that the map does not show."""

from __future__ import annotations

from dataclasses import dataclass

#: Stereo features with which the camera would be localised in a known place.
ENOUGH_FEATURES = 20


@dataclass(frozen=True)
class TrackingState:
    """How localization has gone of late.

    Attributes:
        unmatched: frames since the pose was last measured.
        unknown: how many of these showed enough features to be localised in a known place.
        lost: for so long, and the prediction is so uncertain, that the camera's pose is not known.
        showed_enough: the last frame showed enough features to be localised in a known place.
    """

    unmatched: int = 0
    unknown: int = 0
    lost: bool = False
    showed_enough: bool = False

    def after(self, measured: bool, uncertain: bool, stereo_features: int, lost_after: int) -> TrackingState:
        """The state after a frame.

        Args:
            measured: the pose was measured.
            uncertain: the prediction does not tell where in the image landmarks are.
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
        """Whether the camera has just shown `restart_after` frames of a place that the map does not know."""
        return self.showed_enough and self.unknown % restart_after == 0

    def may_add(self, restart_after: int) -> bool:
        """Whether new landmarks may join the map: not while the pose is unknown, unless the place is so, too."""
        return not self.unmatched or self.in_unknown_place(restart_after)
