"""Settings of the map: which features become landmarks and which landmarks are erased (paper A, IV)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative


@dataclass(frozen=True)
class MapConfig:
    """Settings of the map management.

    Attributes:
        target_in_view: number of landmarks to measure in each frame; if there are fewer, new ones are added.
        grid: cells (columns, rows) over the image; new landmarks go to the emptiest cells first.
        separation: least distance of a new landmark from the landmarks in view [px].
        max_depth_error: largest relative standard deviation of a new landmark's depth.
        erase_missed: a landmark is erased after this many successive frames in view without being measured ("not
            continuously detected"). Frames in which it may be hidden, or lies near the image's border, do not count.
        erase_share: a landmark is erased if it was measured in less than this share of the frames in which it was in
            view; tested after more than `erase_missed` frames.
        confirmed: landmarks measured in fewer frames than this are erased once they are out of view or hidden.
        spacing: of landmarks out of view that lie closer together than this share of the distance from which they
            were first seen, only the one measured in most frames is kept; 0 keeps all, and the map then grows each
            time the camera sees the same place.
        forget_after: landmarks not measured for this many frames are erased wherever they are, so that no place is
            ever recognised; 0 for never.
        descriptor_update: weight of the newest descriptor in a landmark's descriptor; 1 keeps the last, 0 the first.
        lost_after: the camera is lost after this many frames without a match, if the predicted pixels are less certain
            than `AssociationConfig.tight_window`.
        restart_after: after this many unmatched frames with enough features to be localised in a known place, a new map
            begins at the predicted pose; again after as many more.
        max_landmarks: largest size of the map; beyond it, the landmarks measured longest ago are erased.
    """

    target_in_view: int = 80
    grid: tuple[int, int] = (8, 4)
    separation: float = 8.0
    max_depth_error: float = 0.2
    erase_missed: int = 5
    erase_share: float = 0.3
    confirmed: int = 6
    spacing: float = 0.1
    forget_after: int = 0
    descriptor_update: float = 0.0
    lost_after: int = 5
    restart_after: int = 5
    max_landmarks: int = 1000

    #: Distance from the image's border [px] within which a landmark may go undetected.
    view_margin: ClassVar[float] = 16.0
    #: A landmark is taken to be hidden if most features within this radius of it [px] are nearer to the camera.
    occlusion_radius: ClassVar[float] = 12.0
    #: Landmarks closer together than this [m], or than stereo can tell apart, are merged if descriptors are alike.
    same_distance: ClassVar[float] = 0.02
    #: Largest descriptor distance at which landmarks are merged.
    same_descriptor: ClassVar[float] = 0.4

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self)
        if self.target_in_view < 3 or self.max_landmarks < self.target_in_view:
            raise ConfigurationError("map: 3 <= target_in_view <= max_landmarks is required")
        if min(self.grid) < 1 or self.separation < 0:
            raise ConfigurationError("map: grid cells must be at least 1 and separation not negative")
        if not (0 < self.max_depth_error < 1 and 0 <= self.erase_share < 1):
            raise ConfigurationError("map: max_depth_error or erase_share is out of range")
        if min(self.erase_missed, self.lost_after, self.restart_after) < 1 or self.descriptor_update > 1:
            raise ConfigurationError(
                "map: erase_missed, lost_after and restart_after >= 1 and descriptor_update <= 1 are required"
            )
