"""Settings of the self-calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slam.errors import ConfigurationError
from slam.models import require_positive

_RANGES = {"systematic": (1e-4, 1e4), "minimum_parallax": (1e-4, 1e4)}  # [px]


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """Settings of the self-calibration. The prior of the calibration's errors is in `slam.calibration.posterior`.

    Attributes:
        enabled: False leaves all measurements unchanged.
        systematic: error of rows and disparities that all frames of a recording may share, for each parameter [px].
        minimum_common: least number of features matched in both views.
        minimum_parallax: least median displacement of the features by translation between two views [px].
    """

    enabled: bool = True
    systematic: float = 0.05
    minimum_common: int = 30
    minimum_parallax: float = 4.0

    #: Noise of a left pixel [px] at first; it is then estimated from pairs of views.
    pixel_sigma: ClassVar[float] = 0.4
    #: The same of a disparity [px].
    disparity_sigma: ClassVar[float] = 0.2
    #: Two views are compared once less than this share of the first view's features is matched.
    kept_share: ClassVar[float] = 0.3
    #: Factor on the variance of the evidence at first, until its scatter has been measured.
    inflation: ClassVar[float] = 4.0

    def __post_init__(self) -> None:
        require_positive(self, _RANGES, "self_calibration")
        if self.minimum_common < 10:
            raise ConfigurationError("self_calibration: minimum_common >= 10 is required (a pose and the rig)")
