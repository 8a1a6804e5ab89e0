"""Where a body is in this frame: by its estimate, and by the search for it where it was lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.bodies.belief import BodyBelief
from slam.bodies.bodies import Body
from slam.bodies.estimator import BodyEstimator
from slam.bodies.fits import AGREES
from slam.bodies.frame import Frame
from slam.bodies.points import MIN_POINTS
from slam.data import BoolArray, StereoFeatures
from slam.geometry.arrays import among
from slam.geometry.pnp import measurement_rows
from slam.geometry.se3 import Array, inverse, transform
from slam.object_data import ObjectObservations
from slam.tracks.follow import match_everywhere
from slam.tracks.table import Tracks
from slam.window.consensus import find_consensus

_SIGMAS = 5.0  # a point agrees with the fit up to so many pixel sigmas
_HYPOTHESES = 60  # cost: poses tried for a body that is found again
_DEPTHS = 0.2  # share of the depth by which stereo may be off


def located(body: Body, tracks: Tracks, frame: Frame, estimator: BodyEstimator) -> BodyBelief | None:
    """What is believed of a body after this frame, by its tracks that are seen, or found again; None for nothing.

    Tracks that the estimate did not use are counted as misfits, in place: those that disagree, and those that it could
    not take, for want of a depth or of room. Two parts found as one, such as a box with its lid, shed the points of the
    other one so. Where these stay, the group is not proven while it is on probation, is dropped, and found anew over
    and over. They are followed on, as they may lie on a part that moves otherwise.
    """
    features = frame.features
    members = np.flatnonzero(tracks.body == body.id)
    mine = members[tracks.found[members]]
    rows = tracks.row[mine]

    def estimated(mine: NDArray[np.intp], rows: NDArray[np.intp], T: Array | None = None) -> BodyBelief | None:
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
    body: Body, tracks: Tracks, mine: NDArray[np.intp], rows: NDArray[np.intp], features: StereoFeatures,
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
    """Whether a body that is found again at a pose (4, 4) can have gone there from where it was seen.

    Its predicted place has a covariance, and so has the place of a point that stereo measures there.
    """
    R, view = body.T[:3, :3], frame.T_world_left[:3, :3]
    local = transform(inverse(frame.T_world_left), T[None, :3, 3])
    noise = frame.setup.rig.triangulation_covariance(local, frame.setup.sigma)[0]
    gap = T[:3, 3] - body.T[:3, 3]
    return bool(gap @ np.linalg.solve(R @ body.covariance[3:, 3:] @ R.T + view @ noise @ view.T, gap) < AGREES)


def _is_expected(body: Body) -> bool:
    """Whether it is known where the body is to within what it measures across."""
    return bool(np.trace(body.covariance[3:, 3:]) <= body.across**2)


def _fit(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], rows: NDArray[np.intp], frame: Frame
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


def _by_descriptors(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], frame: Frame
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Members matched by descriptor, and the features' rows, no farther off than the body can have gone.

    No body is faster than `max_speed`. For a body whose position is unknown, because it was out of view for long,
    weaker matches are accepted, and the fit decides. Features of free tracks may be matched, too: such tracks may have
    started on the body's points.
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
    lost = body.apart_from is None and not _is_expected(body)
    limits = (c.d_match, c.ratio) if lost else (c.wide_d_match, c.wide_ratio)
    found = match_everywhere(tracks.look[mine], tracks.laplacian[mine], features.select(free), *limits, allowed)
    return mine[found.tracks], free[found.features]
