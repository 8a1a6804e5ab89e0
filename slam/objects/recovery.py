"""Where a body is in this frame: a robust rigid fit of its points, and the search for it where it was lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.data import BoolArray, StereoFeatures
from slam.geometry.arrays import among
from slam.geometry.pnp import find_consensus, measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, exp, inverse, transform
from slam.objects.bodies import Body
from slam.objects.body_kernels import agreed_correction
from slam.objects.config import ObjectsConfig
from slam.objects.matching import match_far
from slam.objects.points import MIN_POINTS
from slam.objects.tracks import AGREES, LEAST_INFORMATION, Tracks

_SIGMAS = 5.0  # a point agrees with the fit up to so many pixel sigmas
_HYPOTHESES = 60  # cost: poses tried for a body that is found again
_LEAST_PREDICTED = 2  # points that must agree with the predicted motion
_DEPTHS = 0.2  # share of the depth by which stereo may be off


def locate(
    body: Body, tracks: Tracks, features: StereoFeatures, measured: Array, T_world_left: Array, rig: StereoRig,
    sigma: float, config: ObjectsConfig, seed: int,
) -> Array | None:  # fmt: skip
    """The body's pose T_world_object (4, 4) by a fit to its tracks that are seen, or found again.

    Tracks that disagree are counted as misfits, in place; they are followed on, as they may lie on a part that moves
    otherwise.

    Reprojection errors weigh the points by the noise of the stereo pair. None where too few points agree. `measured`
    are the features' points in camera coordinates (N, 3), NaN where there is no depth.
    """
    members = np.flatnonzero(tracks.body == body.id)
    mine = members[tracks.seen[members]]
    rows = tracks.row[mine]
    found = _predicted(body, tracks, mine, rows, measured, T_world_left, rig, sigma)
    if found is None:
        found = _fit(body, tracks, mine, rows, features, T_world_left, rig, sigma, seed)
    if found is None or 2 * found[1].sum() < len(mine):
        wide, wide_rows = _by_descriptors(body, tracks, members, features, measured, T_world_left, config)
        again = _fit(body, tracks, wide, wide_rows, features, T_world_left, rig, sigma, seed)
        if (
            again is not None
            and (found is None or again[1].sum() > found[1].sum())
            and _is_within_reach(body, T_world_left @ inverse(again[0]), T_world_left, rig, sigma)
        ):
            found, mine, rows = again, wide, wide_rows
    followed = tracks.row[members]
    tracks.row[members] = -1
    if found is None:
        return None
    T_body_left, agrees = found
    T = np.asarray(T_world_left @ inverse(T_body_left))
    depth = float(np.linalg.norm(T[:3, 3] - T_world_left[:3, 3]))
    if np.linalg.norm(T[:3, 3] - body.T[:3, 3]) > _reach(body, features.stamp, config) + _DEPTHS * depth:
        return None
    taken = among(len(features), tracks.row[tracks.seen])
    tracks.row[members] = np.where(taken[followed], -1, followed)  # those that were not seen stay at −1
    tracks.misfit[mine] = np.where(agrees, 0, tracks.misfit[mine] + 1)
    good, matched = mine[agrees], rows[agrees]
    measured_now = among(len(features), matched)
    tracks.row[members[measured_now[followed] & (followed >= 0)]] = -1
    free = np.flatnonzero((tracks.body < 0) & tracks.seen)
    tracks.give_up(free[measured_now[tracks.row[free]]])
    tracks.row[good], tracks.missed[good] = matched, 0
    tracks.descriptors[good] = features.descriptors[matched]
    return T


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


def _predicted(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], rows: NDArray[np.intp], measured: Array, T_world_left: Array,
    rig: StereoRig, sigma: float,
) -> tuple[Array, BoolArray] | None:  # fmt: skip
    """The same by the body's predicted pose and its points: what these do not say of it stays as predicted.

    See `slam.objects.body_kernels.agreed_correction`. At least two points must agree, and the body must be expected
    to within what it measures across: else any two agree with one of its poses.
    """
    local = measured[rows]
    deep = np.flatnonzero(np.isfinite(local).all(axis=1))
    if len(deep) < _LEAST_PREDICTED or not _is_expected(body):
        return None
    local, known = local[deep], mine[deep]
    T_body_left = inverse(body.T) @ T_world_left
    _, J = rig.project_stereo(local)
    change, agrees, enough = agreed_correction(
        tracks.local[known], tracks.local_information[known], local, J, T_body_left[:3, :3], T_body_left[:3, 3],
        body.covariance, np.linalg.inv(body.covariance), sigma, LEAST_INFORMATION, AGREES, _LEAST_PREDICTED,
    )  # fmt: skip
    if not enough:
        return None
    which = np.zeros(len(rows), bool)
    which[deep[agrees]] = True
    return inverse(body.T @ exp(change)) @ T_world_left, which


def _by_descriptors(
    body: Body, tracks: Tracks, mine: NDArray[np.intp], features: StereoFeatures, measured: Array,
    T_world_left: Array, config: ObjectsConfig,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:  # fmt: skip
    """Members matched by descriptor, and the features' rows, no farther off than the body can have gone.

    For a body whose position is unknown, because it was out of view for long, weaker matches are accepted, and the fit
    decides. Features of free tracks may be matched, too: such tracks may have started on the body's points.
    """
    taken = among(len(features), tracks.row[tracks.seen & (tracks.body >= 0) & (tracks.body != body.id)])
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
    rows, columns = match_far(tracks.descriptors[mine], tracks.laplacian[mine], features, free, allowed, d_match, ratio)
    return mine[rows], columns


def _reach(body: Body, stamp: float, config: ObjectsConfig) -> float:
    """How far from its prediction a body and its points may be at `stamp` [m]: no body is faster than `max_speed`."""
    return config.max_speed * max(stamp - body.seen_at, 0.1) + float(np.linalg.norm(body.upper - body.lower))
