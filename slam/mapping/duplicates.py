"""Duplicates: features and landmarks that have the position and descriptor of an existing landmark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import StereoFeatures
from slam.geometry.arrays import Array, BoolArray
from slam.mapping.config import MapConfig
from slam.tracks.follow import pairs_in_boxes
from slam.tracks.table import LandmarkTable
from slam.tracks.visibility import MapView

_SAME_PIXELS = 6.0  # landmarks further apart in the image than this [px] are not the same


def known_features(view: MapView, landmarks: LandmarkTable, features: StereoFeatures, config: MapConfig) -> BoolArray:
    """Which unmatched features (F,) have the position and descriptor of an existing landmark.

    Positions are the same if they are within `same_distance`, or differ in depth by no more than stereo's uncertainty.
    """
    out = np.zeros(len(features), bool)
    feature, rows = _near_landmarks(features.uv_left, view)
    offset = view.points[feature] - view.local[rows]
    along = np.abs(offset[:, 2]) < SIGMAS * view.depth_sigma[feature]
    same = along | (np.linalg.norm(offset, axis=1) < config.same_distance)
    same &= _alike(landmarks, rows, features.descriptors[feature], features.laplacian[feature], config)
    out[feature[same]] = True
    return out


def doubled_landmarks(view: MapView, landmarks: LandmarkTable, config: MapConfig) -> BoolArray:
    """Which landmarks in view (N,) duplicate another one that was seen more often, or as often and is older."""
    out = np.zeros(len(landmarks), bool)
    shown = np.flatnonzero(view.in_image)
    one, other = _near_landmarks(view.uv_left[shown], view)
    one = shown[one]
    less = (landmarks.seen[one] < landmarks.seen[other]) | (
        (landmarks.seen[one] == landmarks.seen[other]) & (one > other)
    )
    one, other = one[less], other[less]
    same = np.linalg.norm(view.positions[one] - view.positions[other], axis=1) < config.same_distance
    same &= _alike(landmarks, one, landmarks.descriptors[other], landmarks.laplacian[other], config)
    out[one[same]] = True
    return out


def _near_landmarks(uv: Array, view: MapView) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of pixels (P, 2) and landmarks in view that are near each other in the image, as rows of both."""
    shown = np.flatnonzero(view.in_image)
    if not len(uv) or not len(shown):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    at, which = pairs_in_boxes(uv, np.full((len(uv), 2), _SAME_PIXELS), view.uv_left[shown])
    return at, shown[which]


def _alike(
    landmarks: LandmarkTable,
    rows: NDArray[np.intp],
    descriptors: NDArray[np.float32],
    laplacian: NDArray[np.int8],
    config: MapConfig,
) -> BoolArray:
    """Whether landmarks at `rows` (P,) match descriptors (P, D) and signs of the Laplacian (P,), pair by pair."""
    distance = np.linalg.norm(landmarks.descriptors[rows] - descriptors, axis=1)
    return np.asarray((distance < config.same_descriptor) & (landmarks.laplacian[rows] == laplacian))
