"""Following tracks into the next frame, and bodies: by their members, and by a search where they were lost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.distance import cdist

from slam.bodies.belief import BodyBelief
from slam.bodies.bodies import Body
from slam.bodies.config import MIN_FRAMES, MIN_POINTS
from slam.bodies.estimator import BodyEstimator
from slam.bodies.fits import AGREES
from slam.bodies.frame import Frame
from slam.bodies.track_kernels import inverses
from slam.chi_square import SIGMAS
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import among
from slam.geometry.rig import measurement_rows
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.object_data import ObjectObservations
from slam.tracks import follow as features_of_tracks
from slam.tracks.follow import match_everywhere
from slam.tracks.table import Tracks
from slam.window.consensus import find_consensus

_SEARCH = 4.0, 25.0  # least and largest half size of the search windows of tracks [px]
_ALIKE = 0.5, 0.8  # largest descriptor distance, and its largest ratio to the second best
_UNKNOWN = 1e-6  # numerics: on a member's point that has no information yet [1/m²]
_UNEVEN = 0.3  # share of `max_speed` by which a speed may change from frame to frame
_RIGHT_SIGMAS = 4.0  # standard deviations that a right pixel may be off
_SIGMAS = 5.0  # a point agrees with the fit up to so many pixel sigmas
_HYPOTHESES = 60  # cost: poses tried for a body that is found again
_DEPTHS = 0.2  # share of the depth by which stereo may be off


def follow(tracks: Tracks, bodies: Mapping[int, Body], frame: Frame) -> None:
    """Find the features of the tracks that have none yet; sets rows, looks and misses, in place.

    Tracks are looked for where their fit, or their body's motion, says, in windows as wide as that is uncertain; then
    those too young to have a velocity as far off as `max_speed` allows. Members of a body that was not measured in the
    last frame keep their descriptors, which would else become those of what occludes the body, and leave the features
    that they match to free tracks: they may newly come into view.
    """
    alive = np.flatnonzero(tracks.number >= 0)
    _advance(tracks, bodies, alive, frame.dt)
    lost = np.isin(tracks.body[alive], [body.id for body in bodies.values() if body.missed > 1])
    taken = among(len(frame.local), tracks.row[tracks.row >= 0])
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
    least = np.where(tracks.doubtful[rows], 0.5 * _SEARCH[1], _SEARCH[0])
    windows = features_of_tracks.Windows((SIGMAS,), (_ALIKE[0],), _ALIKE[1], _SEARCH[1], least)
    looks = tracks.look[rows], tracks.laplacian[rows]
    found = features_of_tracks.follow(z[:, :2], S[:, :2, :2], *looks, f, windows, taken)
    m, row = found.tracks, found.features
    # A right pixel off by more says that this is another point, or a false stereo match.
    depth = np.maximum((places[m] - T[:3, 3]) @ T[:3, 2], 1e-3)
    uneven = np.where(tracks.count(rows[m]) < MIN_FRAMES, 1.0, _UNEVEN)
    deviation = np.sqrt(np.maximum(S[m, 2, 2], s.sigma**2))  # rounding may leave a covariance that is not definite
    allowance = _RIGHT_SIGMAS * deviation + uneven * c.max_speed * frame.dt * s.rig.left.fu / depth
    good = ~(np.abs(f.uv_right[row, 0] - z[m, 2]) > allowance)  # NaN compares false
    tracks.set_features(rows[m[good]], row[good])
    taken[row[good]] = True


def _far(tracks: Tracks, frame: Frame, taken: BoolArray) -> None:
    """Look for tracks without a velocity yet as far off as `max_speed` allows, in features not `taken` (N,)."""
    s, c = frame.setup, frame.setup.config
    left = np.flatnonzero((tracks.number >= 0) & (tracks.row < 0) & (tracks.body < 0) & (tracks.unfound == 0))
    left = left[tracks.count(left) <= MIN_FRAMES]
    free = np.flatnonzero(~taken & np.isfinite(frame.local[:, 0]))
    if not len(left) or not len(free):
        return
    local = frame.local[free]
    deviation = np.sqrt(2.0) * s.depth_noise(local[:, 2])
    unknown = SIGMAS * np.sqrt(np.einsum("nii->n", tracks.covariance[left])[:, None] + deviation**2)
    away = cdist(tracks.position[left], transform(frame.T_world_left, local))
    allowed = away < c.max_speed * frame.dt + unknown
    looks, features = (tracks.look[left], tracks.laplacian[left]), frame.features.select(free)
    found = features_of_tracks.match_everywhere(*looks, features, *_ALIKE, allowed)
    tracks.set_features(left[found.tracks], free[found.features])


def located(body: Body, tracks: Tracks, frame: Frame, estimator: BodyEstimator) -> BodyBelief | None:
    """What is believed of a body after this frame, by its tracks that are seen, or found again; None for nothing.

    Tracks that the estimate did not use are counted as misfits, in place, but followed on: they may lie on a part that
    moves otherwise, such as a lid.
    """
    features = frame.features
    members = np.flatnonzero(tracks.body == body.id)
    mine = members[tracks.found[members]]
    rows = tracks.row[mine]

    def estimated(mine: IndexArray, rows: IndexArray, T: Array | None = None) -> BodyBelief | None:
        return estimator.updated(body.belief, body.id, observed(body, tracks, mine, rows, features, T), frame.cameras)

    def agreeing(belief: BodyBelief | None) -> int:
        return len(belief.estimate.used) if belief is not None and belief.estimate.measured else 0

    asked = slice(None) if _is_expected(body) else slice(0)  # else any two points agree with one of its poses
    belief = estimated(mine[asked], rows[asked])
    if 2 * agreeing(belief) < len(mine) or not len(mine):
        for some, theirs in ((mine, rows), _by_descriptors(body, tracks, members, frame)):
            fit = _fit(body, tracks, some, theirs, frame)
            if fit is None or fit[1].sum() <= agreeing(belief):
                continue
            T = np.asarray(frame.T_world_left @ inverse(fit[0]))
            if not _is_within_reach(body, T, frame):
                continue
            again = estimated(some[fit[1]], theirs[fit[1]], T)
            if agreeing(again) > agreeing(belief):
                belief, mine, rows = again, some, theirs
    followed = tracks.row[members]
    tracks.row[members] = -1
    if belief is None or not belief.estimate.measured:
        return belief
    agrees = np.isin(tracks.number[mine], belief.estimate.used)
    taken = among(len(features), tracks.row[tracks.found])
    tracks.row[members] = np.where(taken[followed], -1, followed)  # those that were not seen stay at −1
    tracks.misfit[mine] = np.where(agrees, 0, tracks.misfit[mine] + 1)
    good, matched = mine[agrees], rows[agrees]
    measured_now = among(len(features), matched)
    tracks.row[members[measured_now[followed] & (followed >= 0)]] = -1
    free = np.flatnonzero((tracks.body < 0) & tracks.found)
    tracks.give_up(free[measured_now[tracks.row[free]]])
    tracks.row[good], tracks.unfound[good] = matched, 0
    tracks.look[good] = features.descriptors[matched]
    return belief


def observed(
    body: Body, tracks: Tracks, mine: IndexArray, rows: IndexArray, features: StereoFeatures,
    T: Array | None = None,
) -> ObjectObservations:  # fmt: skip
    """A body's tracks (K,) as the features of these rows, with a guess of its pose (4, 4) where there is one."""
    order = np.argsort(tracks.number[mine])
    rows = rows[order]
    return ObjectObservations(
        body.id, tracks.number[mine[order]], features.uv_left[rows], features.uv_right[rows], T, body.velocity,
        np.sqrt(body.velocity_covariance.diagonal()),
    )  # fmt: skip


def _is_within_reach(body: Body, T: Array, frame: Frame) -> bool:
    """Whether a body that is found again at a pose (4, 4) can have gone there from where it was predicted."""
    R, view = body.T[:3, :3], frame.T_world_left[:3, :3]
    local = transform(inverse(frame.T_world_left), T[None, :3, 3])
    noise = frame.setup.rig.triangulation_covariance(local, frame.setup.sigma)[0]
    gap = T[:3, 3] - body.T[:3, 3]
    return bool(gap @ np.linalg.solve(R @ body.covariance[3:, 3:] @ R.T + view @ noise @ view.T, gap) < AGREES)


def _is_expected(body: Body) -> bool:
    """Whether it is known where the body is to within what it measures across."""
    return bool(np.trace(body.covariance[3:, 3:]) <= body.across**2)


def _fit(
    body: Body, tracks: Tracks, mine: IndexArray, rows: IndexArray, frame: Frame
) -> tuple[Array, BoolArray] | None:
    """Pose T_body_left, and which tracks agree with it as the features of these rows."""
    if len(mine) < MIN_POINTS:
        return None
    rig, limit = frame.setup.rig, _SIGMAS * frame.setup.sigma
    z = measurement_rows(frame.features.uv_left[rows], frame.features.uv_right[rows])
    guess = inverse(body.T) @ frame.T_world_left
    fit = find_consensus(rig, tracks.local[mine], z, guess, limit, _HYPOTHESES, frame.number)
    stereo = np.isfinite(z[fit.inliers, 2])
    return None if stereo.sum() < MIN_POINTS else (fit.T_world_left, fit.inliers)


def _by_descriptors(body: Body, tracks: Tracks, mine: IndexArray, frame: Frame) -> tuple[IndexArray, IndexArray]:
    """Members matched by descriptor, and the features' rows, no farther off than the body can have gone.

    Features of free tracks may be matched, too: such tracks may have started on the body's points.
    """
    features, c = frame.features, frame.setup.config
    taken = among(len(features), tracks.row[tracks.found & (tracks.body >= 0) & (tracks.body != body.id)])
    free = np.flatnonzero(~taken & np.isfinite(frame.local[:, 0]))
    if len(mine) < MIN_POINTS or len(free) < MIN_POINTS:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    local = frame.local[free]
    away = np.linalg.norm(transform(frame.T_world_left, local) - body.T[:3, 3], axis=1)
    reach = c.max_speed * max(features.stamp - body.seen_at, 0.1) + float(np.linalg.norm(body.upper - body.lower))
    allowed = np.broadcast_to(away < reach + _DEPTHS * np.abs(local[:, 2]), (len(mine), len(free)))
    found = match_everywhere(tracks.look[mine], tracks.laplacian[mine], features.select(free), *_ALIKE, allowed)
    return mine[found.tracks], free[found.features]
