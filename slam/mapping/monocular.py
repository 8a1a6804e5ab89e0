"""Depth from two images of one moving camera (paper B, 2.2 and Fig. 2), for features without a stereo match.

Paper B takes two successive images. A hand-held camera moves a centimetre between frames, too little to show depth
beyond arm's length; so a feature's first view is kept while it is tracked from frame to frame, and its depth is
computed once the parallax is large enough.

The camera's motion between the two views comes from both pose estimates, whose errors are taken to be independent. A
pose's covariance is that by which its own frame's measurements fix it (`frame_covariance`), or the back end's if that
is smaller, as in a well-known map. So a new landmark's covariance contains the noise of both views and of the motion.
Correlations are neglected: landmarks made in the same frame share the error of that motion, and it is part of the
present pose's error.

A point that moves along its epipolar line gets a wrong depth: a single moving camera cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, Estimate, IdArray, StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose
from slam.tracks.follow import match_in_boxes, pairs_in_boxes
from slam.tracks.localizer import LandmarkMatches
from slam.tracks.table import LandmarkTable
from slam.tracks.visibility import MapView

_PARALLAX = np.deg2rad(1.0)  # least angle between the two rays
_RADIUS = 20.0  # most that a feature moves between two frames, besides the camera's rotation [px]
_D_MATCH, _RATIO = 0.5, 0.7  # paper: descriptor distance; ratio of the nearest two (paper B, 2.2)
_KEPT = 45  # cost: frames in which a view is kept at most
_MISFIT = 6.6  # derived: χ²(1) at 99 %, of two views of one point
_STEPS = 4  # numerics: Gauss-Newton steps on a point's depth
_VIEWS = 400  # cost: views kept at most
_CLAIM = 12.0  # a landmark claims features within this distance of its predicted pixel


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
    """Triangulate points from two views of the left camera: linearly, then by Gauss-Newton on the reprojection errors.

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
    P = np.broadcast_to(motion_covariance, (n, 6, 6))
    R, t = T[:, :3, :3], T[:, :3, 3]
    then = _rays(rig, uv_then)
    now = _rays(rig, uv_now)
    turned = (R @ now[:, :, None])[:, :, 0]
    local = now * _depth(then, turned, t)[:, None]
    cosine = (then * turned).sum(axis=1) / (np.linalg.norm(then, axis=1) * np.linalg.norm(turned, axis=1))
    covariance, misfit = np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    for _ in range(_STEPS):
        step, covariance, misfit = _step(rig, uv_then, uv_now, R, t, P, local, sigma)
        local = local + step
    local[~(local[:, 2] > 0)] = np.nan
    return Depths(local, covariance, misfit, np.arccos(np.clip(cosine, -1, 1)))


def _rays(rig: StereoRig, uv: Array) -> Array:
    """Rays (N, 3) with z = 1 of left pixels."""
    return np.concatenate([rig.left.normalise(uv), np.ones((len(uv), 1))], axis=1)


def _depth(then: Array, turned: Array, t: Array) -> Array:
    """Depth (N,) along the second rays at which both rays are closest to each other; NaN behind a camera."""
    a, b, c = (then * then).sum(axis=1), (then * turned).sum(axis=1), (turned * turned).sum(axis=1)
    d, e = (then * t).sum(axis=1), (turned * t).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = a * c - b * b
        depth = (b * d - a * e) / determinant
        depth_then = (c * d - b * e) / determinant
    return np.where((depth > 0) & (depth_then > 0), depth, np.nan)


def _step(
    rig: StereoRig, uv_then: Array, uv_now: Array, R: Array, t: Array, P: Array, local: Array, sigma: float
) -> tuple[Array, Array, Array]:
    """A Gauss-Newton step (N, 3), the covariance (N, 3, 3) at its start, and the misfit (N,)."""
    z_now, J_now = rig.left.project_with_jacobian(local)
    z_then, J_then = rig.left.project_with_jacobian((R @ local[:, :, None])[:, :, 0] + t)
    J_then = J_then @ R  # by the point in the second camera
    by_motion = J_then @ -points_by_pose(local)
    noise = by_motion @ P @ np.swapaxes(by_motion, 1, 2) + sigma**2 * np.eye(2)
    bad = ~(np.isfinite(noise).all(axis=(1, 2)) & np.isfinite(J_now).all(axis=(1, 2)))
    noise[bad], J_now[bad], J_then[bad] = np.eye(2), 0, 0
    weight = np.linalg.inv(noise)
    r_now, r_then = np.nan_to_num(uv_now - z_now)[:, :, None], np.nan_to_num(uv_then - z_then)[:, :, None]
    Jt, Kt = np.swapaxes(J_now, 1, 2), np.swapaxes(J_then, 1, 2)
    information = Jt @ J_now / sigma**2 + Kt @ weight @ J_then
    singular = bad | ~(np.linalg.cond(information) < 1e14)
    information[singular] = np.eye(3)
    covariance = np.linalg.inv(information)
    step = (covariance @ (Jt @ r_now / sigma**2 + Kt @ weight @ r_then))[:, :, 0]
    misfit = (r_now * r_now).sum(axis=(1, 2)) / sigma**2 + (np.swapaxes(r_then, 1, 2) @ weight @ r_then)[:, 0, 0]
    step[singular], covariance[singular], misfit[singular] = 0, np.nan, np.inf
    return step, covariance, misfit


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
    claimed = np.zeros(len(rows), bool)
    claimed[which[gap < _D_MATCH]] = True
    return np.asarray(rows[~claimed])


@dataclass(frozen=True, eq=False)
class _Views:
    """First views of the features being tracked, one row each."""

    uv_first: Array
    uv_last: Array
    T_first: Array  # camera pose in the first view
    covariance: Array  # of that pose, see `frame_covariance`
    T_last: Array
    frame: IdArray
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: NDArray) -> _Views:
        return _Views(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def joined(self, other: _Views) -> _Views:
        names = self.__dataclass_fields__
        return _Views(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    @classmethod
    def of(cls, features: StereoFeatures, rows: NDArray, T: Array, covariance: Array, frame: int) -> _Views:
        n, uv = len(rows), features.uv_left[rows]
        poses = np.tile(T, (n, 1, 1))
        return cls(
            uv, uv, poses, np.tile(covariance, (n, 1, 1)), poses, np.full(n, frame), features.descriptors[rows],
            features.laplacian[rows],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class NewPoints:
    """Features whose depth has become known."""

    rows: NDArray[np.intp]  # of the features (N,)
    local: Array  # positions (N, 3) [m] in the camera's coordinates
    covariances: Array  # (N, 3, 3) [m²]


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
        self._views: _Views | None = None

    def pose_covariance(
        self,
        estimate: Estimate,
        view: MapView,
        landmarks: LandmarkTable,
        features: StereoFeatures,
        found: LandmarkMatches,
    ) -> Array:
        """Covariance (6, 6) of the pose: by this frame alone or by the back end, whichever is smaller."""
        there = np.isin(found.ids, landmarks.ids)
        local, stereo = view.local[landmarks.rows(found.ids[there])], features.has_stereo[found.rows[there]]
        alone = frame_covariance(self._rig, local, stereo, self._sigma)
        return min(alone, estimate.covariance, key=lambda P: float(np.trace(P[3:, 3:])))

    def step(
        self, features: StereoFeatures, rows: NDArray[np.intp], T_world_left: Array, covariance: Array, frame: int
    ) -> NewPoints:
        """Take in a frame.

        Args:
            features: of the frame.
            rows: features without depth that could become landmarks (K,).
            T_world_left: pose (4, 4) after the update.
            covariance: of the pose by this frame, see `frame_covariance`.
            frame: the frame's number.
        """
        views = self._views or _Views.of(features, rows[:0], T_world_left, covariance, frame)
        row, view = self._followed(views, features, rows, T_world_left)
        seen = views.select(view)
        back = inverse(seen.T_first)
        motion = adjoint(inverse(T_world_left) @ seen.T_first)
        P = covariance + motion @ seen.covariance @ np.swapaxes(motion, 1, 2)
        depths = two_view_depth(
            self._rig, seen.uv_first, features.uv_left[row], back @ T_world_left, P, self._sigma
        )  # fmt: skip
        good = depths.good(self._depth_error)
        again = ~good & (depths.misfit < _MISFIT)
        kept = replace(
            seen, uv_last=features.uv_left[row], T_last=np.tile(T_world_left, (len(row), 1, 1)),
            descriptors=features.descriptors[row],
        ).select(again)  # fmt: skip
        lost = views.select(np.setdiff1d(np.arange(len(views)), view))
        fresh = _Views.of(features, np.setdiff1d(rows, row[good | again]), T_world_left, covariance, frame)
        everything = kept.joined(lost).joined(fresh)
        everything = everything.select(everything.frame > frame - _KEPT)
        self._views = everything.select(np.arange(len(everything))[-_VIEWS:])
        return NewPoints(row[good], depths.local[good], depths.covariances[good])

    def _followed(
        self, views: _Views, features: StereoFeatures, rows: NDArray[np.intp], T: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Matches of features and kept views: rows of features and rows of views, each at most once."""
        turn = np.swapaxes(views.T_last[:, :3, :3], 1, 2) @ T[:3, :3]
        expected = self._rig.left.project((_rays(self._rig, views.uv_last)[:, None, :] @ turn)[:, 0])
        # Of a repeated pattern a wrong one may be nearer than the right one, so twice as far away counts as a rival.
        found = match_in_boxes(
            expected, 2 * _RADIUS, views.descriptors, views.laplacian, features, rows, _D_MATCH, _RATIO
        )  # fmt: skip
        gap = np.abs(features.uv_left[found.features] - expected[found.landmarks])
        found = found.select(np.flatnonzero((gap <= _RADIUS).all(axis=1)))
        return found.features, found.landmarks
