"""Following tracks into the next frame: where each is expected, how far off it may be, and which feature it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from slam.chi_square import SIGMAS
from slam.data import StereoFeatures
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.objects.bodies import Body
from slam.objects.candidates import Candidate, region_radius
from slam.objects.config import ObjectsConfig
from slam.objects.matching import ByLine, match_far, match_near
from slam.objects.pixel_kernels import pixel_deviations
from slam.objects.track_kernels import members_ahead
from slam.objects.tracks import LEAST_INFORMATION, Tracks

_RIGHT_SIGMAS = 4.0  # standard deviations that a right pixel may be off
_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame


def follow(
    tracks: Tracks,
    bodies: Mapping[int, Body],
    candidates: Sequence[Candidate],
    T_world_left: Array,
    features: StereoFeatures,
    measured: Array,
    dt: float,
    rig: StereoRig,
    sigma: float,
    config: ObjectsConfig,
) -> None:
    """Find each track's feature in this frame; sets rows, descriptors and misses, in place.

    Members of bodies take over their feature's descriptor even if `slam.objects.recovery.locate` does not confirm the
    match afterwards, because the body's pose is wrong more often than the match. Members of a body that was not
    measured in the last frame keep theirs: otherwise they would take over descriptors of what occludes the body.

    Tracks are looked for where their fit (or their body's motion) says, in windows as wide as that is uncertain. What
    is left, and was not known for long enough to have a velocity, is looked for where the body or the candidate takes
    it on which it lies, and then as far as `max_speed` allows.
    Features matched with members of a body that was not measured in the last frame stay available to free tracks until
    the body is located. Otherwise nothing that newly comes into view of such a body would be detected.
    `measured` are the features' points in camera coordinates (N, 3), NaN where there is no depth.
    """
    tracks.row[:] = -1
    alive = np.flatnonzero(tracks.ids >= 0)
    _advance(tracks, bodies, alive, dt)
    lost = np.isin(tracks.body[alive], [body.id for body in bodies.values() if body.missed > 1])
    if len(alive) and len(features):
        among = ByLine.of(features)
        _expected(tracks, alive[~lost], T_world_left, among, dt, config, rig, sigma)
        held = tracks.row[tracks.seen & (tracks.body >= 0)]
        _carried_along(tracks, bodies, candidates, T_world_left, among, dt, config, rig, sigma)
        _far(tracks, T_world_left, features, measured, dt, config, rig, sigma)
        if lost.any():
            unclaimed = alive[lost]
            _expected(tracks, unclaimed, T_world_left, among, dt, config, rig, sigma)
            tracks.row[unclaimed[np.isin(tracks.row[unclaimed], held)]] = -1
    seen = tracks.seen
    tracks.missed[:] = np.where(seen, 0, tracks.missed + 1)
    seen[alive[lost]] = False
    tracks.descriptors[seen] = features.descriptors[tracks.row[seen]]


def _advance(tracks: Tracks, bodies: Mapping[int, Body], alive: NDArray[np.intp], dt: float) -> None:
    """Where tracks are expected in this frame: positions and covariances move on, in place."""
    moves = alive[(tracks.body[alive] < 0) & tracks.velocity[alive].any(axis=1)]
    tracks.position[moves] += dt * tracks.velocity[moves]
    tracks.covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        tracks.position[mine], tracks.covariance[mine] = members_ahead(
            tracks.local, tracks.local_information, mine, body.T, body.covariance, LEAST_INFORMATION
        )


def _expected(
    tracks: Tracks, alive: NDArray[np.intp], T_world_left: Array, among: ByLine, dt: float, config: ObjectsConfig,
    rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for tracks where their fit or their body's motion says."""
    local = (tracks.position[alive] - T_world_left[:3, 3]) @ T_world_left[:3, :3]
    z, J = rig.project_stereo(local)
    spread = pixel_deviations(J, T_world_left, tracks.covariance, alive, sigma)
    size = SIGMAS * np.maximum(spread[:, 0], spread[:, 1])
    least = np.where(tracks.doubtful[alive], 0.5 * config.search_limit, config.search_radius)
    radius = np.fmin(np.fmax(size, least), config.search_limit)  # the least where the size is NaN
    rows, columns = match_near(
        z[:, :2], radius, tracks.descriptors[alive], tracks.laplacian[alive], among, config.d_match, config.ratio
    )
    tracks.row[alive[rows]] = columns
    _check_right(tracks, alive, among.features, z[:, 2], spread[:, 2], local[:, 2], dt, config, rig)


def _check_right(
    tracks: Tracks, alive: NDArray[np.intp], features: StereoFeatures, expected: Array, spread: Array, depth: Array,
    dt: float, config: ObjectsConfig, rig: StereoRig,
) -> None:  # fmt: skip
    """Drop matches whose right pixel says that it is another point, or a false stereo match."""
    seen = np.flatnonzero(tracks.seen[alive])
    rows = alive[seen]
    away = np.abs(features.uv_right[tracks.row[rows], 0] - expected[seen])
    allowance = _UNEVEN * config.max_speed * dt * rig.left.fu / np.maximum(depth[seen], 1e-3)
    allowance *= np.where(tracks.count(rows) < config.min_frames, 1.0 / _UNEVEN, 1.0)
    tracks.row[rows[away > _RIGHT_SIGMAS * spread[seen] + allowance]] = -1  # NaN compares false


def _carried_along(
    tracks: Tracks, bodies: Mapping[int, Body], candidates: Sequence[Candidate], T_world_left: Array,
    among: ByLine, dt: float, config: ObjectsConfig, rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for young tracks on what moves where it takes them."""
    young = _young(tracks, config.min_frames - 1)
    places = tracks.position[young]
    for body in bodies.values():
        size = config.margin * body.across
        local = transform(inverse(body.T_before), places)
        on = ((local > body.lower - size) & (local < body.upper + size)).all(axis=1)
        R = body.T[:3, :3]
        ahead = transform(body.T, local[on])
        spread = R @ body.covariance[3:, 3:] @ R.T
        _look_at(tracks, young[on], ahead, spread, T_world_left, among, dt, config, rig, sigma)
    if not len(young) or not candidates:
        return
    middles = np.array([candidate.state[:3] for candidate in candidates])
    radius = region_radius(np.linalg.norm(middles - T_world_left[:3, 3], axis=1), config.size)
    inside = np.linalg.norm(places - middles[:, None], axis=2) < radius[:, None]
    for i in np.flatnonzero(inside.any(axis=1)).tolist():
        on, state, P = inside[i], candidates[i].state, candidates[i].covariance
        ahead = places[on] + dt * state[3:]
        _look_at(tracks, young[on], ahead, dt**2 * P[3:, 3:], T_world_left, among, dt, config, rig, sigma)


def _look_at(
    tracks: Tracks, rows: NDArray[np.intp], ahead: Array, covariance: Array, T_world_left: Array,
    among: ByLine, dt: float, config: ObjectsConfig, rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for unseen tracks (M,) about places (M, 3) that have a covariance (3, 3), in features not taken yet."""
    unseen = tracks.row[rows] < 0
    rows, ahead, features = rows[unseen], ahead[unseen], among.features
    if not len(rows):
        return
    taken = np.zeros(len(features), bool)
    taken[tracks.row[tracks.seen]] = True
    local = (ahead - T_world_left[:3, 3]) @ T_world_left[:3, :3]
    z, J = rig.project_stereo(local)
    spread = pixel_deviations(J, T_world_left, tracks.covariance[rows] + covariance, np.arange(len(rows)), sigma)
    size = SIGMAS * np.maximum(spread[:, 0], spread[:, 1])
    radius = np.fmin(np.fmax(size, config.search_radius), config.search_limit)
    mine, columns = match_near(
        z[:, :2], radius, tracks.descriptors[rows], tracks.laplacian[rows], among, config.d_match, config.ratio
    )
    free = ~taken[columns]
    tracks.row[rows[mine[free]]] = columns[free]
    _check_right(tracks, rows, features, z[:, 2], spread[:, 2], local[:, 2], dt, config, rig)


def _young(tracks: Tracks, most: int) -> NDArray[np.intp]:
    """Free tracks that were seen in the last frame, not in this, with no more measurements than `most`."""
    lost = np.flatnonzero((tracks.ids >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.missed == 0))
    return np.asarray(lost[tracks.count(lost) <= most])


def _far(
    tracks: Tracks, T_world_left: Array, features: StereoFeatures, measured: Array, dt: float, config: ObjectsConfig,
    rig: StereoRig, sigma: float,
) -> None:  # fmt: skip
    """Look for tracks without a velocity yet anywhere that `max_speed` allows."""
    left = _young(tracks, config.min_frames)
    taken = np.zeros(len(features), bool)
    taken[tracks.row[tracks.seen]] = True
    free = np.flatnonzero(~taken & np.isfinite(measured[:, 0]))
    if not len(left) or not len(free):
        return
    local = measured[free]
    found = transform(T_world_left, local)
    deviation = local[:, 2] ** 2 * np.sqrt(2.0) * sigma / (rig.left.fu * rig.baseline)
    own = np.trace(tracks.covariance[left], axis1=1, axis2=2)
    start = tracks.position[left]
    squares = (start**2).sum(axis=1)[:, None] + (found**2).sum(axis=1) - 2 * start @ found.T
    allowed = squares < (config.max_speed * dt + SIGMAS * np.sqrt(own[:, None] + deviation**2)) ** 2
    rows, columns = match_far(
        tracks.descriptors[left], tracks.laplacian[left], features, free, allowed, config.wide_d_match,
        config.wide_ratio,
    )  # fmt: skip
    tracks.row[left[rows]] = columns
