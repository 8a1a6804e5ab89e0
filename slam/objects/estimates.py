"""Which bodies are reported, and what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.geometry.se3 import Array, inverse
from slam.object_data import MovingObject, ObjectEstimate
from slam.objects.belief import EVEN, BodyBelief
from slam.objects.bodies import CUT, Body, outermost
from slam.objects.config import ObjectsConfig
from slam.tracks.table import Tracks


def reported(bodies: dict[int, Body], tracks: Tracks, config: ObjectsConfig) -> tuple[MovingObject, ...]:
    """The bodies that are worth it, by ascending id; that they are reported is counted in place."""
    out = []
    for id, body in sorted(bodies.items()):
        if body.belief is None or not (body.proven and body.moved):
            continue
        if _worth_reporting(body, body.belief.estimate, config):
            count = "reported" if body.belief.estimate.measured else "reported_unmeasured"
            bodies[id] = replace(body, **{count: getattr(body, count) + 1})
            out.append(_report(body, body.belief, tracks))
    return tuple(out)


def _worth_reporting(body: Body, estimate: ObjectEstimate, config: ObjectsConfig) -> bool:
    """Whether a body is reported: if not measured, for a short while and seldom, and where it likely exists."""
    short = estimate.stamp - body.measured_at <= config.report_unmeasured
    seldom = body.reported_unmeasured + 1 <= config.unmeasured_share * body.reported
    return estimate.measured or (short and seldom and body.existence > EVEN)


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
    rows = tracks.row[mine & tracks.found]
    points = tracks.local[mine & tracks.sure]
    T, new = estimate.T_world_object, belief.since == estimate.stamp
    motion = np.eye(4) if new else T @ inverse(body.T_before)
    extent = _enclosing(points) if len(points) > 1 else np.zeros((2, 3))
    return MovingObject(
        body.id, np.sort(rows), estimate, motion, T @ inverse(belief.T_begun), extent, body.moving, belief.since,
        body.measured_at, body.existence,
    )  # fmt: skip
