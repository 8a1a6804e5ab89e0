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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.arrays import Table
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, exp, inverse, points_by_pose
from slam.tracks.follow import Matches, Windows, follow, pairs_in_boxes
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
class Depths(Table):
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


@dataclass(frozen=True, eq=False)
class FirstViews(Table):
    """Features without depth that are followed until two views give it, a row each."""

    uv_first: Array  # left pixels (N, 2) at first sight
    T_first: Array  # T_world_left (N, 4, 4) then
    covariance: Array  # of that pose (N, 6, 6) by its own frame, see `frame_covariance`
    frame: NDArray[np.int64]  # its number (N,)
    uv_last: Array  # left pixels (N, 2) when last seen
    T_last: Array  # T_world_left (N, 4, 4) then
    descriptors: NDArray[np.float32]  # as last seen (N, D)
    laplacian: NDArray[np.int8]  # signs of the Laplacian (N,)


def depths_by_motion(
    rig: StereoRig, views: FirstViews | None, features: StereoFeatures, T_world_left: Array, covariance: Array,
    frame: int, sigma: float, depth_error: float,
) -> tuple[FirstViews, NDArray[np.intp], Depths]:  # fmt: skip
    """Follow features without depth into a frame.

    Args:
        rig: the cameras.
        views: the features followed so far; None for none.
        features: of the frame, without depth, that could become landmarks (K rows).
        T_world_left: pose (4, 4) after the update.
        covariance: of the pose by this frame (6, 6), see `frame_covariance`.
        frame: the frame's number.
        sigma: pixel noise [px].
        depth_error: largest relative standard deviation of a new landmark's depth.

    Returns:
        the features that are followed on, the rows of `features` (N,) whose depth has become known, and these depths.
    """
    n, uv = len(features), features.uv_left
    T, P = np.tile(T_world_left, (n, 1, 1)), np.tile(covariance, (n, 1, 1))
    now = FirstViews(uv, T, P, np.full(n, frame), uv, T, features.descriptors, features.laplacian)
    views = now.select(slice(0)) if views is None else views
    found = _followed(rig, views, features, T_world_left)
    first, seen = views.select(found.tracks), now.select(found.features)
    motion = adjoint(inverse(T_world_left) @ first.T_first)
    P = covariance + motion @ first.covariance @ np.swapaxes(motion, 1, 2)
    depths = two_view_depth(rig, first.uv_first, seen.uv_last, inverse(first.T_first) @ T_world_left, P, sigma)
    good = depths.good(depth_error)
    again = ~good & (depths.misfit < _MISFIT)
    kept = replace(first, uv_last=seen.uv_last, T_last=seen.T_last, descriptors=seen.descriptors).select(again)
    lost = views.select(np.delete(np.arange(len(views)), found.tracks))
    fresh = now.select(np.delete(np.arange(n), found.features[good | again]))
    every = kept.joined(lost).joined(fresh)
    return (
        every.select(np.flatnonzero(every.frame > frame - _KEPT)[-_VIEWS:]),
        found.features[good],
        depths.select(good),
    )


def _followed(rig: StereoRig, views: FirstViews, features: StereoFeatures, T_world_left: Array) -> Matches:
    """Features that continue views, where the camera's rotation takes them."""
    turn = np.swapaxes(views.T_last[:, :3, :3], 1, 2) @ T_world_left[:3, :3]
    expected = rig.left.project((_rays(rig, views.uv_last)[:, None, :] @ turn)[:, 0])
    # Of a repeated pattern a wrong one may be nearer than the right one, so twice as far away counts as a rival.
    windows, square = Windows((2 * _RADIUS,), (_D_MATCH,), _RATIO), np.zeros((len(expected), 2, 2))
    found = follow(expected, square, views.descriptors, views.laplacian, features, windows)
    gap = np.abs(features.uv_left[found.features] - expected[found.tracks])
    return found.select(np.flatnonzero((gap <= _RADIUS).all(axis=1)))
