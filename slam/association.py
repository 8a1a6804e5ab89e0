"""Which feature is which landmark: size-variable search windows and descriptor distance (paper A, III and IV).

Landmarks in the angle of view are looked for around their predicted pixels: in the smallest window first, and, where
nothing is found, in larger windows under a stricter descriptor distance (paper A, Fig. 4 and Eq. 12). Every landmark's
best candidate is found before any feature is taken, so that no landmark steals the feature of another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, Prediction, StereoFeatures
from slam.errors import ConfigurationError
from slam.models import FORBID_UNKNOWN, require_not_negative
from slam.se3 import Array

Descriptors = NDArray[np.float32]

_NONE = np.float32(np.inf)


@dataclass(frozen=True)
class AssociationConfig:
    """Settings of the association.

    Attributes:
        window_sigmas: half sizes of the search windows, smallest first, in standard deviations of the innovation.
        window_min, window_max: bounds of a window's half axes [px].
        d_match: largest descriptor distance in each window (paper A, Eq. 12); falls as the window grows.
        ratio: largest ratio of the best to the second best distance in a window (paper B, 2.2).
        wide_d_match, wide_ratio: the same for matching against the whole map without windows.
        minimum_consistent: with fewer matches after the geometric check, the whole map is tried.
        consistency_sigmas: reprojection error up to which a match agrees with a pose, in units of the pixel noise.
        hypotheses, wide_hypotheses: number of poses tried in the geometric check, of matches in windows and of matches
            against the whole map.
        tight_window: where the median deviation of the innovations is below this [px], the prediction is trusted: few
            matches suffice, and no second search is made.
        refined_window: deviation [px] assumed in the second search, around the pose on which matches agreed.
    """

    window_sigmas: tuple[float, ...] = (2.5, 5.0)
    window_min: float = 4.0
    window_max: float = 400.0
    d_match: tuple[float, ...] = (0.55, 0.4)
    ratio: float = 0.8
    wide_d_match: float = 0.4
    wide_ratio: float = 0.9
    minimum_consistent: int = 8
    consistency_sigmas: float = 5.0
    hypotheses: int = 100
    wide_hypotheses: int = 1000
    tight_window: float = 12.0
    refined_window: float = 3.0

    __pydantic_config__ = FORBID_UNKNOWN

    def __post_init__(self) -> None:
        require_not_negative(self)
        if len(self.window_sigmas) != len(self.d_match) or not self.window_sigmas:
            raise ConfigurationError("association: window_sigmas and d_match must have the same number of values")
        if list(self.window_sigmas) != sorted(self.window_sigmas) or self.window_sigmas[0] <= 0:
            raise ConfigurationError("association: window_sigmas must be positive and ascending")
        if not 0 < self.window_min <= self.window_max:
            raise ConfigurationError("association: 0 < window_min <= window_max is required")
        if not (0 < self.ratio <= 1 and 0 < self.wide_ratio <= 1):
            raise ConfigurationError("association: ratios must lie in (0, 1]")
        if min(self.hypotheses, self.wide_hypotheses) < 1 or self.minimum_consistent < 3:
            raise ConfigurationError("association: hypotheses >= 1 and minimum_consistent >= 3 are required")


@dataclass(frozen=True)
class Matches:
    """Pairs of a landmark and a feature.

    Attributes:
        landmarks: rows of the landmark list that was given (K,).
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
) -> Matches:
    """Match predicted landmarks (M) to features (N) inside size-variable windows.

    Args:
        prediction: landmarks in the angle of view, their pixels and innovation covariances.
        descriptors: of those landmarks (M, D).
        laplacian: signs of their Laplacians (M,).
        features: of the frame.
        config: settings.
    """
    if not len(prediction.ids) or not len(features):
        return Matches(np.zeros(0, np.intp), np.zeros(0, np.intp))
    distance = _descriptor_distances(descriptors, laplacian, features)
    deviation = _deviations(prediction, features.uv_left, config)
    free_landmarks = np.ones(len(prediction.ids), bool)
    free_features = np.ones(len(features), bool)
    landmarks, taken = [], []
    for sigmas, d_match in zip(config.window_sigmas, config.d_match):
        allowed = deviation <= sigmas * sigmas
        allowed &= free_landmarks[:, None] & free_features[None, :]
        rows, columns = _mutual_best(np.where(allowed, distance, _NONE), d_match, config.ratio)
        landmarks.append(rows)
        taken.append(columns)
        free_landmarks[rows] = False
        free_features[columns] = False
    return Matches(np.concatenate(landmarks), np.concatenate(taken))


def match_everywhere(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures, config: AssociationConfig
) -> Matches:
    """Match landmarks (M, D) to features by descriptor alone, wherever they lie in the image."""
    if not len(descriptors) or not len(features):
        return Matches(np.zeros(0, np.intp), np.zeros(0, np.intp))
    distance = _descriptor_distances(descriptors, laplacian, features)
    return Matches(*_mutual_best(distance, config.wide_d_match, config.wide_ratio))


def _descriptor_distances(
    descriptors: Descriptors, laplacian: NDArray[np.int8], features: StereoFeatures
) -> NDArray[np.float32]:
    """Euclidean distances (M, N) of unit descriptors (paper A, Eq. 12); infinite where the Laplacian signs differ."""
    distance = 2 - 2 * (descriptors @ features.descriptors.T)
    np.maximum(distance, 0, out=distance)
    np.sqrt(distance, out=distance)
    distance[laplacian[:, None] != features.laplacian[None, :]] = _NONE
    return distance


def _deviations(prediction: Prediction, uv: Array, config: AssociationConfig) -> NDArray[np.float32]:
    """Squared distances (M, N) of features from predicted pixels, in units of the innovation's deviation.

    The half axes of the unit ellipse are bounded, so that a window is never smaller than `window_min` nor larger than
    `window_max` at its first level.
    """
    lower = (config.window_min / config.window_sigmas[0]) ** 2
    upper = (config.window_max / config.window_sigmas[0]) ** 2
    values, vectors = np.linalg.eigh(prediction.innovation)
    values = np.clip(values, lower, upper)
    information = np.einsum("mij,mj,mkj->mik", vectors, 1 / values, vectors).astype(np.float32)
    du = (uv[None, :, 0] - prediction.uv_left[:, None, 0]).astype(np.float32)
    dv = (uv[None, :, 1] - prediction.uv_left[:, None, 1]).astype(np.float32)
    a, b, c = (information[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    return a * du * du + (2 * b) * du * dv + c * dv * dv


def _mutual_best(
    distance: NDArray[np.float32], d_match: float, ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns that are each other's nearest, nearer than `d_match`, and clearly nearer than the second."""
    rows = np.arange(len(distance))
    best = np.argmin(distance, axis=1)
    nearest = distance[rows, best]
    good = (nearest < d_match) & (np.argmin(distance, axis=0)[best] == rows)
    if distance.shape[1] > 1:
        second = np.partition(distance, 1, axis=1)[:, 1]
        good &= nearest < ratio * second
    return rows[good], best[good]


def crowded(uv: Array, others: Array, radius: float) -> BoolArray:
    """Which pixels (N, 2) lie within `radius` [px] of any of `others` (M, 2)."""
    if not len(others):
        return np.zeros(len(uv), bool)
    gap = (uv[:, None] - others[None]).astype(np.float32)
    return np.asarray(((gap**2).sum(axis=2) < radius * radius).any(axis=1))
