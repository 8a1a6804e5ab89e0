"""Settings of the self-calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slam.bounds import require_not_negative


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """Settings of the self-calibration. The prior of the calibration's errors is in `slam.calibration.posterior`.

    Attributes:
        enabled: False leaves all measurements unchanged.
        systematic: error of rows and disparities that all frames of a recording may share, for each parameter [px].
    """

    enabled: bool = True
    systematic: float = 0.05

    #: Least number of features matched in both views.
    minimum_common: ClassVar[int] = 30
    #: Least median displacement of the features by translation between two views [px].
    minimum_parallax: ClassVar[float] = 4.0
    #: Noise of a left pixel [px] at first; it is then estimated from pairs of views.
    pixel_sigma: ClassVar[float] = 0.4
    #: The same of a disparity [px].
    disparity_sigma: ClassVar[float] = 0.2
    #: Two views are compared once less than this share of the first view's features is matched.
    kept_share: ClassVar[float] = 0.3
    #: Factor on the variance of the evidence at first, until its scatter has been measured.
    inflation: ClassVar[float] = 4.0

    def __post_init__(self) -> None:
        require_not_negative(self, {"systematic": (1e-4, 1e4)}, "self_calibration")  # [px]
