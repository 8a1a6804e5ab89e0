"""Following tracks into the next frame: where each is expected, how far off it may be, and which feature it is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.distance import cdist

from slam.bodies.bodies import Body
from slam.bodies.frame import Frame
from slam.bodies.track_kernels import inverses
from slam.chi_square import SIGMAS
from slam.data import BoolArray, IndexArray
from slam.geometry.arrays import among
from slam.geometry.se3 import inverse, points_by_pose, transform
from slam.tracks import follow as features_of_tracks
from slam.tracks.table import Tracks

_UNKNOWN = 1e-6  # numerics: on a member's point that has no information yet [1/m²]
_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame
_RIGHT_SIGMAS = 4.0  # standard deviations that a right pixel may be off


def follow(tracks: Tracks, bodies: Mapping[int, Body], frame: Frame) -> None:
    """Find the features of the tracks that have none yet; sets rows, looks and misses, in place.

    A landmark that was found has its feature already. The others are looked for where their fit (or their body's
    motion) says, in windows as wide as that is uncertain. What is left, and was not known for long enough to have a
    velocity, is looked for as far off as `max_speed` allows.

    Members of bodies take over their feature's descriptor even if `slam.bodies.recovery.located` does not confirm the
    match afterwards, because the body's pose is wrong more often than the match. Members of a body that was not
    measured in the last frame keep theirs: otherwise they would take over descriptors of what occludes the body.
    Features matched with them stay available to free tracks until the body is located. Otherwise nothing that newly
    comes into view of such a body would be detected.
    """
    alive = np.flatnonzero(tracks.number >= 0)
    _advance(tracks, bodies, alive, frame.dt)
    lost = np.isin(tracks.body[alive], [body.id for body in bodies.values() if body.missed > 1])
    taken = among(len(frame.features), tracks.row[tracks.row >= 0])
    _look(tracks, frame, alive[~lost & (tracks.row[alive] < 0)], taken)
    of_lost = alive[lost]
    of_others = np.setdiff1d(np.flatnonzero(tracks.found & (tracks.body >= 0)), of_lost)
    held = among(len(taken), tracks.row[of_others])
    _far(tracks, frame, taken)
    _look(tracks, frame, of_lost[tracks.row[of_lost] < 0], held)
    found = np.flatnonzero(tracks.found)
    tracks.unfound[:] += 1
    tracks.unfound[found] = 0
    found = np.setdiff1d(found, of_lost)
    tracks.look[found] = frame.features.descriptors[tracks.row[found]]


def _advance(tracks: Tracks, bodies: Mapping[int, Body], alive: IndexArray, dt: float) -> None:
    """Where tracks are expected in this frame: positions and covariances move on, in place."""
    moves = alive[(tracks.body[alive] < 0) & tracks.velocity[alive].any(axis=1)]
    tracks.position[moves] += dt * tracks.velocity[moves]
    tracks.covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        R, J = body.T[:3, :3], points_by_pose(tracks.local[mine])
        own = inverses(tracks.local_information[mine], 0.0, _UNKNOWN)
        spread = own + J @ body.covariance @ np.swapaxes(J, 1, 2)
        tracks.position[mine], tracks.covariance[mine] = transform(body.T, tracks.local[mine]), R @ spread @ R.T


def _look(tracks: Tracks, frame: Frame, rows: IndexArray, taken: BoolArray) -> None:
    """Look for tracks (M,) where they are expected, among features that are not `taken` (N,); these are then."""
    if not len(rows):
        return
    s, c, f, T = frame.setup, frame.setup.config, frame.features, frame.T_world_left
    places = tracks.position[rows]
    z, J = s.rig.project_stereo(transform(inverse(T), places))
    G = J @ T[:3, :3].T
    S = G @ tracks.covariance[rows] @ np.swapaxes(G, 1, 2) + s.sigma**2 * np.eye(3)
    least = np.where(tracks.doubtful[rows], 0.5 * c.search_limit, c.search_radius)
    windows = features_of_tracks.Windows((SIGMAS,), (c.d_match,), c.ratio, c.search_limit, least)
    looks = tracks.look[rows], tracks.laplacian[rows]
    found = features_of_tracks.follow(z[:, :2], S[:, :2, :2], *looks, f, windows, taken)
    m, row = found.tracks, found.features
    # A right pixel off by more says that this is another point, or a false stereo match.
    depth = np.maximum((places[m] - T[:3, 3]) @ T[:3, 2], 1e-3)
    uneven = np.where(tracks.count(rows[m]) < c.min_frames, 1.0, _UNEVEN)
    deviation = np.sqrt(np.maximum(S[m, 2, 2], s.sigma**2))  # rounding may leave a covariance that is not definite
    allowance = _RIGHT_SIGMAS * deviation + uneven * c.max_speed * frame.dt * s.rig.left.fu / depth
    good = ~(np.abs(f.uv_right[row, 0] - z[m, 2]) > allowance)  # NaN compares false
    tracks.find(rows[m[good]], row[good])
    taken[row[good]] = True


def _far(tracks: Tracks, frame: Frame, taken: BoolArray) -> None:
    """Look for tracks without a velocity yet as far off as `max_speed` allows, in features not `taken` (N,)."""
    s, c = frame.setup, frame.setup.config
    left = np.flatnonzero((tracks.number >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.unfound == 0))
    left = left[tracks.count(left) <= c.min_frames]
    free = np.flatnonzero(~taken & np.isfinite(frame.local[:, 0]))
    if not len(left) or not len(free):
        return
    local = frame.local[free]
    deviation = np.sqrt(2.0) * s.depth_noise(local[:, 2])
    unknown = SIGMAS * np.sqrt(np.einsum("nii->n", tracks.covariance[left])[:, None] + deviation**2)
    away = cdist(tracks.position[left], transform(frame.T_world_left, local))
    allowed = away < c.max_speed * frame.dt + unknown
    looks, features = (tracks.look[left], tracks.laplacian[left]), frame.features.select(free)
    found = features_of_tracks.match_everywhere(*looks, features, c.wide_d_match, c.wide_ratio, allowed)
    tracks.find(left[found.tracks], free[found.features])
