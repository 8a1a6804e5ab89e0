"""Whether the camera knows where it is: tracked, lost, or in a place that the map does not know."""

from __future__ import annotations

from dataclasses import dataclass

from slam.mapping.selection import MapConfig

#: Stereo features with which a known place would be recognised.
_ENOUGH_FEATURES = 20


@dataclass(frozen=True)
class Tracking:
    """How recognition has gone of late.

    Attributes:
        unmatched: frames since landmarks were last recognised.
        unknown: how many of these showed enough features to localize something.
        lost: for so long, and the prediction is so vague, that the camera's place is not known.
    """

    unmatched: int = 0
    unknown: int = 0
    lost: bool = False

    def after(self, recognised: bool, vague: bool, stereo_features: int, config: MapConfig) -> Tracking:
        """After a frame.

        Args:
            recognised: enough landmarks were.
            vague: the prediction would not tell where in the image landmarks are.
            stereo_features: number of features with depth in the frame.
            config: settings.
        """
        if recognised:
            return Tracking()
        unmatched = self.unmatched + 1
        unknown = self.unknown + (stereo_features >= _ENOUGH_FEATURES)
        return Tracking(unmatched, unknown, self.lost or (vague and unmatched >= config.lost_after))

    def may_add(self, config: MapConfig) -> bool:
        """Whether new landmarks may join the map.

        Not where the pose is unknown; but where nothing was recognised for long although there was enough to see, the
        place is an unknown one, and is mapped from the predicted pose on.
        """
        return not self.unmatched or (self.unknown > 0 and self.unknown % config.restart_after == 0)
