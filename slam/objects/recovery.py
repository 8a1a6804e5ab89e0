"""Where a body is in this frame: by its estimate, and by the search for it where it was lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.arrays import among
from slam.geometry.pnp import find_consensus, measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.object_data import ObjectObservations
from slam.objects.belief import BodyBelief
from slam.objects.bodies import Body
from slam.objects.config import ObjectsConfig
from slam.objects.estimator import BodyEstimator
from slam.objects.fits import AGREES
from slam.objects.frame import Frame
from slam.objects.points import MIN_POINTS
from slam.tracks.follow import match_everywhere
from slam.tracks.table import Tracks

_SIGMAS = 5.0  # a point agrees with the fit up to so many pixel sigmas
_HYPOTHESES = 60  # cost: poses tried for a body that is found again
_DEPTHS = 0.2  # share of the depth by which stereo may be off


def located(
    body: Body, tracks: Tracks, frame: Frame, estimator: BodyEstimator
) -> BodyBelief | None:  # fmt: skip
    """What is believed of a body after this frame, by its tracks that are seen, or found again; None for nothing.

    Tracks that the estimate did not use are counted as misfits, in place: those that disagree, and those that it could
    not take, for want of a depth or of room. Two parts found as one, such as a box with its lid, shed the points of the
    other one so. Where these stay, the group is not proven while it is on probation, is dropped, and found anew over
    and over. They are followed on, as they may lie on a part that moves otherwise.
    """
    features, cameras, T_world_left = frame.features, frame.cameras, frame.T_world_left
    rig, sigma, config = frame.setup.rig, frame.setup.sigma, frame.setup.config
    measured, seed = frame.local, frame.number
    members = np.flatnonzero(tracks.body == body.id)
    mine = members[tracks.found[members]]
    rows = tracks.row[mine]

    def estimated(mine: NDArray[np.intp], rows: NDArray[np.intp], T: Array | None = None) -> BodyBelief | None:
        return estimator.updated(body.belief, body.id, observed(body, tracks, mine, rows, features, T), cameras)

    def agreeing(belief: BodyBelief | None) -> int:
        return len(belief.estimate.used) if belief is not None and belief.estimate.measured else 0

    asked = slice(None) if _is_expected(body) else slice(0)  # else any two points agree with one of its poses
    belief = estimated(mine[asked], rows[asked])
    if 2 * agreeing(belief) < len(mine) or not len(mine):
        alike = _by_descriptors(body, tracks, members, features, measured, T_world_left, config)
        for some, theirs in ((mine, rows), alike):
            fit = _fit(body, tracks, some, theirs, features, T_world_left, rig, sigma, seed)
            if fit is None or fit[1].sum() <= agreeing(belief):
                continue
            T = np.asarray(T_world_left @ inverse(fit[0]))
            if not _is_within_reach(body, T, T_world_left, rig, sigma):
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


def _is_within_reach(body: Body, T: Array, T_world_left: Array, rig: StereoRig, sigma: float) -> bool:
    """Whether a body that is found again at a pose (4, 4) can have gone there from where it was seen.

    Its predicted place has a covariance, and so has the place of a point that stereo measures there.
    """
    R, view = body.T[:3, :3], T_world_left[:3, :3]
    local = transform(inverse(T_world_left), T[None, :3, 3])
    spread = R @ body.covariance[3:, 3:] @ R.T + view @ rig.triangulation_covariance(local, sigma)[0] @ view.T
    gap = T[:3, 3] - body.T[:3, 3]
    return bool(gap @ np.linalg.solve(spread, gap) < AGREES)


def _is_expected(body: Body) -> bool:
    """Whether it is known where the body is to within what it measures across."""
    return bool(np.trace(body.covariance[3:, 3:]) <= body.across**2)


def _fit(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], rows: NDArray[np.intp], features: StereoFeatures,
    T_world_left: Array, rig: StereoRig, sigma: float, seed: int,
) -> tuple[Array, BoolArray] | None:  # fmt: skip
    """Pose T_body_left, and which tracks agree with it as the features of these rows."""
    if len(mine) < MIN_POINTS:
        return None
    z = measurement_rows(features.uv_left[rows], features.uv_right[rows])
    guess = inverse(body.T) @ T_world_left
    fit = find_consensus(rig, tracks.local[mine], z, guess, _SIGMAS * sigma, _HYPOTHESES, seed)
    stereo = np.isfinite(z[fit.inliers, 2])
    return None if stereo.sum() < MIN_POINTS else (fit.T_world_left, fit.inliers)


def _by_descriptors(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], features: StereoFeatures, measured: Array,
    T_world_left: Array, config: ObjectsConfig,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:  # fmt: skip
    """Members matched by descriptor, and the features' rows, no farther off than the body can have gone.

    For a body whose position is unknown, because it was out of view for long, weaker matches are accepted, and the fit
    decides. Features of free tracks may be matched, too: such tracks may have started on the body's points.
    """
    taken = among(len(features), tracks.row[tracks.found & (tracks.body >= 0) & (tracks.body != body.id)])
    free = np.flatnonzero(~taken & np.isfinite(measured[:, 0]))
    if len(mine) < MIN_POINTS or len(free) < MIN_POINTS:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    local = measured[free]
    points = transform(T_world_left, local)
    reach = _reach(body, features.stamp, config)
    near = np.linalg.norm(points - body.T[:3, 3], axis=1) < reach + _DEPTHS * np.abs(local[:, 2])
    allowed = np.broadcast_to(near, (len(mine), len(free)))
    lost = body.apart_from is None and not _is_expected(body)
    d_match, ratio = (config.d_match, config.ratio) if lost else (config.wide_d_match, config.wide_ratio)
    looks = tracks.look[mine], tracks.laplacian[mine]
    found = match_everywhere(*looks, features.select(free), d_match, ratio, allowed)
    return mine[found.tracks], free[found.features]


def _reach(body: Body, stamp: float, config: ObjectsConfig) -> float:
    """How far from its prediction a body and its points may be at `stamp` [m]: no body is faster than `max_speed`."""
    return config.max_speed * max(stamp - body.seen_at, 0.1) + float(np.linalg.norm(body.upper - body.lower))
