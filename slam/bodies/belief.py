"""What is believed of one moving body: the camera's last poses in it, and its points. See `slam.bodies.estimator`.

How sure it is that a body exists follows from the frames in which it was measured and those in which it was not: the
recursion of integrated probabilistic data association (Mušicki, Evans and Stanković, IEEE Transactions on Automatic
Control 39, 1994). A measurement counts the more, the better the body's motion explains its points compared with a still
world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.bodies.config import CLEAR
from slam.data import BoolArray, IdArray, RecentPoses
from slam.geometry.arrays import Table, changed
from slam.geometry.se3 import Array
from slam.models import ObjectModels
from slam.object_data import ObjectEstimate
from slam.window.marginal import marginalised
from slam.window.problem import Motion, RelativePrior, Rows, Window
from slam.window.stereo import RectifiedStereo

EVEN = 0.5  #: fixed: a body rather exists than not above this probability, which it has before its first evidence
_LEAST = 2.0  # ratio of the likelihoods of a measured body, at least: a body at rest shows no motion, but is there
_CERTAIN = 1.0 - 1e-9  # a probability of 1 could never fall again


_FAR = 3.0  # so many times the median distance from the median point is no part of the body


def compact(points: Array) -> BoolArray:
    """Which of the points (N, 3) lie near their median point."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1) if len(points) else np.zeros(0)
    return np.asarray(distance <= _FAR * np.median(distance) if len(points) else np.zeros(0, bool))


def when_measured(probability: float, gain: float) -> float:
    """The probability after a frame that measured the body, which explains a member better than the world by `gain`.

    No gain counts for more than is clear: many members share one error of the camera's pose.
    """
    ratio = max(_LEAST, math.exp(0.5 * min(gain, CLEAR)))
    return min(_CERTAIN, probability * ratio / (1.0 - probability + probability * ratio))


def when_missed(probability: float, seen: int, age: int) -> float:
    """The probability after a frame that did not measure a body, `seen` in so many of the frames of its `age`."""
    detection = (seen + 1.0) / (age + 2.0)
    return probability * (1.0 - detection) / (1.0 - probability * detection)


_EXACT = 1e-12 * np.eye(6)  # numerics: [rad², m²]
_TURN = 0.01  # cost: a point is seen from elsewhere by no less [rad]; what is less adds up


@dataclass(frozen=True, eq=False)
class Points(Table):
    """Points of a body, a row each."""

    ids: IdArray  # (N,), −1 of those that were given up but still take part
    position: Array  # in body coordinates (N, 3) [m]
    local: Array  # covariance (N, 3, 3) [m²] in the coordinates of the newest camera, by which they are known
    failures: IdArray  # how often running each was rejected (N,)
    unseen: IdArray  # frames since each was seen (N,)
    first: Array  # direction (N, 3) from which each was seen first, in body coordinates
    turned: Array  # largest angle between that and later ones (N,) [rad], as far as it is allowed for

    @classmethod
    def new(cls, ids: IdArray, position: Array, local: Array, eye: Array) -> Points:
        """Points at their first sight, from `eye` (3,)."""
        none = np.zeros(len(ids), np.int64)
        return cls(ids, position, local, none, none, _directions(position, eye), np.zeros(len(ids)))


@dataclass(frozen=True, eq=False)
class BodyBelief:
    """One body in the last K frames."""

    since: float  # when the estimate began [s]
    T_begun: Array  # pose T_world_object (4, 4) then
    # what was known of the velocity [ω, v] (6,) in the first interval: mean, in world axes, and standard deviations
    velocity: Array
    sigmas: Array
    stamps: Array  # times of the frames (K,) [s]
    poses: Array  # T_body_left (K, 4, 4)
    scales: Array  # factors (K,) on the impulse before each frame
    points: Points  # of the body
    rows: Rows  # what was measured of them in these frames
    prior: RelativePrior  # what earlier frames say of the poses and points
    covariance: Array  # of the poses together (6 K, 6 K), perturbed on the right
    estimate: ObjectEstimate  # of the newest frame, as it is reported

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def alive(self) -> BoolArray:
        """Which of the points belong to it still (N,)."""
        return np.asarray(self.points.ids >= 0)


def _directions(points: Array, eye: Array) -> Array:
    """Unit vectors (N, 3) from points (N, 3) towards the camera's place (3,)."""
    d = eye - points
    return np.asarray(d / np.linalg.norm(d, axis=1)[:, None])


def begun(stamp: float, T_body_left: Array, velocity: Array, sigmas: Array, estimate: ObjectEstimate) -> BodyBelief:
    """A belief without points: the body's frame is put at T_body_left (4, 4) from the camera, by definition."""
    none = np.zeros((0, 3))
    points = Points.new(np.zeros(0, np.int64), none, np.zeros((0, 3, 3)), np.zeros(3))
    return BodyBelief(
        stamp, estimate.T_world_object, velocity, sigmas, np.array([stamp]), T_body_left[None], np.ones(1),
        points, Rows.none(), RelativePrior.of_pose(T_body_left, _EXACT), _EXACT, estimate,
    )  # fmt: skip


def carried(b: BodyBelief, cameras: RecentPoses, models: ObjectModels) -> Motion:
    """The motion between the frames, for the camera's poses in them (K)."""
    first = 1 if b.stamps[0] == b.since else 2  # else what is known of the first interval is in the prior
    at, dt = np.arange(first, len(b)), np.diff(b.stamps)
    if not len(at):
        return Motion.none()
    variance = (b.scales[at] ** 2 * dt[at - 1])[:, None] * np.repeat(models.velocity_variance(1.0)[::-1], 3)
    before, mean = np.where(at > 1, dt[at - 2], 1.0), np.zeros((len(at), 6))
    if first == 1:
        variance[0] += b.sigmas**2
        mean[0] = b.velocity
        mean[0, :3] = b.poses[0][:3, :3] @ cameras.poses[0][:3, :3].T @ b.velocity[:3]
    triples, intervals = at[:, None] + np.arange(-2, 1), np.column_stack([before, dt[at - 1]])
    return Motion(triples, intervals, mean, variance, cameras.poses, cameras.covariance)


def window(b: BodyBelief, stereo: RectifiedStereo, motion: Motion) -> Window:
    """The belief as a problem for the solver."""
    return Window(stereo, b.poses, b.points.position, b.rows, motion=motion, prior=b.prior)


def slid(b: BodyBelief, stereo: RectifiedStereo, motion: Motion, drift: float) -> BodyBelief:
    """The belief without its oldest frame, which becomes part of the prior with the points that it has measured.

    `drift` is the density of the random walk of a point's direction with the angle of view [rad / √rad]. Raises
    LinAlgError where the information of what leaves is not positive definite.
    """
    rows, member, here = b.rows, np.zeros(len(b.points), bool), np.zeros(len(b.points), bool)
    member[b.prior.points], here[rows.point[rows.pose == 0]] = True, True
    joins, ends = here & ~member & b.alive, member & ~b.alive
    taken = (rows.pose == 0) & (member | joins)[rows.point] | ends[rows.point]
    w = window(b, stereo, motion.select(np.flatnonzero((motion.poses <= 0).any(axis=1))))
    w = changed(w, rows=rows.select(taken), joining=np.flatnonzero(joins))
    prior, _, _ = marginalised(w, [0], ends[b.prior.points])
    prior, turned = _drifted(prior, b, drift)
    rows, keep = rows.select(~taken & (rows.pose > 0)), member & b.alive | joins
    keep[rows.point] = True
    index = np.cumsum(keep) - 1
    return changed(
        b, stamps=b.stamps[1:], poses=b.poses[1:], scales=b.scales[1:],
        points=changed(b.points, turned=turned).select(keep),
        rows=changed(rows, pose=rows.pose - 1, point=index[rows.point]),
        prior=changed(prior, points=index[prior.points]), covariance=b.covariance[6:, 6:],
    )  # fmt: skip


def _drifted(prior: RelativePrior, b: BodyBelief, density: float) -> tuple[RelativePrior, Array]:
    """The prior with its points less certain across the line of sight, and the angles (N,) allowed for now.

    A feature is found where the image looks like it; seen from farther round than ever before, that is elsewhere on the
    body. The first two coordinates of a point in its chart are its direction.
    """
    p = b.points
    cosine = np.einsum("ni,ni->n", p.first, _directions(p.position, b.poses[-1][:3, 3]))
    turned = np.maximum(p.turned, np.arccos(np.clip(cosine, -1, 1)))
    more = (turned - p.turned)[prior.points]
    far = np.flatnonzero(more > _TURN)
    if not len(far) or not density:
        return prior, p.turned
    out = p.turned.copy()
    out[prior.points[far]] = turned[prior.points[far]]
    at = (3 * far[:, None] + np.arange(2)).reshape(-1)
    S = np.diag(1.0 / np.repeat(density**2 * more[far], 2)) + prior.information[np.ix_(at, at)]
    gain = np.linalg.solve(S, prior.information[at]).T
    information = prior.information - gain @ prior.information[at]
    return changed(
        prior, information=0.5 * (information + information.T), vector=prior.vector - gain @ prior.vector[at]
    ), out
