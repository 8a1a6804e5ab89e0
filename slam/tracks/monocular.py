"""Depth from two images of one moving camera (paper B, 2.2 and Fig. 2), for features without a stereo match.

Paper B takes two successive images. A hand-held camera moves a centimetre between frames, too little to show depth
beyond arm's length; so a feature's first view is kept in its row of the tracks while it is followed, and its depth is
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

from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import Table
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, exp, inverse, points_by_pose
from slam.tracks.follow import Matches, Windows, follow
from slam.tracks.table import Tracks

_PARALLAX = np.deg2rad(1.0)  # least angle between the two rays
_RADIUS = 20.0  # most that a feature moves between two frames, besides the camera's rotation [px]
_D_MATCH, _RATIO = 0.5, 0.7  # paper: descriptor distance; ratio of the nearest two (paper B, 2.2)
_KEPT = 45  # cost: frames in which a view is kept at most
_MISFIT = 6.6  # derived: χ²(1) at 99 %, of two views of one point
_VIEWS = 400  # cost: views kept at most
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
    """Triangulate points from pixels (N, 2) in two views, to first order of the pixels' and the motion's errors.

    Both rays pass each other at a distance. The point between them is the estimate; that the true distance is zero is
    one more measurement of it, which also says whether the two views show one point. The second camera's poses in the
    first one's coordinates (N, 4, 4) have covariances (N, 6, 6), or all share one; `sigma` is the pixel noise [px].
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


def unclaimed(uv: Array, descriptors: NDArray[np.float32], features: StereoFeatures, rows: IndexArray) -> IndexArray:
    """Those of the features `rows` (K,) to which no landmark in view, at pixels (M, 2), is near and looks alike."""
    if not len(rows) or not len(uv):
        return np.asarray(rows)
    at, which = np.nonzero(np.abs(uv[:, None] - features.uv_left[rows]).max(axis=2) <= 12.0)
    gap = np.linalg.norm(descriptors[at] - features.descriptors[rows[which]], axis=1)
    return np.delete(rows, which[gap < _D_MATCH])


def depths_by_motion(
    rig: StereoRig, tracks: Tracks, features: StereoFeatures, rows: IndexArray, T_world_left: Array, covariance: Array,
    frame: int, sigma: float, depth_error: float,
) -> tuple[IndexArray, Depths]:  # fmt: skip
    """Follow features `rows` (K,) without depth into a frame, in place, until two views give depth.

    The frame has the pose (4, 4) with a covariance (6, 6) as in `frame_covariance`; `sigma` is the pixel noise [px],
    `depth_error` the largest relative standard deviation of a depth. Returns the rows of `features` (N,) whose depth
    has become known, and these depths.
    """
    directions = _rays(rig, features.uv_left[rows]) @ T_world_left[:3, :3].T
    waiting = np.flatnonzero(tracks.waiting_since >= 0)
    pairs = _followed(rig, tracks, waiting, features.select(rows), T_world_left)
    shared = np.bincount(pairs.features, minlength=len(rows))[pairs.features] > 1  # by tracks alike to the bit
    tracks.waiting_since[waiting[pairs.tracks[shared]]] = -1  # whose it is cannot be told: it begins to wait anew
    pairs = pairs.select(np.flatnonzero(~shared))
    at, seen = waiting[pairs.tracks], rows[pairs.features]
    then = tracks.first_pose[at]
    motion = adjoint(inverse(T_world_left) @ then)
    P = covariance + motion @ tracks.first_covariance[at] @ np.swapaxes(motion, 1, 2)
    now = features.uv_left[seen]
    depths = two_view_depth(rig, tracks.first_pixel[at], now, inverse(then) @ T_world_left, P, sigma)
    good = depths.good(depth_error)
    goes_on = ~good & (depths.misfit < _MISFIT)
    tracks.row[at] = seen
    tracks.look[at], tracks.direction[at] = features.descriptors[seen], directions[pairs.features]
    tracks.waiting_since[at[~(good | goes_on)]] = -1
    new = np.delete(np.arange(len(rows)), pairs.features[good | goes_on])
    tracks.wait(frame, features, rows[new], directions[new], T_world_left, covariance)
    tracks.waiting_since[at[good]] = -1
    tracks.waiting_since[tracks.waiting_since <= frame - _KEPT] = -1
    waiting = np.flatnonzero(tracks.waiting_since >= 0)
    oldest = np.argsort(tracks.waiting_since[waiting], kind="stable")[: max(len(waiting) - _VIEWS, 0)]
    tracks.waiting_since[waiting[oldest]] = -1
    return seen[good], depths.select(good)


def _followed(
    rig: StereoRig, tracks: Tracks, waiting: IndexArray, features: StereoFeatures, T_world_left: Array
) -> Matches:
    """Features that continue the tracks `waiting` (M,) for a depth, where the camera's rotation takes them."""
    expected = rig.left.project(tracks.direction[waiting] @ T_world_left[:3, :3])
    # Of a repeated pattern a wrong one may be nearer than the right one, so twice as far away counts as a rival.
    windows, none = Windows((1.0,), (_D_MATCH,), _RATIO, 2 * _RADIUS, 2 * _RADIUS), np.zeros((len(expected), 2, 2))
    pairs = follow(expected, none, tracks.look[waiting], tracks.laplacian[waiting], features, windows)
    gap = np.abs(features.uv_left[pairs.features] - expected[pairs.tracks])
    return pairs.select(np.flatnonzero((gap <= _RADIUS).all(axis=1)))
