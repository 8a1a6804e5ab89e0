"""What the back end makes of the bodies: given their observations, its estimates are taken over and reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.data import StereoFeatures
from slam.geometry.pnp import MINIMAL_POINTS
from slam.geometry.se3 import Array, inverse, transform
from slam.interfaces import ObjectBackend
from slam.object_data import MovingObject, ObjectEstimate, ObjectObservations
from slam.object_models import ObjectModels
from slam.objects import membership
from slam.objects.bodies import CUT, Body, counted, from_estimate, outermost
from slam.objects.config import ObjectsConfig
from slam.objects.existence import EVEN
from slam.objects.points import MAX_REJECTIONS
from slam.objects.tracks import Tracks


class BodyEstimates:
    """The bodies as one back end knows them.

    Args:
        config: settings of the detector.
        models: how bodies move.
    """

    def __init__(self, config: ObjectsConfig, models: ObjectModels) -> None:
        self._config = config
        self._models = models
        self._known: set[int] = set()

    def update(
        self, bodies: dict[int, Body], tracks: Tracks, backend: ObjectBackend, features: StereoFeatures,
        forgotten: Sequence[int],
    ) -> tuple[MovingObject, ...]:  # fmt: skip
        """Give the bodies' observations to the back end, take over its estimates, in place, and report the bodies.

        Args:
            bodies: by id.
            tracks: all tracks.
            backend: estimates the bodies.
            features: of the frame.
            forgotten: ids of bodies that are no more, or restart.
        """
        gone = [id for id in forgotten if id in self._known]
        if gone:
            backend.remove_objects(gone)
        known = {body.id for body in bodies.values() if body.estimate is not None}
        observations = [_observations(body, tracks, features) for body in bodies.values() if body.measured]
        told = [o for o in observations if o.id in known or o.has_stereo.sum() >= MINIMAL_POINTS]
        estimates = _restarted(bodies, backend, backend.update_objects(told), observations)
        strangers = [e.id for e in estimates if e.id not in bodies]  # of before a restart
        if strangers:
            backend.remove_objects(strangers)
            estimates = [e for e in estimates if e.id in bodies]
        self._known = {e.id for e in estimates}
        reported = []
        for estimate in estimates:
            body = from_estimate(bodies[estimate.id], estimate, self._config.min_speed)
            if not self._believed(body, estimate):
                backend.remove_objects([body.id])
                self._known.discard(body.id)
                bodies[body.id] = replace(body, estimate=None, refused=0)
                continue
            bodies[body.id] = body
            membership.count_rejections(tracks, estimate.rejected)
            if body.proven and self._worth_reporting(body, estimate):
                bodies[body.id] = counted(body)
                reported.append(_report(body, estimate, tracks))
        return tuple(reported)

    def _believed(self, body: Body, estimate: ObjectEstimate) -> bool:
        """Whether the back end still knows a body; if not, it restarts under its id once it is measured again."""
        return body.refused < MAX_REJECTIONS and self._models.known(estimate.covariance, estimate.velocity_covariance)

    def _worth_reporting(self, body: Body, estimate: ObjectEstimate) -> bool:
        """Whether a body is reported: if not measured, for a short while and seldom, and where it likely exists."""
        c = self._config
        short = estimate.stamp - body.measured_at <= c.report_unmeasured
        seldom = body.reported_unmeasured + 1 <= c.unmeasured_share * body.reported
        return estimate.measured or (short and seldom and body.existence > EVEN)


def _restarted(
    bodies: dict[int, Body], backend: ObjectBackend, estimates: list[ObjectEstimate],
    observations: list[ObjectObservations],
) -> list[ObjectEstimate]:  # fmt: skip
    """The estimates, with bodies restarted whose measurements were all rejected although their points agree here.

    They keep id and velocity: what was wrong are the back end's points.
    """
    refused = {e.id for e in estimates if not e.measured}
    again = [o for o in observations if o.id in refused and o.has_stereo.sum() >= MINIMAL_POINTS]
    if not again:
        return estimates
    ids = sorted(o.id for o in again)
    backend.remove_objects(ids)
    for id in ids:
        bodies[id] = replace(bodies[id], estimate=None, refused=0)
    begun = {e.id: e for e in backend.update_objects(again) if e.id in ids}
    return [begun.get(e.id, e) for e in estimates]


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


def _report(body: Body, estimate: ObjectEstimate, tracks: Tracks) -> MovingObject:
    mine = tracks.body == body.id
    rows = tracks.row[mine & tracks.seen]
    T = estimate.T_world_object
    points = transform(inverse(body.T_body_estimate), tracks.local[mine & tracks.sure])
    extent = _enclosing(points) if len(points) > 1 else np.zeros((2, 3))
    return MovingObject(
        body.id, np.sort(rows), estimate, T @ inverse(body.T_reported), T @ inverse(body.T_found),
        extent, body.moving, body.found_at, body.measured_at, body.existence,
    )  # fmt: skip
