"""Data association: size-variable search windows and descriptor distance (paper A, III and IV).

Landmarks in the angle of view are searched for around their predicted pixels: in the smallest window first and, if
nothing is found, in larger windows with a stricter descriptor distance (paper A, Fig. 4 and Eq. 12). All landmarks'
best candidates are found before any feature is assigned, so that no landmark takes the feature of another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, Prediction, StereoFeatures
from slam.errors import ConfigurationError
from slam.geometry.se3 import Array
from slam.models import FORBID_UNKNOWN, require_not_negative

Descriptors = NDArray[np.float32]

_ROOM = 8  # cost: pairs a box for which there is room at once
_LARGE = 0.03  # cost: if windows fill more than this share of the image, all descriptors are compared first

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
            `slam.tracking.patch_alignment`), if the front end can do that.
        measured: largest number of matches given to the back end in a frame: those most informative of the camera's
            motion (see `slam.tracking.informative`); 0 for all.
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


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of a landmark and a feature.

    Attributes:
        landmarks: rows of the landmarks (K,).
        features: rows of the features (K,).
    """

    landmarks: NDArray[np.intp]
    features: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.landmarks)

    def select(self, rows: NDArray) -> Matches:
        """The pairs of these rows (a mask or indices)."""
        return Matches(self.landmarks[rows], self.features[rows])


def match_in_windows(
    prediction: Prediction,
    descriptors: Descriptors,
    laplacian: NDArray[np.int8],
    features: StereoFeatures,
    config: AssociationConfig,
    among: NDArray[np.intp] | None = None,
) -> Matches:
    """Match predicted landmarks (M) to features (N) inside size-variable windows.

    Args:
        prediction: landmarks in the angle of view, their pixels and innovation covariances.
        descriptors: of those landmarks (M, D), or of a longer list of which they are the rows `among`.
        laplacian: signs of the Laplacian, likewise.
        features: of the frame.
        config: settings.
        among: rows (M,) of the landmarks in `descriptors`; None if these are the landmarks'.
    """
    if not len(prediction.ids) or not len(features):
        return Matches(np.zeros(0, np.intp), np.zeros(0, np.intp))
    if among is None:
        among = np.arange(len(prediction.ids))
    windows = search_windows(prediction, config)
    if windows.are_large(features.uv_left):
        limit = max(config.d_match) / config.ratio  # farther features affect neither best nor ratio
        rows, columns = _alike(descriptors[among], laplacian[among], features, limit)
    else:
        rows, columns = pairs_in_boxes(prediction.uv_left, windows.reach, features.uv_left)
        same = laplacian.take(among.take(rows)) == features.laplacian.take(columns)
        rows, columns = rows[same], columns[same]
    offset = features.uv_left.take(columns, axis=0) - prediction.uv_left.take(rows, axis=0)
    level = windows.level(rows, offset.astype(np.float32))
    inside = level < len(config.d_match)
    rows, columns, level = rows[inside], columns[inside], level[inside]
    distance = _distances(descriptors, features.descriptors, among.take(rows), columns)
    return _by_levels(_Pairs(rows, columns, distance), level, (len(prediction.ids), len(features)), config)


def match_everywhere(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, config: AssociationConfig
) -> Matches:
    """Match landmarks (M, D) to features by descriptor alone, wherever they lie in the image."""
    if not len(descriptors) or not len(features):
        return Matches(np.zeros(0, np.intp), np.zeros(0, np.intp))
    rows, columns = _alike(descriptors, laplacian, features, config.wide_d_match / config.wide_ratio)
    pairs = _Pairs(rows, columns, _distances(descriptors, features.descriptors, rows, columns))
    best = pairs.mutual_best(config.wide_d_match, config.wide_ratio, (len(descriptors), len(features)))
    return Matches(pairs.rows[best], pairs.columns[best])


def match_in_boxes(
    centres: Array, reach: float, descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures,
    rows: NDArray[np.intp], d_match: float, ratio: float,
) -> Matches:  # fmt: skip
    """Match points expected at pixels (M, 2), with descriptors (M, D), to features `rows` (K,) of a frame.

    Args:
        centres: the expected pixels; points whose pixels are not finite are not matched.
        reach: half size of the square boxes around the pixels [px].
        descriptors: of the points (M, D).
        laplacian: signs of their Laplacian (M,).
        features: of the frame.
        rows: the features that may be matched.
        d_match: largest descriptor distance.
        ratio: largest ratio of the best to the second best distance in a box.
    """
    known = np.flatnonzero(np.isfinite(centres).all(axis=1))
    if not len(known) or not len(rows):
        return Matches(np.zeros(0, np.intp), np.zeros(0, np.intp))
    boxes = np.full((len(known), 2), reach)
    which, member = pairs_in_boxes(centres[known], boxes, features.uv_left[rows])
    which, member = known[which], rows[member]
    same = laplacian[which] == features.laplacian[member]
    which, member = which[same], member[same]
    pairs = _Pairs(which, member, _distances(descriptors, features.descriptors, which, member))
    best = pairs.mutual_best(d_match, ratio, (len(descriptors), len(features)))
    return Matches(pairs.rows[best], pairs.columns[best])


@dataclass(frozen=True, eq=False)
class SearchWindows:
    """Nested search windows around the predicted pixels of landmarks (M).

    Attributes:
        sizes: half sizes of the windows, smallest first: of ellipses in standard deviations, of squares in pixels.
        reach: half sizes (M, 2) [px] of the boxes around the largest windows.
        shape: information matrices (M, 3) of elliptic windows, as (uu, uv, vv) [1/px²]; None for square windows.
    """

    sizes: tuple[float, ...]
    reach: Array
    shape: NDArray[np.float32] | None

    def are_large(self, uv: Array) -> bool:
        """Whether the boxes around the largest windows hold a large share of the pixels (N, 2), on average."""
        width, height = (1.0 + np.ptp(uv[:, i]) for i in (0, 1))
        area = np.dot(np.minimum(2 * self.reach[:, 0], width), np.minimum(2 * self.reach[:, 1], height))
        return bool(area > _LARGE * len(self.reach) * width * height)

    def level(self, rows: NDArray[np.intp], offset: NDArray[np.float32]) -> NDArray[np.intp]:
        """The smallest window (P,) of the landmarks `rows` (P,) that holds a pixel this far off (P, 2)."""
        du, dv = offset[:, 0], offset[:, 1]
        if self.shape is None:
            return np.searchsorted(self.sizes, np.maximum(np.abs(du), np.abs(dv)))
        uu, uv, vv = self.shape.take(rows, axis=0).T
        return np.searchsorted(np.square(self.sizes), uu * du * du + 2 * uv * du * dv + vv * dv * dv)


def search_windows(prediction: Prediction, config: AssociationConfig) -> SearchWindows:
    """Search windows of the predicted landmarks, of the kind `config.windows`."""
    if config.windows == "fixed":
        sizes = config.window_sizes
        return SearchWindows(sizes, np.full((len(prediction.ids), 2), sizes[-1]), None)
    smallest, largest = config.window_sigmas[0], config.window_sigmas[-1]
    S = prediction.innovation
    # Eigenvalues and axes of the symmetric 2x2 matrices in closed form; half axes bounded as the settings say.
    mean, half, cross = 0.5 * (S[:, 0, 0] + S[:, 1, 1]), 0.5 * (S[:, 0, 0] - S[:, 1, 1]), S[:, 0, 1]
    radius = np.hypot(half, cross)
    safe = np.maximum(radius, np.finfo(float).tiny)
    c2, cs = 0.5 + 0.5 * half / safe, 0.5 * cross / safe  # cos², cos · sin of the long axis' angle
    s2 = 1 - c2
    low, high = (config.window_min / smallest) ** 2, (config.window_max / smallest) ** 2
    long, short = np.clip(mean + radius, low, high), np.clip(mean - radius, low, high)
    shape = np.stack([c2 / long + s2 / short, cs / long - cs / short, s2 / long + c2 / short], axis=1)
    reach = largest * np.sqrt(np.stack([c2 * long + s2 * short, s2 * long + c2 * short], axis=1))
    return SearchWindows(config.window_sigmas, reach, shape.astype(np.float32))


def pairs_in_boxes(centres: Array, reach: Array, uv: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of rows of centres (M, 2) and of pixels (N, 2) within `reach` (M, 2) of them, by ascending centre.

    Pixels are sorted by column, so that few pairs have to be tested.
    """
    from slam.tracking import association_kernels

    order = np.argsort(uv[:, 0], kind="stable")
    x, y = uv[:, 0].take(order), uv[:, 1].take(order)
    boxes = np.ascontiguousarray(centres), np.ascontiguousarray(reach)
    rows, places = np.empty((2, _ROOM * len(centres)), np.intp)
    count = association_kernels.pairs_in_boxes(*boxes, x, y, rows, places)
    if count > len(rows):
        rows, places = np.empty((2, count), np.intp)
        association_kernels.pairs_in_boxes(*boxes, x, y, rows, places)
    return rows[:count], order.take(places[:count])


def _alike(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, limit: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of landmarks and of features with the same Laplacian sign whose descriptors are less than `limit` apart."""
    near = descriptors @ features.descriptors.T > np.float32(1 - 0.5 * limit * limit)
    near &= laplacian[:, None] == features.laplacian[None, :]
    rows, columns = np.nonzero(near)
    return rows, columns


def _distances(
    a: Descriptors, b: Descriptors, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Euclidean distances (P,) of unit descriptors a[rows] and b[columns] (paper A, Eq. 12)."""
    product = np.einsum("pd,pd->p", a.take(rows, axis=0), b.take(columns, axis=0))
    return np.asarray(np.sqrt(np.maximum(2 - 2 * product, 0)))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a landmark and a feature that may belong together, by ascending landmark.

    Attributes:
        rows: of landmarks (P,).
        columns: rows of features (P,).
        distance: of their descriptors (P,).
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    distance: NDArray[np.float32]

    def mutual_best(
        self, d_match: float, ratio: float, size: tuple[int, int], allowed: BoolArray | None = None
    ) -> BoolArray:
        """Which pairs (P,) are each other's nearest, nearer than `d_match`, and clearly nearer than the second.

        Only pairs that are `allowed` (P,) count; `size` are the numbers of landmarks and of features.
        """
        from slam.tracking.association_kernels import mutual_best

        allowed = np.ones(len(self.rows), bool) if allowed is None else allowed
        limits = np.float32(d_match), np.float32(ratio)
        return np.asarray(mutual_best(self.rows, self.columns, self.distance, allowed, size, *limits))


def _by_levels(pairs: _Pairs, level: NDArray[np.intp], size: tuple[int, int], config: AssociationConfig) -> Matches:
    """Match in the smallest windows first, then what is left in larger ones (paper A, Fig. 4)."""
    free_landmarks, free_features = np.ones(size[0], bool), np.ones(size[1], bool)
    landmarks, taken = [], []
    for number, d_match in enumerate(config.d_match):
        allowed = (level <= number) & free_landmarks[pairs.rows] & free_features[pairs.columns]
        best = pairs.mutual_best(d_match, config.ratio, size, allowed)
        landmarks.append(pairs.rows[best])
        taken.append(pairs.columns[best])
        free_landmarks[landmarks[-1]] = False
        free_features[taken[-1]] = False
    return Matches(np.concatenate(landmarks), np.concatenate(taken))


def crowded(uv: Array, others: Array, radius: float) -> BoolArray:
    """Which pixels (N, 2) lie within `radius` [px] of any of `others` (M, 2)."""
    if not len(others):
        return np.zeros(len(uv), bool)
    rows, columns = pairs_in_boxes(uv, np.full((len(uv), 2), radius), others)
    gap = (uv[rows] - others[columns]).astype(np.float32)
    out = np.zeros(len(uv), bool)
    out[rows[np.square(gap).sum(axis=1) < radius * radius]] = True
    return out
