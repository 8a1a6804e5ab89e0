"""Settings of the tracks: association of features with landmarks, and birth and death of landmarks (paper A, IV)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slam.bounds import LEAST, MOST, require_not_negative
from slam.errors import ConfigurationError

_COUNT, _SHARE = (1, 10**6), (0.0, 1.0)  # fixed: least and largest values
_ASSOCIATION = {  # least and largest values
    "wide_hypotheses": (1, 100_000), "window_sigmas": (LEAST, 1e3), "window_min": (LEAST, 1e4),
    "window_max": (LEAST, 1e4), "ratio": (LEAST, 1.0), "view_ratio": (1.0, MOST), "kidnapped_after": _COUNT,
}  # fmt: skip
_MAP = {
    "target_in_view": (3, 10**6), "max_depth_error": (LEAST, 1.0), "erase_share": _SHARE, "erase_missed": _COUNT,
    "lost_after": _COUNT, "restart_after": _COUNT, "descriptor_update": _SHARE,
    "grid": (1, 1000),
}  # fmt: skip


@dataclass(frozen=True)
class AssociationConfig:
    """Settings of the association.

    Attributes:
        window_sigmas: half sizes of the search windows, smallest first, in standard deviations of the innovation.
        window_min, window_max: bounds of the half axes of the smallest window [px].
        d_match: largest descriptor distance in each window (paper A, Eq. 12); falls as the window grows.
        ratio: largest ratio of the best to the second best distance in a window (paper B, 2.2).
        consistency_sigmas: largest reprojection error of a match that agrees with a pose, in units of the pixel noise.
        wide_hypotheses: number of poses tried in the geometric check of matches against the whole map.
        kidnapped_after: if poses beyond `max_jump` or `lost_jump` agree with each other in this many successive frames,
            the camera was kidnapped (moved while it saw nothing), and a new back end starts there in the map. Likewise
            a landmark long out of view counts as found in the last of so many successive frames.
        view_angle: landmarks are searched for only if their line of sight has turned by no more than this since they
            were first seen [degrees]; beyond, a feature is no longer at the same point. 180 for any angle.
        view_ratio: likewise, largest factor by which the distance may have changed.
        align: shift landmarks' features to where the surrounding image matches that at the landmark's first sight (see
            `slam.tracks.alignment`), if the front end can do that.
    """

    window_sigmas: tuple[float, ...] = (2.5, 5.0)
    window_min: float = 4.0
    window_max: float = 400.0
    d_match: tuple[float, ...] = (0.55, 0.4)
    ratio: float = 0.8
    consistency_sigmas: float = 5.0
    wide_hypotheses: int = 1000
    kidnapped_after: int = 3
    view_angle: float = 20.0
    view_ratio: float = 1.4
    align: bool = True

    #: As `d_match` and `ratio`, for matching against the whole map without windows.
    wide_d_match: ClassVar[float] = 0.4
    #: See `wide_d_match`.
    wide_ratio: ClassVar[float] = 0.9
    #: If nothing was matched in the last frame, a pose found by matching against the whole map must match at least this
    #: share of the landmarks (or of the features, if fewer) in view from there.
    wide_share: ClassVar[float] = 0.1
    #: With fewer matches than this after the geometric check, the whole map is tried.
    minimum_consistent: ClassVar[int] = 8
    #: Number of poses tried in the geometric check for matches in windows: twice as many change a path within scatter.
    hypotheses: ClassVar[int] = 100
    #: If the median standard deviation of the innovations is below this [px], the prediction is trusted: few matches
    #: suffice, and no second search is made.
    tight_window: ClassVar[float] = 12.0
    #: A pose farther than this from the prediction, in its standard deviations, must be confirmed by `kidnapped_after`
    #: frames.
    max_jump: ClassVar[float] = 15.0
    #: The same after a frame without matches.
    lost_jump: ClassVar[float] = 6.0
    #: Landmarks out of the image for this many frames are searched for at any view angle and distance: they correct the
    #: drift meanwhile by more than the feature may have shifted. Once found, they count as first seen from there.
    rematch_after: ClassVar[int] = 10
    #: Standard deviation [px] assumed in the second search, around the pose on which matches agreed.
    refined_window: ClassVar[float] = 3.0

    def __post_init__(self) -> None:
        require_not_negative(self, _ASSOCIATION, "association")
        sizes = self.window_sigmas
        if len(sizes) != len(self.d_match) or list(sizes) != sorted(sizes):
            raise ConfigurationError("association: window_sigmas must be ascending, one for each value of d_match")
        if self.window_min > self.window_max:
            raise ConfigurationError("association: window_min must not lie above window_max")


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
        restart_after: after this many frames without a measured pose, with enough features to be localised in a known
            place, a new map begins at the predicted pose; again after as many more.
        max_landmarks: largest size of the map; beyond it, the landmarks measured longest ago are erased.
        monocular: features without a stereo match become landmarks too, once two views give a depth (paper B, 2.2):
            in every frame, never, or, for null (in Python None), in frames in which no feature has one.
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
    monocular: bool | None = None

    #: Distance from the image's border [px] within which a landmark may go undetected.
    view_margin: ClassVar[float] = 16.0
    #: A landmark is taken to be hidden if most features within this radius of it [px] are nearer to the camera.
    occlusion_radius: ClassVar[float] = 12.0
    #: Landmarks closer together than this [m], or than stereo can tell apart, are merged if descriptors are alike.
    same_distance: ClassVar[float] = 0.02
    #: Largest descriptor distance at which landmarks are merged.
    same_descriptor: ClassVar[float] = 0.4

    def __post_init__(self) -> None:
        require_not_negative(self, _MAP, "map")
        if self.max_landmarks < self.target_in_view:
            raise ConfigurationError("map: target_in_view must not lie above max_landmarks")
