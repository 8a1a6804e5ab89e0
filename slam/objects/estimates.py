"""The bodies' estimates: from what was seen of them in a frame to what is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import RecentPoses, StereoFeatures
from slam.geometry.se3 import Array, inverse, transform
from slam.object_data import MovingObject, ObjectEstimate, ObjectObservations
from slam.objects import membership
from slam.objects.belief import BodyBelief
from slam.objects.bodies import CUT, Body, counted, from_estimate, outermost
from slam.objects.config import ObjectsConfig
from slam.objects.estimator import BodyEstimator
from slam.objects.existence import EVEN
from slam.objects.points import MAX_REJECTIONS
from slam.objects.tracks import Tracks


def estimated(
    bodies: dict[int, Body], tracks: Tracks, estimator: BodyEstimator, features: StereoFeatures, cameras: RecentPoses,
    config: ObjectsConfig,
) -> tuple[MovingObject, ...]:  # fmt: skip
    """Estimate the bodies, in place, and report them.

    Args:
        bodies: by id.
        tracks: all tracks.
        estimator: of a body.
        features: of the frame.
        cameras: the camera's last poses.
        config: settings of the detector.
    """
    reported = []
    for id, body in sorted(bodies.items()):
        seen = _observations(body, tracks, features) if body.measured else None
        belief = estimator.updated(body.belief, id, seen, cameras)
        if belief is None:
            bodies[id] = replace(body, belief=None)
            continue
        body, estimate = from_estimate(body, belief, config.min_speed), belief.estimate
        known = estimator.models.known(estimate.covariance, estimate.velocity_covariance)
        if not known or body.refused >= MAX_REJECTIONS:  # it begins anew under its id once it is measured again
            bodies[id] = replace(body, belief=None, refused=0)
            continue
        membership.count_rejections(tracks, estimate.rejected)
        if body.proven and body.moved and _worth_reporting(body, estimate, config):
            body = counted(body, estimate.measured)
            reported.append(_report(body, belief, tracks))
        bodies[id] = body
    return tuple(reported)


def _worth_reporting(body: Body, estimate: ObjectEstimate, config: ObjectsConfig) -> bool:
    """Whether a body is reported: if not measured, for a short while and seldom, and where it likely exists."""
    short = estimate.stamp - body.measured_at <= config.report_unmeasured
    seldom = body.reported_unmeasured + 1 <= config.unmeasured_share * body.reported
    return estimate.measured or (short and seldom and body.existence > EVEN)


def _observations(body: Body, tracks: Tracks, features: StereoFeatures) -> ObjectObservations:
    mine = np.flatnonzero((tracks.body == body.id) & tracks.seen & (tracks.misfit == 0))
    mine = mine[np.argsort(tracks.ids[mine])]
    rows = tracks.row[mine]
    guess, sigma = body.T @ body.T_body_estimate, np.sqrt(body.velocity_covariance.diagonal())
    return ObjectObservations(
        body.id, tracks.ids[mine], features.uv_left[rows], features.uv_right[rows], guess, body.velocity, sigma
    )


def _enclosing(points: Array) -> Array:
    """Lower and upper corner (2, 3) of a box about points (K, 3), false ones among them left out.

    The percentiles are widened by what they cut off evenly spread points, at most to the outermost point.
    """
    lower, upper = outermost(points)
    more = CUT / (1.0 - 2.0 * CUT) * (upper - lower)
    return np.stack([np.maximum(lower - more, points.min(axis=0)), np.minimum(upper + more, points.max(axis=0))])


def _report(body: Body, belief: BodyBelief, tracks: Tracks) -> MovingObject:
    estimate = belief.estimate
    mine = tracks.body == body.id
    rows = tracks.row[mine & tracks.seen]
    T = estimate.T_world_object
    points = transform(inverse(body.T_body_estimate), tracks.local[mine & tracks.sure])
    extent = _enclosing(points) if len(points) > 1 else np.zeros((2, 3))
    return MovingObject(
        body.id, np.sort(rows), estimate, T @ inverse(body.T_reported), T @ inverse(body.T_found),
        extent, body.moving, belief.since, body.measured_at, body.existence,
    )  # fmt: skip
