"""Following tracks into the next frame, and bodies: by their members, and by a search where they were lost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam.bodies.belief import BodyBelief
from slam.bodies.bodies import Body, of_bodies
from slam.bodies.body_kernels import place_members
from slam.bodies.config import MIN_FRAMES, MIN_POINTS
from slam.bodies.estimator import BodyEstimator
from slam.bodies.frame import Frame
from slam.bodies.track_kernels import expected_pixels
from slam.chi_square import SIGMAS
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import among, isin
from slam.geometry.rig import MINIMAL_POINTS, measurement_rows
from slam.geometry.se3 import Array, inverse, transform
from slam.object_data import ObjectObservations
from slam.tracks import follow as features_of_tracks
from slam.tracks.follow import ALIKE, match_everywhere
from slam.tracks.table import Tracks
from slam.window.consensus import find_consensus
from slam.window.gating import MIN_CONSENSUS

_SEARCH = 4.0, 25.0  # least and largest half size of the search windows of tracks [px]
_UNKNOWN = 1e-6  # numerics: on a member's point that has no information yet [1/m²]
_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame
_POSES = 200  # cost: poses of a body that are tried where its place is not known
_RIGHT_SIGMAS = 4.0  # standard deviations that a right pixel may be off


def follow(tracks: Tracks, bodies: Mapping[int, Body], frame: Frame) -> None:
    """Find the features of the tracks that have none yet; sets rows, looks and misses, in place.

    Tracks are looked for where their fit, or their body's motion, says, in windows as wide as that is uncertain; then
    those too young to have a velocity as far off as `max_speed` allows. Members of a body that was not measured in the
    last frame keep their descriptors, which would else become those of what occludes the body, and leave the features
    that they match to free tracks: they may newly come into view. Those of a body that is gone are not looked for here,
    see `found_again`.
    """
    alive = np.flatnonzero(tracks.number >= 0)
    _advance(tracks, bodies, alive, frame.dt)
    lost = of_bodies(tracks, (body for body in bodies.values() if body.missed > 1))
    gone = of_bodies(tracks, (body for body in bodies.values() if body.gone))
    taken = among(len(frame.local), tracks.row[tracks.row >= 0])
    _look(tracks, frame, alive[(~lost & (tracks.row < 0))[alive]], taken)
    held = among(len(taken), tracks.row[tracks.found & (tracks.body >= 0) & ~lost])
    _far(tracks, frame, taken)
    _look(tracks, frame, np.flatnonzero(lost & ~gone & (tracks.row < 0)), held)
    tracks.unfound[:] = np.where(tracks.found, 0, tracks.unfound + 1)
    seen = np.flatnonzero(tracks.found & ~lost)
    tracks.look[seen] = frame.features.descriptors[tracks.row[seen]]


def _advance(tracks: Tracks, bodies: Mapping[int, Body], alive: IndexArray, dt: float) -> None:
    """Where tracks are expected in this frame: positions and covariances move on, in place."""
    moves = alive[(tracks.body[alive] < 0) & tracks.velocity[alive].any(axis=1)]
    tracks.position[moves] += dt * tracks.velocity[moves]
    tracks.covariance[moves] += dt**2 * tracks.velocity_covariance[moves]
    for body in bodies.values():
        mine = np.flatnonzero(tracks.body == body.id)
        t = tracks
        place_members(body.T, body.covariance, t.local, t.local_information, mine, _UNKNOWN, t.position, t.covariance)


def _look(tracks: Tracks, frame: Frame, rows: IndexArray, taken: BoolArray) -> None:
    """Look for tracks (M,) where they are expected, among features that are not `taken` (N,); these are then."""
    if not len(rows):
        return
    s, c, f, T = frame.setup, frame.setup.config, frame.features, frame.T_world_left
    t, reach = tracks, c.max_speed * frame.dt * s.rig.left.fu
    z, S, allowance = expected_pixels(
        s.rig.rectified_parameters, T, t.position, t.covariance, t.dof, rows, s.sigma, _RIGHT_SIGMAS, MIN_FRAMES,
        (reach, _UNEVEN * reach),
    )  # fmt: skip
    least = np.where(tracks.doubtful[rows], 0.5 * _SEARCH[1], _SEARCH[0])
    windows = features_of_tracks.Windows((SIGMAS,), (ALIKE[0],), ALIKE[1], _SEARCH[1], least)
    looks = tracks.look[rows], tracks.laplacian[rows]
    found = features_of_tracks.follow(z[:, :2], S[:, :2, :2], *looks, f, windows, taken)
    m, row = found.tracks, found.features
    # A right pixel off by more says that this is another point, or a false stereo match; NaN compares false.
    good = ~(np.abs(f.uv_right[row, 0] - z[m, 2]) > allowance[m])
    tracks.set_features(rows[m[good]], row[good])
    taken[row[good]] = True


def _far(tracks: Tracks, frame: Frame, taken: BoolArray) -> None:
    """Look for tracks without a velocity yet as far off as `max_speed` allows, in features not `taken` (N,)."""
    s, c = frame.setup, frame.setup.config
    left = np.flatnonzero((tracks.number >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.unfound == 0))
    left = left[tracks.count(left) <= MIN_FRAMES]
    if not len(left):
        return
    points = transform(frame.T_world_left, np.where(taken[:, None], np.nan, frame.local))
    places, variances = tracks.position[left], np.einsum("nii->n", tracks.covariance[left])
    found = features_of_tracks.match_near(
        tracks.look[left], tracks.laplacian[left], places, variances, frame.features, points,
        2.0 * s.depth_noise(frame.local[:, 2]) ** 2, (c.max_speed * frame.dt, SIGMAS), *ALIKE,
    )  # fmt: skip
    tracks.set_features(left[found.tracks], found.features)


def located(body: Body, tracks: Tracks, frame: Frame, estimator: BodyEstimator) -> BodyBelief | None:
    """What is believed of a body after this frame, by its tracks that are seen; None for nothing.

    Tracks that the estimate used keep their features, and no free track has these, in place. The others are counted as
    misfits, but followed on: they may lie on a part that moves otherwise, such as a lid.
    """
    mine = np.flatnonzero((tracks.body == body.id) & tracks.found)
    # any two points agree with a pose of a body that may be half its width off, any three if it may be anywhere
    off = body.off / body.across
    least = MIN_POINTS if off > 1.0 else MINIMAL_POINTS if off > 0.5 else 1
    seen = observed(body, tracks, mine, frame.features)
    belief = estimator.updated(body.belief, body.id, seen, frame.cameras, least)
    rows = tracks.row[mine]
    tracks.row[mine] = -1
    if belief is None or not belief.estimate.measured:
        return belief
    agrees = isin(tracks.number[mine], belief.estimate.used)
    tracks.misfit[mine] = np.where(agrees, 0, tracks.misfit[mine] + 1)
    _take_from_free(tracks, rows[agrees])
    left = agrees | ~among(len(frame.local), tracks.row[tracks.found])[rows]
    tracks.row[mine[left]] = rows[left]
    tracks.look[mine[agrees]] = frame.features.descriptors[rows[agrees]]
    return belief


def found_again(body: Body, tracks: Tracks, frame: Frame) -> Array | None:
    """The pose (4, 4) of a body whose place is no longer known, None where it is not seen.

    Its members are recognised by their descriptors, wherever they are. Most of those must agree on one pose of it, and
    as many as tell it from chance, no farther off than `max_speed` allows; they have their features then, in place.
    """
    s, f = frame.setup, frame.features
    mine = np.flatnonzero(tracks.body == body.id)
    free = np.flatnonzero(~among(len(f), tracks.row[tracks.found & (tracks.body >= 0)]))
    matches = match_everywhere(tracks.look[mine], tracks.laplacian[mine], f.select(free), *ALIKE)
    rows, seen = mine[matches.tracks], free[matches.features]
    z, guess = measurement_rows(f.uv_left[seen], f.uv_right[seen]), inverse(body.T) @ frame.T_world_left
    found = find_consensus(s.rig, tracks.local[rows], z, guess, SIGMAS * s.sigma, _POSES, 0)
    if found.inliers.sum() < max(MIN_CONSENSUS, (len(rows) + 1) // 2):
        return None
    T, middle = frame.T_world_left @ inverse(found.T_world_left), tracks.local[rows[found.inliers]].mean(axis=0)
    reach = body.across + s.config.max_speed * (f.stamp - body.seen_at)
    if np.linalg.norm(transform(T, middle) - transform(body.T, middle)) > reach:
        return None
    rows, seen = rows[found.inliers], seen[found.inliers]
    _take_from_free(tracks, seen)
    tracks.row[rows], tracks.misfit[rows], tracks.unfound[rows] = seen, 0, 0
    tracks.look[rows] = f.descriptors[seen]
    return np.asarray(T)


def _take_from_free(tracks: Tracks, features: IndexArray) -> None:
    """Features (K,) are a body's: free tracks that have them are given up, in place."""
    taken = among(int(max(tracks.row.max(), features.max(initial=0))) + 1, features)
    tracks.give_up(np.flatnonzero((tracks.body < 0) & tracks.found & taken[tracks.row]))


def observed(body: Body, tracks: Tracks, mine: IndexArray, features: StereoFeatures) -> ObjectObservations:
    """A body's seen tracks (K,), and where it is thought to be."""
    order = mine[np.argsort(tracks.number[mine])]
    rows = tracks.row[order]
    return ObjectObservations(
        body.id, tracks.number[order], features.uv_left[rows], features.uv_right[rows], body.T, body.velocity,
        np.sqrt(body.velocity_covariance.diagonal()),
    )  # fmt: skip
