"""Settings of the detector of moving objects."""

from __future__ import annotations

from dataclasses import dataclass

from slam.errors import ConfigurationError
from slam.models import require_not_negative

MODES = ("detect", "procedure1", "off")
_LONGEST = 200  # guard: window [frames]: every track keeps so many measurements


@dataclass(frozen=True)
class ObjectsConfig:
    """Settings of the detector of moving objects.

    Attributes:
        mode: ``"detect"`` finds moving bodies without being told; ``"procedure1"`` is the papers' detector with a
            database of known features (paper B, 3); ``"off"``.
        window: number of frames over which a feature is classified.
        patience: number of frames without a match after which a track that belongs to no body is dropped.
        max_speed: largest speed of a point of a body [m/s]; bounds the search for moving features.
        min_speed: slower bodies are not detected [m/s].
        search_radius, search_limit: least and largest half size of the search windows of tracks [px].
        d_match: largest descriptor distance in the search windows.
        ratio: largest ratio of the best to the second best descriptor distance.
        wide_d_match, wide_ratio: as `d_match` and `ratio`, for features far from where a still point would be.
        min_frames: number of measurements from which on a feature is classified.
        doubtful: χ²(3) of a track's displacement above which it does not become a landmark.
        suspect: χ²(6) of a large group's motion relative to the rest of the scene above which its landmarks are not
            used to measure the camera's pose.
        group_test: the same χ²(6) above which a large group moves; it is higher for small groups.
        min_support: fewest features with a common motion that make a body.
        confirm: number of frames with that common motion, less those without; one of the features may be newer.
        max_points: most points kept of a body.
        forget_after: time after which an unseen body is forgotten [s].
        report_unmeasured: time for which a body is still reported after its last measurement [s].
        unmeasured_share: most frames in which a body is reported without being measured, as a share of those in which
            it was measured.
        database: file of the object's features for ``"procedure1"``, see `slam.papers.procedure1`.
        least_side: of the triangle of features in ``"procedure1"``, its shortest side [m].
        least_sine: of the triangle of features in ``"procedure1"``, the least sine of its angles.
        margin: how far from a body's extent its further features may lie, as a share of the extent's diagonal, or of
            `size` where that is more.
        size: what bodies measure across at least, seen in part or whole [m].
    """

    mode: str = "detect"
    window: int = 12
    patience: int = 3
    max_speed: float = 1.5
    min_speed: float = 0.01
    search_radius: float = 4.0
    search_limit: float = 25.0
    d_match: float = 0.5
    ratio: float = 0.85
    wide_d_match: float = 0.45
    wide_ratio: float = 0.8
    min_frames: int = 4
    doubtful: float = 14.0
    suspect: float = 20.0
    group_test: float = 30.0
    min_support: int = 4
    confirm: int = 3
    max_points: int = 80
    forget_after: float = 8.0
    report_unmeasured: float = 1.0
    unmeasured_share: float = 0.05
    margin: float = 0.25
    size: float = 0.0
    database: str = ""
    least_side: float = 0.08
    least_sine: float = 0.3

    def __post_init__(self) -> None:
        require_not_negative(self, {"max_points": (0, 10_000), "search_limit": (0, 1e4)}, "objects")
        if self.mode not in MODES:
            raise ConfigurationError(f"objects: mode must be one of {MODES}, got {self.mode!r}")
        if self.mode == "procedure1" and not self.database:
            raise ConfigurationError("objects: mode procedure1 needs a database of the object's features")
        if not 3 <= self.min_frames <= self.window <= _LONGEST:
            raise ConfigurationError(f"objects: 3 <= min_frames <= window <= {_LONGEST} is required")
        for name in ("max_speed", "d_match", "wide_d_match", "doubtful", "suspect", "confirm", "forget_after"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"objects: {name} must be positive, got {getattr(self, name)}")
        if self.min_support < 3 or self.max_points < self.min_support:
            raise ConfigurationError("objects: 3 <= min_support <= max_points is required")
        if self.suspect > self.group_test:
            raise ConfigurationError("objects: suspect <= group_test is required")
        if not (0 < self.ratio <= 1 and 0 < self.wide_ratio <= 1):
            raise ConfigurationError("objects: ratios must lie in (0, 1]")
        if not 0 < self.search_radius <= self.search_limit:
            raise ConfigurationError("objects: 0 < search_radius <= search_limit is required")
