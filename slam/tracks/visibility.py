"""Which landmarks a frame should show, and which are hidden (paper A, IV: the angle of view)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import BoolArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.tracks.follow import pairs_in_boxes


@dataclass(frozen=True, eq=False)
class MapView:
    """The map and the frame's features as seen from one pose."""

    T_world_left: Array  # the pose (4, 4)
    positions: Array  # of the landmarks (N, 3) in world coordinates [m]
    local: Array  # the same in left-camera coordinates (N, 3)
    uv_left: Array  # the landmarks' left pixels (N, 2), NaN behind the camera
    in_image: BoolArray  # which landmarks are in front of the camera and inside the left image (N,)
    points: Array  # the features in left-camera coordinates (F, 3), NaN without depth
    depth_sigma: Array  # standard deviations of the features' depths (F,) [m]

    @classmethod
    def of(
        cls, rig: StereoRig, T_world_left: Array, positions: Array, features: StereoFeatures, pixel_sigma: float
    ) -> MapView:
        """Landmarks at `positions` (N, 3) and features, seen from a pose (4, 4)."""
        local = transform(inverse(T_world_left), positions)
        uv = rig.left.project(local)
        points = rig.triangulate(features.uv_left, features.uv_right)
        deviation = rig.depth_deviation(points, pixel_sigma)
        return cls(T_world_left, positions, local, uv, rig.left.in_image(uv), points, deviation)


def similar_view(positions: Array, seen_from: Array, camera: Array, angle: float, ratio: float) -> BoolArray:
    """Which landmarks (N,) are seen from `camera` (3,) in a view similar to that of their first sight.

    From another viewpoint, the point that a descriptor describes shifts over the surface, and then changes.

    Args:
        positions: of the landmarks (N, 3) [m].
        seen_from: the camera's position at first sight (N, 3) [m]; NaN if unknown, and then nothing is ruled out.
        camera: the camera's present position, in the same world.
        angle: largest angle between both lines of sight [degrees].
        ratio: largest ratio of both distances.
    """
    then, now = positions - seen_from, positions - camera
    before, after = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    turned = np.einsum("ij,ij->i", then, now) < np.cos(np.deg2rad(angle)) * before * after
    return np.asarray(~(turned | (after > ratio * before) | (before > ratio * after)))


def expected_landmarks(
    view: MapView, features: StereoFeatures, size: tuple[int, int], margin: float, radius: float
) -> BoolArray:
    """Which landmarks (N,) should have been detected: well inside the image and not hidden.

    Args:
        view: the map from the pose after the update.
        features: of the frame.
        size: width and height of the image [px].
        margin: distance from the border [px] within which detection is not certain.
        radius: see `hidden_landmarks`.
    """
    with np.errstate(invalid="ignore"):
        inside = ((view.uv_left >= margin) & (view.uv_left <= np.array(size) - 1 - margin)).all(axis=1)
    rows = np.flatnonzero(inside & view.in_image)
    out = np.zeros(len(view.positions), bool)
    out[rows] = ~hidden_landmarks(view, rows, features, radius)
    return out


def hidden_landmarks(view: MapView, rows: NDArray[np.intp], features: StereoFeatures, radius: float) -> BoolArray:
    """Which landmarks of `rows` (M,) are hidden behind a nearer surface.

    A landmark counts as hidden if most of the features within `radius` [px] are clearly nearer than it is.
    """
    stereo = np.flatnonzero(np.isfinite(view.depth_sigma))
    if not len(rows) or not len(stereo) or radius <= 0:
        return np.zeros(len(rows), bool)
    at, which = pairs_in_boxes(view.uv_left[rows], np.full((len(rows), 2), radius), features.uv_left[stereo])
    feature = stereo[which]
    depth = view.points[feature, 2] + SIGMAS * view.depth_sigma[feature]
    # 0.9: a surface nearer than this share of a landmark's depth may hide it
    nearer = depth < 0.9 * view.local[rows[at], 2]
    around = np.bincount(at, minlength=len(rows))
    return 2 * np.bincount(at, nearer, minlength=len(rows)) > around
