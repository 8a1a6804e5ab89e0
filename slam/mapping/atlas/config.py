"""Settings of the atlas."""

from __future__ import annotations

from dataclasses import dataclass

from slam.chi_square import chi_square_beyond
from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative

_RANGES = {
    "features": (1, 100_000),
    "candidates": (0, 10_000),
    "inliers": (3, 100_000),
    "agreeing": (1, 2),
}


@dataclass(frozen=True)
class AtlasConfig:
    """Settings of keyframes and of loops.

    Attributes:
        enabled: keep keyframes, and close loops when one of them is seen again.
        keyframe_share: a frame becomes a keyframe if less than this share of the last keyframe's features is in view.
        keyframe_distance: or if the camera has moved by this share of the median depth of those features.
        features: most features that a keyframe keeps.
        return_depths: a place counts as left once the camera has gone this many times the median depth of what it saw.
        view_depths: a place is seen again only from within this many times that depth.
        drift: drift of the path as a share of its length, besides its covariance; places farther off than that are not
            compared.
        candidates: number of keyframes that are compared in detail with a new one.
        inliers: number of features that must agree on a pose for two keyframes to show the same place.
        spread: least standard deviation of their pixels, along the direction of largest spread, as a share of the
            image's width.
        agreeing: number of keyframes, 1 or 2, that must see the same loop before it is closed; the second at most three
            keyframes after the first.
        gate_sigmas: a loop is closed if its distance from the path is at most this many standard deviations. Beyond
            what is as rare as a Gaussian number so far off, it is refused; between the two it is left out.
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

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES, "atlas")
        if self.keyframe_share > 1:
            raise ConfigurationError("atlas: keyframe_share is a share between 0 and 1")

    @property
    def refused_beyond(self) -> float:
        """Squared Mahalanobis distance of a loop's six numbers from the path beyond which it shows another place."""
        return max(self.gate_sigmas**2, chi_square_beyond(6, self.gate_sigmas))
