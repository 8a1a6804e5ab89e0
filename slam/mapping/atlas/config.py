"""Settings of the atlas."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative

_RANGES = {
    "features": (1, 100_000),
    "candidates": (0, 10_000),
    "inliers": (3, 100_000),
    "agreeing": (1, 2),
    "most_loops": (2, 100_000),
}


@dataclass(frozen=True)
class AtlasConfig:
    """Settings of keyframes and of loops.

    Attributes:
        enabled: keep keyframes, and close loops where one of them is seen again.
        keyframe_share: a frame becomes a keyframe where less than this share of what the last keyframe saw is in view.
        keyframe_distance: or where the camera has gone this share of the median depth of what that one saw.
        features: most features that a keyframe keeps.
        return_depths: a place counts as left once the camera has gone this many times the median depth of what it saw.
        view_depths: a place is seen again from no farther than this many times that depth.
        drift: share of its length by which a path may be wrong, besides what its covariance says: places farther off
            are not compared.
        candidates: number of keyframes that are compared in detail with a new one.
        inliers: features that must agree on a pose for two keyframes to show the same place.
        spread: least standard deviation of their pixels, in the direction in which they are spread most, as a share of
            the image's width.
        agreeing: keyframes that must see the same return, at once or within three, before it is believed: 1 or 2.
        gate_sigmas: a return is refused where it contradicts the path by more than this many standard deviations.
        most_loops: loops that the pose graph holds at most, as each makes the next one dearer; of more, those stay that
            are spread evenly along the path.
        give_back: landmarks of a place seen again return to the back end, where it can place landmarks.
        on_disk: features of keyframes are kept in a temporary file; some 6 kB of a keyframe stay in memory.
    """

    enabled: bool = True
    keyframe_share: float = 0.8
    keyframe_distance: float = 0.2
    features: int = 400
    return_depths: float = 3.0
    view_depths: float = 3.0
    drift: float = 0.02
    candidates: int = 8
    inliers: int = 15
    spread: float = 0.1
    agreeing: int = 2
    gate_sigmas: float = 5.0
    most_loops: int = 200
    give_back: bool = True
    on_disk: bool = False

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES, "atlas")
        if self.keyframe_share > 1:
            raise ConfigurationError("atlas: keyframe_share is a share between 0 and 1")
