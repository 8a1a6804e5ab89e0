"""Settings of the atlas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class AtlasConfig:
    """Settings of keyframes and of loops.

    Attributes:
        enabled: keep keyframes, and close loops when one of them is seen again.
    """

    enabled: bool = True

    def __post_init__(self) -> None:
        require_not_negative(self)

    #: A frame becomes a keyframe if less than this share of the last keyframe's features is in view.
    keyframe_share: ClassVar[float] = 0.8
    #: A frame also becomes one if the camera has moved by this share of the median depth of those features.
    keyframe_distance: ClassVar[float] = 0.2
    #: Most features that a keyframe keeps.
    features: ClassVar[int] = 400
    #: A place counts as left once the camera has gone this many times the median depth of what it saw.
    return_depths: ClassVar[float] = 3.0
    #: A place is seen again only from within this many times that depth: fewer, or each place that is passed on a
    #: straight road would be looked for once.
    view_depths: ClassVar[float] = 2.0
    #: Drift of the path as a share of its length, besides its covariance; places farther off are not compared.
    drift: ClassVar[float] = 0.02
    #: Number of keyframes that are compared in detail with a new one.
    candidates: ClassVar[int] = 8
    #: Number of features that must agree on a pose for two keyframes to show the same place.
    inliers: ClassVar[int] = 15
    #: Least standard deviation of their pixels, along the direction of largest spread, as a share of the image's width.
    spread: ClassVar[float] = 0.1
    #: Places farther off than this many standard deviations of the position are not compared, beyond drift and view.
    gate_sigmas: ClassVar[float] = 5.0
