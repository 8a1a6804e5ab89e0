"""Tests whether a frame shows a keyframe's place: by descriptors, then by geometry, which gives pose and covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.atlas.config import AtlasConfig
from slam.atlas.keyframes import Keyframe, Loop, covariance_growth
from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig, measurement_rows
from slam.geometry.se3 import Array, points_by_pose
from slam.tracks.localizer import Localizer, Search, nowhere
from slam.tracks.table import LandmarkTable
from slam.window.problem import Rows, Window
from slam.window.solver import linearised, solve
from slam.window.stereo import RectifiedStereo


def verify(
    keyframe: Keyframe, features: StereoFeatures, pair: tuple[int, int], rig: StereoRig, localizer: Localizer, seed: int
) -> Loop | None:
    """The loop from a keyframe to the present camera; None if too few features agree, or all are in one spot.

    `pair` are the numbers of both keyframes; `seed` is of the random choice in the geometric check.
    """
    points = keyframe.points.astype(float)
    landmarks = replace(keyframe_landmarks(keyframe), ids=np.arange(len(points)))
    found = Search(localizer, nowhere(features.stamp, np.eye(4)), landmarks, points, features, seed).match()
    if found.T_world_left is None or len(found) < AtlasConfig.inliers:
        return None
    ids, seen = found.ids, found.rows
    across = np.linalg.eigvalsh(np.cov(features.uv_left[seen].T))[-1]
    if np.sqrt(across) < AtlasConfig.spread * rig.width:
        return None
    measured = measurement_rows(features.uv_left[seen], features.uv_right[seen])
    try:
        T, noise = refined_pose(rig, points[ids], measured, found.T_world_left, localizer.models.pixel_sigma)
    except np.linalg.LinAlgError:  # points that fix no pose, such as those of a corrupt map
        return None
    slide = 1 / rig.left.fu  # seen from another viewpoint, all features of a place shift by a pixel on the surface
    covariance = noise + np.diag(np.repeat([slide, slide * keyframe.depth], 3) ** 2)
    # Each of both poses has an error of its own frame too, at most as large as such a measurement's noise.
    return Loop(*pair, T, covariance + noise, len(found))


def refined_pose(
    rig: StereoRig, points: Array, measured: Array, T_world_left: Array, pixel_sigma: float
) -> tuple[Array, Array]:
    """Least-squares pose (4, 4) and its covariance (6, 6) from points triangulated in one earlier stereo frame.

    The points (M, 3) [m] and the guess of the pose (4, 4) are in the earlier camera's coordinates; `measured` (M, 3)
    [px] is (uL, vL, uR) in the present frame, uR NaN where there is no right pixel. Both frames have noise: a window of
    two poses, the earlier one fixed. From another viewpoint a feature is found at another point of the surface, and
    some matches are wrong, so errors may be many times as large. The residuals tell: the covariance has what the
    jackknife finds beyond that by pixel noise, how far the pose moves when one match is left out (Efron and Stein,
    Annals of Statistics 9(3), 1981). Raises LinAlgError where these points do not determine the pose.
    """
    stereo, n = RectifiedStereo.of(rig), len(points)
    z = np.concatenate([stereo.project(points)[0], measured - [0.0, 0.0, stereo.doffs]])
    rows = Rows.of(np.repeat([0, 1], n), np.tile(np.arange(n), 2), z, pixel_sigma)
    rows.root[np.tile(points[:, 2] <= 0, 2)] = 0.0  # what the earlier camera cannot have seen
    poses = np.stack([np.eye(4), T_world_left])
    solution = solve(Window(stereo, poses, points, rows, free=np.array([False, True])))
    P = solution.pose_covariance
    return solution.window.poses[1], P + covariance_growth(_jackknife(solution.window, P), P)


def _jackknife(w: Window, P: Array) -> Array:
    """Covariance (6, 6) of the second pose, P by pixel noise, by leaving out each point in turn, to first order."""
    e, n, T = linearised(w), len(w.points), w.poses[1]
    local = (w.points - T[:3, 3]) @ T[:3, :3]
    z, D = w.stereo.project(local)
    r = w.rows.z[n:] - z
    J = D @ points_by_pose(local)
    J[np.isnan(r)] = 0  # what is not measured
    r, G = (w.rows.root[n:] @ np.nan_to_num(r)[:, :, None])[:, :, 0], w.rows.root[n:] @ J
    by_pose, gain = np.swapaxes(G, 1, 2), e.cross[n:] @ e.inverse  # of a point, which is eliminated
    own = by_pose @ G - gain @ np.swapaxes(e.cross[n:], 1, 2)
    pull = by_pose @ r[:, :, None] - gain @ e.gradient[:, :, None]
    moved = np.linalg.solve(np.linalg.inv(P) - own, pull)[:, :, 0]
    return np.asarray(moved.T @ moved)


def keyframe_landmarks(keyframe: Keyframe) -> LandmarkTable:
    """A keyframe's features as landmarks of an earlier run; the id is −1 of one that was none."""
    looks, once = keyframe.descriptors.astype(np.float32), np.ones(len(keyframe), np.int64)
    return LandmarkTable(keyframe.landmarks, looks, keyframe.laplacian, once, once, 0 * once, -once)
