"""A moving rigid body as the detector keeps it: its pose over the window, its extent, and what is reported of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.bodies.belief import EVEN, BodyBelief, when_measured, when_missed
from slam.bodies.body_kernels import windows_in_body
from slam.bodies.config import CLEAR, MIN_FRAMES
from slam.data import BoolArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose, so3_exp, transform, twice
from slam.models import ObjectModels
from slam.object_data import MovingObject
from slam.tracks.table import Tracks

_UNMEASURED = 1.0  # [s] for which a body is still reported after its last measurement
UNMEASURED_SHARE = 0.05  #: most frames in which it is so, as a share of those in which it was measured
PROOF = 4  #: by frames that are certain by both tests, each of which counts twice, or by way and turn together
SOLID = 0.6  #: share of the points inside a body that go with it: where others stand still, a shadow or leaves move
CUT = 0.05  #: share of a body's points that lie outside its extent, to each side
_SPREAD = 0.05  # deviation of a fresh body's pose, per axis [m] and [rad]


@dataclass(frozen=True, eq=False)
class Body:
    """A body."""

    id: int
    T: Array  # pose T_world_object (4, 4) at the present frame
    velocity: Array  # [ω, v] (6,) in world axes
    covariance: Array  # of the pose (6, 6), body axes
    history: Array  # poses at the window's slots (W, 4, 4)
    known: BoolArray  # at which slots there is a measured one (W,)
    lower: Array  # corner (3,) of the extent of its points, body coordinates
    upper: Array  # the opposite corner
    size: float  # what it measures across at least [m]
    seen_at: float  # when it was last measured [s]
    velocity_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))  # of the velocity (6, 6)
    seen: int = 1  # number of frames in which it was measured
    missed: int = 0  # number of frames since it was measured
    measured: bool = True  # whether it was in this frame
    moving: bool = True  # whether it moves now
    evidence: float = 0.0  # evidence that it has moved, given all that is uncertain; see `slam.bodies.proof`
    far: bool = False  # whether it was followed for farther than it is wide
    certain: int = 0  # what frames so far count for the proof that it moves, see `slam.bodies.proof`
    agreeing: int = 0  # number of members, added over frames, that went with it rather than stood still
    against: int = 0  # number of others inside its extent, added over frames, that rather stood still
    alike: int = 0  # number of frames in which it moved as an older body did, as a part of that would
    age: int = 0  # number of frames since it was found
    existence: float = EVEN  # probability that it exists, see `slam.bodies.belief`
    apart_from: int | None = None  # id of the body of which it is a part with a motion of its own; None for none
    distinct: frozenset[int] = frozenset()  # ids of bodies that it is known not to be a part of
    belief: BodyBelief | None = field(default=None, repr=False)  # its estimate; None where there is none yet

    @property
    def proven(self) -> bool:
        """Whether it has moved for certain by its tracks, and what it encloses has, for the most part."""
        return self.certain >= PROOF and self.agreeing >= SOLID * (self.agreeing + self.against)

    @property
    def off(self) -> float:
        """How far its corners may be from where they are expected, seen from the camera: standard deviation [m]."""
        if self.belief is None:
            return math.inf
        A = adjoint(self.belief.poses[-1])
        P = A @ self.belief.covariance[-6:, -6:] @ A.T + self.covariance - self.belief.estimate.covariance
        J = points_by_pose(np.stack([self.lower, self.upper])).reshape(-1, 6)
        return math.sqrt(max(float(np.vdot(J @ P, J)) / 2.0, 0.0))

    @property
    def gone(self) -> bool:
        """Whether it is out of view, and may be farther from where it is expected than it is wide."""
        return self.missed > 1 and self.off > self.across

    @property
    def solid(self) -> float:
        """Twice the log odds, no more than is clear, that what is inside goes with it, by those that clearly did."""
        return min(2.0 * math.log((self.agreeing + 1.0) / (self.against + 1.0)), CLEAR)

    @property
    def across(self) -> float:
        """Diagonal of its extent, but no less than its least size [m]."""
        return max(math.dist(self.upper, self.lower), self.size)

    @property
    def went(self) -> float:
        """How far it is from where its estimate began [m]."""
        return 0.0 if self.belief is None else math.dist(self.T[:3, 3], self.belief.T_begun[:3, 3])

    @property
    def middle(self) -> Array:
        """Middle of its extent (3,) in world coordinates."""
        return np.asarray(self.T[:3, :3] @ (0.5 * (self.lower + self.upper)) + self.T[:3, 3])

    def placed(self, T: Array, slot: int, measured: bool, **changes: Any) -> Body:
        """The body with its pose at the present frame, whose slot is `slot`, and other changes."""
        history, known = self.history.copy(), self.known.copy()
        history[slot], known[slot] = T, measured
        return changed(self, T=T, history=history, known=known, measured=measured, **changes)


def new_body(
    id: int, centre: Array, twist: Array, times: Array, stamp: float, size: float, uncertainty: Array | None = None
) -> Body:  # fmt: skip
    """A body found with a twist [ω, v] (6,) at its centre (3,); its poses by slot follow from a constant velocity.

    The window's slots have `times` (W,) less the present [s]; `uncertainty` (6, 6) is that of the twist.
    """
    history = np.tile(np.eye(4), (len(times), 1, 1))
    history[:, :3, :3] = so3_exp(times[:, None] * twist[:3])
    history[:, :3, 3] = centre + times[:, None] * twist[3:]
    T = np.eye(4)
    T[:3, 3] = centre
    none = np.zeros(3)
    return Body(
        id, T, twist, _SPREAD**2 * np.eye(6), history, np.ones(len(times), bool), none, none, size,
        stamp, velocity_covariance=np.zeros((6, 6)) if uncertainty is None else uncertainty,
    )  # fmt: skip


def advanced(body: Body, dt: float, slot: int, models: ObjectModels) -> Body:
    """The body predicted over `dt` [s] with constant velocity, not measured yet."""
    T = body.T.copy()
    T[:3, :3] = so3_exp(dt * body.velocity[:3]) @ T[:3, :3]
    T[:3, 3] += dt * body.velocity[3:]
    linear, angular = models.velocity_variance(dt)
    R = twice(T[:3, :3].T)
    velocity = body.velocity_covariance + np.diag([angular] * 3 + [linear] * 3)
    return body.placed(
        T, slot, False, covariance=body.covariance + dt**2 * R @ velocity @ R.T,
        velocity_covariance=velocity, missed=body.missed + 1, age=body.age + 1,
    )  # fmt: skip


def with_belief(body: Body, belief: BodyBelief, slot: int, stamp: float, min_speed: float) -> Body:
    """The body as it is estimated in the present frame."""
    estimate = belief.estimate
    size = 0.5 * float(np.linalg.norm(body.upper - body.lower))
    v, P = estimate.velocity, estimate.velocity_covariance
    speed = float(np.linalg.norm(v[3:]) + size * np.linalg.norm(v[:3]))
    certain = float(v @ np.linalg.solve(P, v)) > (9.0 if body.moving else 16.8)  # χ²(6): 83 % and 99 %
    changes: dict[str, Any] = {}
    if estimate.measured:
        changes = {"seen_at": stamp, "seen": body.seen + 1, "missed": 0}
    if estimate.measured and belief.since == stamp and body.belief is None:
        body = changed(body, known=np.zeros_like(body.known))  # the estimate began anew: it knows of no earlier pose
    return body.placed(
        estimate.T_world_object, slot, estimate.measured, covariance=estimate.covariance, velocity=v,
        velocity_covariance=P, belief=belief,
        moving=body.seen <= MIN_FRAMES or (certain and speed > min_speed), **changes,
    )  # fmt: skip


def returned(body: Body, T: Array, slot: int, stamp: float) -> Body:
    """A body that is seen again, at a pose (4, 4); its estimate begins anew."""
    return body.placed(
        T, slot, True, covariance=_SPREAD**2 * np.eye(6), seen_at=stamp, seen=body.seen + 1, missed=0,
        belief=None,
    )  # fmt: skip


def continued(body: Body, known: Body) -> Body:
    """A new body that turns out to be a known one takes over its id and predicted frame; the estimate begins anew.

    The frame is shifted from the middle of the part seen before to that of the part seen now. Its extent is to be taken
    anew.
    """
    frame = known.T.copy()
    frame[:3, 3] += body.middle - known.middle
    return changed(
        body, id=known.id, T=frame, history=body.history @ inverse(body.T) @ frame, certain=known.certain,
        existence=known.existence, evidence=known.evidence, age=known.age, seen=body.seen + known.seen,
        agreeing=body.agreeing + known.agreeing, against=body.against + known.against,
        distinct=body.distinct | known.distinct, belief=None,
    )  # fmt: skip


def hidden(bodies: Iterable[Body], eye: Array, points: Array) -> BoolArray:
    """Which points (N, 3) lie behind one of the bodies, seen from `eye` (3,): beyond the far side of its extent."""
    behind = np.zeros(len(points), bool)
    for body in bodies:
        start = transform(inverse(body.T), eye[None])
        rays = transform(inverse(body.T), points) - start
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (np.stack([body.lower, body.upper])[:, None] - start) / rays  # of the way to the point
        enters, leaves = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        behind |= (enters > 0) & (enters < leaves) & (leaves < 1)
    return behind


def with_evidence(body: Body, gain: float, agreeing: int, against: int) -> Body:
    """The body after what this frame says of its existence, see `slam.bodies.belief`, and of what it encloses."""
    existence = (
        when_measured(body.existence, gain) if body.measured else when_missed(body.existence, body.seen, body.age)
    )
    return changed(body, agreeing=body.agreeing + agreeing, against=body.against + against, existence=existence)


def with_extent(body: Body, local: Array) -> Body:
    """The body with the extent of its points (K, 3)."""
    if len(local) < 3:
        return body
    lower, upper = outermost(local)
    return changed(body, lower=lower, upper=upper)


def outermost(points: Array) -> tuple[Array, Array]:
    """The 5th and 95th percentiles (3,) of points (K, 3), at least two: as NumPy's, without their cost for a few."""
    ordered = np.sort(points, axis=0)
    place = CUT * (len(points) - 1)
    k = int(place)
    share = place - k
    return (1 - share) * ordered[k] + share * ordered[k + 1], (1 - share) * ordered[-1 - k] + share * ordered[-2 - k]


def of_bodies(tracks: Tracks, bodies: Iterable[Body]) -> BoolArray:
    """Which tracks (N,) belong to one of the bodies."""
    mine = np.zeros(len(tracks), bool)
    for body in bodies:
        mine |= tracks.body == body.id
    return mine


def in_body_axes(body: Body, tracks: Tracks, rows: NDArray[np.intp]) -> tuple[Array, Array, BoolArray]:
    """What tracks measured by slot in body coordinates: points (N, W, 3), information (N, W, 3, 3), and whether any."""
    t = tracks
    points, A, known = windows_in_body(t.A, t.p, t.dof, t.anchor, rows, body.history, body.known)
    return points, A, known


def reported(bodies: Mapping[int, Body], tracks: Tracks, slot: int) -> tuple[MovingObject, ...]:
    """The bodies that are worth reporting, by ascending id: if not measured, for a short while if they likely exist."""
    out = []
    for _, body in sorted(bodies.items()):
        if body.belief is None or not body.proven:
            continue
        e = body.belief.estimate
        short = e.stamp - body.seen_at <= _UNMEASURED and body.missed <= UNMEASURED_SHARE * body.seen
        if e.measured or (short and body.existence > EVEN):
            out.append(_report(body, body.belief, tracks, slot))
    return tuple(out)


def _report(body: Body, belief: BodyBelief, tracks: Tracks, slot: int) -> MovingObject:
    estimate = belief.estimate
    mine = tracks.body == body.id
    rows = tracks.row[mine & tracks.found]
    T, new = estimate.T_world_object, belief.since == estimate.stamp
    motion = np.eye(4) if new else T @ inverse(body.history[slot - 1])
    extent = np.stack([body.lower, body.upper])
    return MovingObject(
        body.id, np.sort(rows), estimate, motion, T @ inverse(belief.T_begun), extent, body.moving, belief.since,
        body.seen_at, body.existence,
    )  # fmt: skip
