"""Depth from two images of one moving camera (paper B, 2.2 and Fig. 2), for features without a stereo match.

Paper B takes two successive images. A hand-held camera moves a centimetre between frames, too little to show depth
beyond arm's length; so a feature's first view is kept while it is tracked from frame to frame, and its depth is
computed once the parallax is large enough.

The camera's motion between the two views comes from both pose estimates, whose errors are taken to be independent: each
is as uncertain as its own frame's measurements leave it (`frame_covariance`). So a new landmark's covariance contains
the noise of both views and of the motion. Correlations are neglected: landmarks made in the same frame share the error
of that motion, and it is part of the present pose's error.

A point that moves along its epipolar line gets a wrong depth: a single moving camera cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, exp, inverse, points_by_pose
from slam.tracks.follow import match_in_boxes, pairs_in_boxes
from slam.tracks.table import LandmarkTable
from slam.tracks.visibility import MapView

_PARALLAX = np.deg2rad(1.0)  # least angle between the two rays
_RADIUS = 20.0  # most that a feature moves between two frames, besides the camera's rotation [px]
_D_MATCH, _RATIO = 0.5, 0.7  # paper: descriptor distance; ratio of the nearest two (paper B, 2.2)
_KEPT = 45  # cost: frames in which a view is kept at most
_MISFIT = 6.6  # derived: χ²(1) at 99 %, of two views of one point
_VIEWS = 400  # cost: views kept at most
_CLAIM = 12.0  # a landmark claims features within this distance of its predicted pixel
_DIFFERENCES = np.repeat([1e-2, 1e-5], [4, 6])  # numerics: steps of numerical derivatives by pixels and by the motion


@dataclass(frozen=True, eq=False)
class Depths:
    """Points triangulated from two views, in the camera's coordinates at the second one (N rows)."""

    local: Array  # positions (N, 3) [m]; NaN where the rays do not meet in front of both cameras
    covariances: Array  # (N, 3, 3) [m²]
    misfit: Array  # how far the two views are from showing one point (N,), χ² with one degree of freedom
    parallax: Array  # angle between the rays (N,) [rad]

    def good(self, depth_error: float) -> BoolArray:
        """Which are known well enough (N,), `depth_error` being the largest relative standard deviation of depth."""
        with np.errstate(invalid="ignore", divide="ignore"):
            relative = np.sqrt(self.covariances[:, 2, 2]) / self.local[:, 2]
            return np.asarray((self.parallax > _PARALLAX) & (relative < depth_error) & (self.misfit < _MISFIT))


def two_view_depth(
    rig: StereoRig, uv_then: Array, uv_now: Array, T_then_now: Array, motion_covariance: Array, sigma: float
) -> Depths:
    """Triangulate points from two views of the left camera, to first order of the pixels' and the motion's errors.

    Both rays pass each other at a distance. The point between them is the estimate; that the true distance is zero is
    one more measurement of it, which also says whether the two views show one point.

    Args:
        rig: the cameras.
        uv_then: left pixels (N, 2) in the first view.
        uv_now: the same in the second.
        T_then_now: poses (4, 4) or (N, 4, 4) of the second camera in the first one's coordinates.
        motion_covariance: of these poses (6, 6) or (N, 6, 6), for a perturbation ``T exp(ξ)``.
        sigma: pixel noise [px].
    """
    n = len(uv_now)
    T = np.broadcast_to(T_then_now, (n, 4, 4))
    P = np.zeros((n, 10, 10))
    P[:, :4, :4], P[:, 4:, 4:] = sigma**2 * np.eye(4), motion_covariance
    z = np.concatenate([uv_then, uv_now, np.zeros((n, 6))], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        met, parallax = _meeting(rig, z, T)
        steps = np.diag(_DIFFERENCES)
        J = np.stack([(_meeting(rig, z + d, T)[0] - _meeting(rig, z - d, T)[0]) / (2 * d.sum()) for d in steps], axis=2)
        C = J @ P @ np.swapaxes(J, 1, 2)
        gain = C[:, :3, 3] / C[:, 3, 3:]
        local = met[:, :3] - gain * met[:, 3:]
        covariances = C[:, :3, :3] - gain[:, :, None] * C[:, 3:, :3]
        return Depths(local, covariances, met[:, 3] ** 2 / C[:, 3, 3], parallax)


def _meeting(rig: StereoRig, z: Array, T: Array) -> tuple[Array, Array]:
    """Where rays come closest to each other (N, 4): a point of the second camera and their distance; and their angles.

    `z` (N, 10) are pixels then and now, and changes of the motion `T` (N, 4, 4). NaN behind a camera.
    """
    T = T @ exp(z[:, 4:])
    R, t = T[:, :3, :3], T[:, :3, 3]
    then, now = _rays(rig, z[:, :2]), _rays(rig, z[:, 2:4])
    turned = (R @ now[:, :, None])[:, :, 0]
    across = np.cross(then, turned)
    size = (across * across).sum(axis=1)
    depth_then = (np.cross(t, turned) * across).sum(axis=1) / size
    depth = (np.cross(t, then) * across).sum(axis=1) / size
    gap = (across * t).sum(axis=1) / np.sqrt(size)
    between = (depth_then[:, None] * then - t + depth[:, None] * turned) / 2
    local = (np.swapaxes(R, 1, 2) @ between[:, :, None])[:, :, 0]
    local[~((depth > 0) & (depth_then > 0))] = np.nan
    return np.column_stack([local, gap]), np.arctan2(np.sqrt(size), (then * turned).sum(axis=1))


def _rays(rig: StereoRig, uv: Array) -> Array:
    """Rays (N, 3) with z = 1 of left pixels."""
    return np.concatenate([rig.left.normalise(uv), np.ones((len(uv), 1))], axis=1)


def frame_covariance(rig: StereoRig, local: Array, has_stereo: BoolArray, sigma: float) -> Array:
    """Covariance (6, 6) of the pose that a frame's measurements of landmarks at `local` (M, 3) [m] give by themselves.

    For a perturbation ``T exp(ξ)``, with the landmarks held fixed. Infinite if they do not determine a pose.
    """
    _, J = rig.project_stereo(local)
    by_pose = J @ points_by_pose(local)
    by_pose[~has_stereo, 2] = 0
    rows = np.nan_to_num(by_pose).reshape(-1, 6) / sigma
    return np.asarray(np.linalg.inv(rows.T @ rows + 1e-6 * np.eye(6)))


def unclaimed(view: MapView, landmarks: LandmarkTable, features: StereoFeatures, rows: NDArray) -> NDArray[np.intp]:
    """Those of the features `rows` (K,) that no landmark in view claims: none nearby in the image looks alike."""
    shown = np.flatnonzero(view.in_image)
    if not len(rows) or not len(shown):
        return np.asarray(rows)
    at, which = pairs_in_boxes(view.uv_left[shown], np.full((len(shown), 2), _CLAIM), features.uv_left[rows])
    gap = np.linalg.norm(landmarks.descriptors[shown[at]] - features.descriptors[rows[which]], axis=1)
    return np.delete(rows, which[gap < _D_MATCH])


#: Columns of first views of features that are being tracked, a row each: "uv_first" and "uv_last" (N, 2), "T_first"
#: and "T_last" (N, 4, 4), "covariance" (N, 6, 6) of the former, "frame" (N,), "descriptors" (N, D), "laplacian" (N,).
_Views = dict[str, NDArray]


class MonocularDepth:
    """Tracks features without depth until two views give it.

    Args:
        rig: the cameras.
        sigma: pixel noise [px].
        depth_error: largest relative standard deviation of a new landmark's depth.
    """

    def __init__(self, rig: StereoRig, sigma: float, depth_error: float) -> None:
        self._rig = rig
        self._sigma = sigma
        self._depth_error = depth_error
        self._views: _Views = {}

    def step(
        self, features: StereoFeatures, rows: NDArray[np.intp], T_world_left: Array, covariance: Array, frame: int
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Take in a frame.

        Args:
            features: of the frame.
            rows: features without depth that could become landmarks (K,).
            T_world_left: pose (4, 4) after the update.
            covariance: of the pose by this frame, see `frame_covariance`.
            frame: the frame's number.

        Returns:
            rows of the features whose depth has become known (N,), their positions (N, 3) [m] in the camera's
            coordinates, and covariances (N, 3, 3) [m²].
        """
        views = self._views or _first_views(features, rows[:0], T_world_left, covariance, frame)
        row, view = self._followed(views, features, rows, T_world_left)
        seen = _select(views, view)
        motion = adjoint(inverse(T_world_left) @ seen["T_first"])
        P = covariance + motion @ seen["covariance"] @ np.swapaxes(motion, 1, 2)
        T_first_now, uv = inverse(seen["T_first"]) @ T_world_left, features.uv_left[row]
        depths = two_view_depth(self._rig, seen["uv_first"], uv, T_first_now, P, self._sigma)
        good = depths.good(self._depth_error)
        again = ~good & (depths.misfit < _MISFIT)
        now = _first_views(features, row, T_world_left, covariance, frame)
        kept = _select({**seen, **{name: now[name] for name in ("uv_last", "T_last", "descriptors")}}, again)
        lost = {name: np.delete(column, view, axis=0) for name, column in views.items()}
        fresh = _first_views(features, np.setdiff1d(rows, row[good | again]), T_world_left, covariance, frame)
        every = {name: np.concatenate([kept[name], lost[name], fresh[name]]) for name in views}
        self._views = _select(every, np.flatnonzero(every["frame"] > frame - _KEPT)[-_VIEWS:])
        return row[good], depths.local[good], depths.covariances[good]

    def _followed(
        self, views: _Views, features: StereoFeatures, rows: NDArray[np.intp], T: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Matches of features and kept views: rows of features and rows of views, each at most once."""
        turn = np.swapaxes(views["T_last"][:, :3, :3], 1, 2) @ T[:3, :3]
        expected = self._rig.left.project((_rays(self._rig, views["uv_last"])[:, None, :] @ turn)[:, 0])
        # Of a repeated pattern a wrong one may be nearer than the right one, so twice as far away counts as a rival.
        looks = views["descriptors"], views["laplacian"]
        found = match_in_boxes(expected, 2 * _RADIUS, *looks, features, rows, _D_MATCH, _RATIO)
        gap = np.abs(features.uv_left[found.features] - expected[found.landmarks])
        found = found.select(np.flatnonzero((gap <= _RADIUS).all(axis=1)))
        return found.features, found.landmarks


def _first_views(features: StereoFeatures, rows: NDArray, T: Array, covariance: Array, frame: int) -> _Views:
    """Views of the features `rows` (N,) in a frame that has just been seen from a pose (4, 4)."""
    n, uv = len(rows), features.uv_left[rows]
    poses = np.tile(T, (n, 1, 1))
    return {
        "uv_first": uv, "uv_last": uv, "T_first": poses, "T_last": poses, "covariance": np.tile(covariance, (n, 1, 1)),
        "frame": np.full(n, frame), "descriptors": features.descriptors[rows], "laplacian": features.laplacian[rows],
    }  # fmt: skip


def _select(views: _Views, rows: NDArray) -> _Views:
    return {name: column[rows] for name, column in views.items()}
