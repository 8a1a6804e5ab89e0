"""Tests whether a frame shows a keyframe's place: by descriptors, then by geometry, which gives pose and covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.data import StereoFeatures
from slam.geometry.pnp import measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, exp, inverse, points_by_pose, transform
from slam.mapping.atlas.config import AtlasConfig
from slam.mapping.atlas.keyframes import Keyframe
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import Matches, match_everywhere
from slam.tracks.localizer import Localizer, nowhere
from slam.tracks.table import LandmarkTable

_ROUNDS = 5  # numerics: most iterations of least squares
_CONVERGED = 1e-6  # numerics: step [rad], [m]


@dataclass(frozen=True, eq=False)
class Verified:
    """A keyframe's place, seen again.

    Attributes:
        keyframe: that shows it.
        T_keyframe_left: pose (4, 4) of the present camera in the keyframe's coordinates.
        covariance: of that pose (6, 6), perturbing on the right.
        noise: the part of the covariance (6, 6) due to pixel noise of both frames.
        matches: inliers, as rows of the keyframe's features and of the present frame's.
    """

    keyframe: Keyframe
    T_keyframe_left: Array
    covariance: Array
    noise: Array
    matches: Matches


def alike(keyframe: Keyframe, features: StereoFeatures, config: AssociationConfig) -> int:
    """Number of matches by descriptor alone between a keyframe and the present frame."""
    return len(match_everywhere(keyframe.descriptors.astype(np.float32), keyframe.laplacian, features, config))


def verify(
    keyframe: Keyframe,
    features: StereoFeatures,
    rig: StereoRig,
    localizer: Localizer,
    config: AtlasConfig,
    seed: int,
) -> Verified | None:
    """The present camera's pose relative to a keyframe; None if too few features agree, or all are in one spot.

    Args:
        keyframe: the older one.
        features: of the present frame.
        rig: the cameras.
        localizer: matches features without a prediction, and finds the inliers.
        config: settings.
        seed: of the random choice in the geometric check.
    """
    points = keyframe.points.astype(float)
    landmarks = _rows(keyframe)
    prediction = nowhere(features.stamp, np.eye(4))
    found = localizer.match(prediction, landmarks, points, features, seed)
    if found.T_world_left is None or len(found) < config.inliers:
        return None
    ids, seen = found.ids, found.rows
    across = np.linalg.eigvalsh(np.cov(features.uv_left[seen].T))[-1]
    if np.sqrt(across) < config.spread * rig.width:
        return None
    measured = measurement_rows(features.uv_left[seen], features.uv_right[seen])
    try:
        T, noise = refined_pose(rig, points[ids], measured, found.T_world_left, localizer.pixel_sigma)
    except np.linalg.LinAlgError:  # points that fix no pose, such as those of a corrupt map
        return None
    slide = 1 / rig.left.fu  # seen from another viewpoint, all features of a place shift by a pixel on the surface
    covariance = noise + np.diag(np.repeat([slide, slide * keyframe.depth], 3) ** 2)
    return Verified(keyframe, T, covariance, noise, Matches(ids.astype(np.intp), seen))


def refined_pose(
    rig: StereoRig, points: Array, measured: Array, T_world_left: Array, pixel_sigma: float
) -> tuple[Array, Array]:
    """Least-squares pose (4, 4) and its covariance (6, 6) from points triangulated in one earlier stereo frame.

    Both frames have noise: the points' covariance is propagated to the present pixels.

    Args:
        rig: the cameras.
        points: in the earlier camera's coordinates (M, 3) [m].
        measured: (uL, vL, uR) (M, 3) [px] in the present frame; uR NaN where there is no right pixel.
        T_world_left: initial guess of the present camera's pose in the earlier one's coordinates (4, 4).
        pixel_sigma: noise of uL, vL, uR [px].

    Raises:
        LinAlgError: these points do not determine the pose.
    """
    P = rig.triangulation_covariance(points, pixel_sigma)
    T, normal = T_world_left, np.eye(6)
    missing = np.isnan(measured[:, 2])
    for _ in range(_ROUNDS):
        local = transform(inverse(T), points)
        z, H = rig.project_stereo(local)
        J = H @ points_by_pose(local)
        HR = H @ T[:3, :3].T
        S, error = pixel_sigma**2 * np.eye(3) + HR @ P @ np.swapaxes(HR, 1, 2), measured - z
        J[missing, 2] = error[missing, 2] = 0
        S[missing, 2, :] = S[missing, :, 2] = [0, 0, 1]
        W = np.linalg.inv(S)
        good = np.isfinite(z).all(axis=1)
        JW = np.swapaxes(J, 1, 2)[good] @ W[good]
        normal = (JW @ J[good]).sum(axis=0)
        step = np.linalg.solve(normal, (JW @ error[good][:, :, None]).sum(axis=0)[:, 0])
        T = T @ exp(step)
        if np.abs(step).max() < _CONVERGED:
            break
    return T, np.linalg.inv(normal)


def _rows(keyframe: Keyframe) -> LandmarkTable:
    """A keyframe's features as landmarks, with their rows as ids."""
    count = len(keyframe)
    once = np.ones(count, np.int64)
    return LandmarkTable(
        np.arange(count), keyframe.descriptors.astype(np.float32), keyframe.laplacian, once, once, 0 * once, -once
    )
