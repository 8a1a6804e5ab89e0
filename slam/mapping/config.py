"""Settings of the map: which features become landmarks and which landmarks are erased (paper A, IV)."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative


@dataclass(frozen=True)
class MapConfig:
    """Settings of the map management.

    Attributes:
        target_in_view: number of measured landmarks to keep up in each frame; fewer, and new ones are added.
        grid: cells (columns, rows) over the image; new landmarks go first where the cell has fewest.
        separation: least distance of a new landmark from the landmarks in view [px].
        max_depth_error: largest relative standard deviation of a new landmark's depth.
        erase_missed: a landmark is erased after so many successive frames in view without being measured ("not
            continuously detected"). Frames in which it may be hidden, or lies near the image's border, do not count.
        erase_share: a landmark is erased where it was measured in less than this share of the frames in view, tested
            after more than `erase_missed` frames.
        confirmed: landmarks measured in fewer frames than these do not stay once they are out of view or hidden.
        spacing: of landmarks that have gone out of view, and lie nearer to each other than this share of the distance
            that they were first seen from, only the one measured in most frames stays; 0 keeps all, and the map then
            grows each time the camera sees the same place.
        forget_after: landmarks not measured for so many frames are erased wherever they are, so that nothing is seen
            again; 0 for never: the map lasts.
        view_margin: distance from the border [px] within which a landmark is not sure to be detected.
        occlusion_radius: a landmark is taken to be hidden where most features so near to it [px] are nearer to the
            camera; 0 for never.
        same_distance: landmarks so near to each other [m], or nearer than stereo can tell apart, are one and the same
            where their descriptors are alike.
        same_descriptor: largest descriptor distance of two landmarks that are one and the same.
        descriptor_update: weight of a landmark's newest descriptor against the one kept; 1 keeps the last, 0 the first.
        lost_after: the camera is lost after this many frames without a match, if the predicted pixels are less certain
            than `association.tight_window`.
        restart_after: after this many unmatched frames with enough features to be localised in a known place, a new map
            begins at the predicted pose; again after as many more.
        max_landmarks: size of the map; beyond it, those measured longest ago are erased.
        monocular: features without a stereo match become landmarks too, when two views give their depth (paper B, 2.2).
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
    view_margin: float = 16.0
    occlusion_radius: float = 12.0
    same_distance: float = 0.02
    same_descriptor: float = 0.4
    descriptor_update: float = 0.0
    lost_after: int = 5
    restart_after: int = 5
    max_landmarks: int = 1000
    monocular: bool = False

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
