"""Settings of the self-calibration."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_positive

_SIGMAS = (1e-4, 1e4)  # guard: [px]
_RANGES = {
    "prior_scale": (1e-3, 1e3),
    "pixel_sigma": _SIGMAS,
    "disparity_sigma": _SIGMAS,
    "systematic": _SIGMAS,
    "minimum_parallax": _SIGMAS,
    "inflation": (1e-3, 1e3),
}


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """Settings of the self-calibration. The prior of the calibration's errors is in `slam.calibration.prior`.

    Attributes:
        enabled: False leaves all measurements unchanged.
        pixel_sigma: initial noise of a left pixel [px]; it is then estimated from pairs of views.
        disparity_sigma: the same of a disparity [px].
        systematic: error of rows and disparities that all frames of a recording may share, for each parameter [px].
        kept_share: two views are compared once less than this share of the first view's features is matched.
        minimum_common: least number of features matched in both views.
        minimum_parallax: least median displacement of the features by translation between two views [px].
        inflation: initial factor on the variance of the evidence, until its scatter has been measured.
    """

    enabled: bool = True
    pixel_sigma: float = 0.4
    disparity_sigma: float = 0.2
    systematic: float = 0.05
    kept_share: float = 0.3
    minimum_common: int = 30
    minimum_parallax: float = 4.0
    inflation: float = 4.0

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_positive(self, _RANGES, "self_calibration")
        if self.kept_share > 1:
            raise ConfigurationError(f"self_calibration: kept_share must lie in (0, 1], got {self.kept_share}")
        if self.minimum_common < 10:
            raise ConfigurationError("self_calibration: minimum_common >= 10 is required (a pose and the rig)")
