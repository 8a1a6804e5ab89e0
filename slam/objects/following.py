"""Following tracks into the next frame: where each is expected, how far off it may be, and which feature it is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam.data import StereoFeatures
from slam.objects.bodies import Body
from slam.objects.config import ObjectsConfig
from slam.objects.matching import match_far, match_near
from slam.objects.measurement import View, predict
from slam.objects.tracks import MOVES, Tracks
from slam.rig import StereoRig
from slam.se3 import Array, hat, transform

_SIGMAS = 3.0


def follow(
    tracks: Tracks,
    bodies: Mapping[int, Body],
    view: View,
    features: StereoFeatures,
    dt: float,
    rig: StereoRig,
    sigma: float,
    config: ObjectsConfig,
) -> None:
    """Find each track's feature in this frame; sets rows, descriptors and misses, in place.

    Tracks are looked for where their fit (or their body's motion) says, in windows as wide as that is uncertain. What
    is left, and was not known for long enough to have a velocity, is looked for as far as `max_speed` allows.
    """
    tracks.row[:] = -1
    if len(tracks) and len(features):
        points, covariance = expected_points(tracks, bodies, dt)
        expected = predict(rig, view, points, sigma)
        spread = expected.S + expected.J @ covariance @ np.swapaxes(expected.J, 1, 2)
        _near(tracks, features, expected.z, spread, config)
        _check_right(tracks, features, expected.z, spread, points, dt, view, config, rig)
        _far(tracks, features, points, dt, view, config, rig, sigma)
    seen = tracks.seen
    tracks.descriptors[seen] = features.descriptors[tracks.row[seen]]
    tracks.missed[:] = np.where(seen, 0, tracks.missed + 1)


def expected_points(tracks: Tracks, bodies: Mapping[int, Body], dt: float) -> tuple[Array, Array]:
    """World positions (N, 3) of all tracks in the next frame, and their covariances (N, 3, 3).

    The free tracks' positions move on, in place.
    """
    free = tracks.body < 0
    moves = free & (tracks.test > MOVES)
    tracks.position[moves] += dt * tracks.velocity[moves]
    covariance = tracks.covariance.copy()
    covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    points = tracks.position.copy()
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        points[mine] = transform(body.T, tracks.local[mine])
        R = body.T[:3, :3]
        J = R @ np.concatenate([-hat(tracks.local[mine]), np.broadcast_to(np.eye(3), (len(mine), 3, 3))], axis=2)
        own = np.linalg.inv(tracks.local_information[mine] + 1e-6 * np.eye(3))
        covariance[mine] = J @ body.covariance @ np.swapaxes(J, 1, 2) + R @ own @ R.T
    return points, covariance


def _near(tracks: Tracks, features: StereoFeatures, z: Array, spread: Array, config: ObjectsConfig) -> None:
    size = _SIGMAS * np.sqrt(np.maximum(spread[:, 0, 0], spread[:, 1, 1]))
    least = np.where(tracks.doubtful | tracks.moving, 0.5 * config.search_limit, config.search_radius)
    radius = np.clip(np.nan_to_num(size), least, config.search_limit)
    rows, columns = match_near(
        z[:, :2], radius, tracks.descriptors, tracks.laplacian, features, config.d_match, config.ratio
    )
    tracks.row[rows] = columns


def _check_right(
    tracks: Tracks, features: StereoFeatures, z: Array, spread: Array, points: Array, dt: float, view: View,
    config: ObjectsConfig, rig: StereoRig,
) -> None:  # fmt: skip
    """Drop matches whose right pixel says that it is another point, or a false stereo match."""
    rows = np.flatnonzero(tracks.seen)
    right = features.uv_right[tracks.row[rows], 0]
    away = np.abs(right - z[rows, 2])
    depth = np.maximum(((points[rows] - view.T_frame_left[:3, 3]) @ view.T_frame_left[:3, 2]), 1e-3)
    allowance = 0.3 * config.max_speed * dt * rig.left.fu / depth
    young = tracks.count[rows] < config.min_frames
    allowance *= np.where(young, 3.0, 1.0)
    bad = away > 4 * np.sqrt(spread[rows, 2, 2]) + allowance  # NaN compares false
    tracks.row[rows[bad]] = -1


def _far(
    tracks: Tracks, features: StereoFeatures, points: Array, dt: float, view: View, config: ObjectsConfig,
    rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for tracks without a velocity yet anywhere that `max_speed` allows."""
    reach = config.max_speed * dt
    lost = (tracks.row < 0) & (tracks.body < 0) & (tracks.missed == 0) & (tracks.count <= config.min_frames)
    left = np.flatnonzero(lost)
    taken = np.zeros(len(features), bool)
    taken[tracks.row[tracks.seen]] = True
    free = np.flatnonzero(~taken & features.has_stereo)
    if not len(left) or not len(free):
        return
    local = rig.triangulate(features.uv_left[free], features.uv_right[free])
    found = transform(view.T_frame_left, local)
    noise = rig.triangulation_covariance(local, sigma)[:, 2, 2]
    own = np.trace(tracks.covariance[left], axis1=1, axis2=2)
    gap = np.linalg.norm(points[left][:, None] - found[None], axis=2)
    with np.errstate(invalid="ignore"):
        allowed = gap < reach + 3 * np.sqrt(own[:, None] + noise[None])
    rows, columns = match_far(
        tracks.descriptors[left], tracks.laplacian[left], features, free, allowed, config.wide_d_match,
        config.wide_ratio,
    )  # fmt: skip
    tracks.row[left[rows]] = columns
