"""Settings of the association of features with landmarks."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative

_POSES = (0, 100_000)  # guard: bounds of the number of poses tried in a frame
_RANGES = {
    "hypotheses": _POSES,
    "wide_hypotheses": _POSES,
    "window_sigmas": (0.0, 1e3),
    "window_min": (0.0, 1e4),
    "window_max": (0.0, 1e4),
    "window_sizes": (0.0, 1e4),
    "refined_window": (0.0, 1e4),
}


@dataclass(frozen=True)
class AssociationConfig:
    """Settings of the association.

    Attributes:
        windows: kind of the search windows: ``"covariance"``, ellipses by the innovation's covariance, or ``"fixed"``,
            squares of fixed sizes as in paper A, Fig. 4.
        window_sigmas: half sizes of covariance windows, smallest first, in standard deviations of the innovation.
        window_min, window_max: bounds of the half axes of the smallest covariance window [px].
        window_sizes: half sizes of fixed windows, smallest first [px].
        d_match: largest descriptor distance in each window (paper A, Eq. 12); falls as the window grows.
        ratio: largest ratio of the best to the second best distance in a window (paper B, 2.2).
        wide_d_match, wide_ratio: as `d_match` and `ratio`, for matching against the whole map without windows.
        wide_share: if nothing was matched in the last frame, a pose found by matching against the whole map must match
            at least this share of the landmarks (or of the features, if fewer) in view from there.
        minimum_consistent: with fewer matches than this after the geometric check, the whole map is tried.
        consistency_sigmas: largest reprojection error of a match that agrees with a pose, in units of the pixel noise.
        hypotheses, wide_hypotheses: number of poses tried in the geometric check, for matches in windows and for
            matches against the whole map.
        tight_window: if the median standard deviation of the innovations is below this [px], the prediction is trusted:
            few matches suffice, and no second search is made.
        max_jump, lost_jump: a pose farther than this from the prediction, in its standard deviations, must be
            confirmed by `kidnapped_after` frames. `lost_jump` is used after a frame without matches.
        kidnapped_after: if poses beyond `max_jump` or `lost_jump` agree with each other in this many successive frames,
            the camera was kidnapped (moved while it saw nothing), and a new back end starts there in the map.
        view_angle: landmarks are searched for only if their line of sight has turned by no more than this since they
            were first seen [degrees]; beyond, a feature is no longer at the same point. 180 for any angle.
        view_ratio: likewise, largest factor by which the distance may have changed.
        rematch_after: landmarks that were out of the image for this many frames are searched for at any view angle and
            distance: they correct the drift meanwhile by more than the feature may have shifted. Once found, they count
            as first seen from there.
        align: shift landmarks' features to where the surrounding image matches that at the landmark's first sight (see
            `slam.tracks.alignment`), if the front end can do that.
        measured: largest number of matches given to the back end in a frame: those most informative of the camera's
            motion (see `slam.tracks.informative`); 0 for all.
        refined_window: standard deviation [px] assumed in the second search, around the pose on which matches agreed.
    """

    windows: str = "covariance"
    window_sigmas: tuple[float, ...] = (2.5, 5.0)
    window_min: float = 4.0
    window_max: float = 400.0
    window_sizes: tuple[float, ...] = (10.0, 30.0)
    d_match: tuple[float, ...] = (0.55, 0.4)
    ratio: float = 0.8
    wide_d_match: float = 0.4
    wide_ratio: float = 0.9
    wide_share: float = 0.1
    minimum_consistent: int = 8
    consistency_sigmas: float = 5.0
    hypotheses: int = 100
    wide_hypotheses: int = 1000
    tight_window: float = 12.0
    max_jump: float = 15.0
    lost_jump: float = 6.0
    kidnapped_after: int = 3
    view_angle: float = 20.0
    view_ratio: float = 1.4
    rematch_after: int = 10
    align: bool = True
    measured: int = 0
    refined_window: float = 3.0

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self, _RANGES, "association")
        if self.windows not in ("covariance", "fixed"):
            raise ConfigurationError(f"association: windows must be 'covariance' or 'fixed', got {self.windows!r}")
        name = "window_sizes" if self.windows == "fixed" else "window_sigmas"
        sizes = getattr(self, name)
        if len(sizes) != len(self.d_match) or not sizes:
            raise ConfigurationError(f"association: {name} and d_match must have the same number of values")
        if list(sizes) != sorted(sizes) or sizes[0] <= 0:
            raise ConfigurationError(f"association: {name} must be positive and ascending")
        if not 0 < self.window_min <= self.window_max:
            raise ConfigurationError("association: 0 < window_min <= window_max is required")
        if not (0 < self.ratio <= 1 and 0 < self.wide_ratio <= 1):
            raise ConfigurationError("association: ratios must lie in (0, 1]")
        if self.view_ratio < 1:
            raise ConfigurationError("association: view_ratio must be at least 1")
        if min(self.hypotheses, self.wide_hypotheses) < 1 or self.minimum_consistent < 3:
            raise ConfigurationError("association: hypotheses >= 1 and minimum_consistent >= 3 are required")
        if 0 < self.measured < 10:
            raise ConfigurationError("association: measured must be 0, for all matches, or at least 10")
        if self.kidnapped_after < 1:
            raise ConfigurationError("association: kidnapped_after must be at least 1")
