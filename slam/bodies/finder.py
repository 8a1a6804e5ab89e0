"""Groups of tracks that move on their own: before the update, and after it, when they make a body.

Each track brings a displacement ``d_i`` (3,): where its last few frames see it, less where the frames before did. A
camera pose that is off moves all still points by one small rigid motion ``d_i = ρ + θ × (p_i − c)``; so does a body's
own motion, but for its points alone. Therefore no displacement is tested by itself: the tracks inside a window of
directions and depths, for windows of every size, are tested against the rest of them. The common motion that the window
says and the one that the rest says are compared with the covariance of both,

    (ξ_w − ξ_r)ᵀ (Λ_w⁻¹ + Λ_r⁻¹)⁻¹ (ξ_w − ξ_r)  ~  χ²(6),

Λ being sums of ``Jᵀ W J`` over the tracks. The χ² of a track is ``dᵀ W d − 2 ηᵀ ξ + ξᵀ Λ ξ`` with ``η = Jᵀ W d``; J
grows with the lag, so that ξ is a motion by frame.

The test is made of all free tracks in the world; of the tracks on a body in that body's axes, where what moves
otherwise is a part of it, such as a lid; and, before each update, of the landmarks found in a frame against where their
tracks saw them: a near body that starts to move would carry the camera along.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.bodies import membership
from slam.bodies import scene_kernels as kernels
from slam.bodies.belief import compact
from slam.bodies.bodies import Body, in_body_axes, new_body
from slam.bodies.config import MIN_FRAMES, MIN_POINTS, RUN, WINDOW
from slam.bodies.fits import constant_velocity, fit, record_in, times_vectors
from slam.bodies.frame import Frame, Setup
from slam.bodies.regions import Region
from slam.bodies.track_kernels import displaced, well_known
from slam.chi_square import chi_square_limit
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import among, changed, quantile
from slam.geometry.rig import MINIMAL_POINTS, measurement_rows
from slam.geometry.se3 import Array, hat, inverse, points_by_pose, transform
from slam.tracks.table import Tracks

_RECENT = 5  # frames that are recent, at most; of short tracks the later half
FARTHEST = 4.0  #: a track's depth must be so many times its deviation
_TAIL = 3.0  # tracks; see `limit`
_UPPER_QUARTILE = chi_square_limit(3, 0.75)  # of χ²(3)
_SIZES = np.array([[0.1, 0.1, 0.2], [0.2, 0.2, 0.4], [0.4, 0.4, 0.8]])  # of windows: x/z, y/z, logarithm of the depth
# 0.1: from 0.25 on a box that starts carries the camera along
_PRECISE = 0.1  # times the noise of a pixel: what it is from frame to frame at least, without what lasts


@dataclass(frozen=True, eq=False)
class Displacements:
    """How tracks moved from the older to the recent frames, a row each."""

    points: Array  # where they are (N, 3), relative to the camera, in world axes [m]
    d: Array  # displacements (N, 3) [m]
    W: Array  # their information (N, 3, 3)
    lag: Array  # frames between the older and the recent measurements, in the mean (N,)


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that moved alike, and otherwise than the rest."""

    members: IndexArray  # their rows (K,)
    test: float  # χ²(6) of their motion against the rest's
    moved: Displacements  # of all tracks
    common: Array  # the rest's motion ξ (6,)

    @property
    def away(self) -> float:
        """How far its tracks went against the rest, in the weighted mean [m]."""
        m, rows, c = self.moved, self.members, self.common
        W = m.W[rows]
        gap = m.d[rows] - m.lag[rows, None] * (m.points[rows] @ hat(c[:3]).T + c[3:])
        return float(np.linalg.norm(np.linalg.solve(W.sum(axis=0), times_vectors(W, gap).sum(axis=0))))

    def moves(self, test: float, away: float) -> bool:
        """Whether it moved for certain, by a χ²(6) above `limit` of `test`, and went farther than `away` [m]."""
        return bool(self.test > limit(test, len(self.members)) and self.away > away)


@dataclass(frozen=True, eq=False)
class Scene:
    """What the displacements say."""

    groups: list[Group]  # those that moved on their own, the clearest first
    alone: Array  # χ²(3) of every track's displacement against the rest's common motion (N,)
    common: Array  # the motion ξ (6,) of the rest in a frame, by the error of the camera's motion
    covariance: Array  # its covariance (6, 6)

    @property
    def rest(self) -> BoolArray:
        """Which tracks are in no group (N,)."""
        rest = np.ones(len(self.alone), bool)
        for group in self.groups:
            rest[group.members] = False
        return rest


def moved_in(body: Body | None, tracks: Tracks, rows: IndexArray, frame: Frame) -> Displacements:
    """How far tracks (N,) went in the world, or in the axes of a body, about whose origin their points are then."""
    t, ages, eyes = tracks, frame.ages, np.ascontiguousarray(frame.poses[:, :3, 3])
    rays = t.position[rows] - frame.eye
    if body is None:
        return Displacements(rays, *displaced(t.A, t.p, t.dof, rows, ages, _RECENT, rays, eyes, frame.setup.slide))
    points, A, known = in_body_axes(body, tracks, rows)
    dof, points = np.where(known, t.dof[rows], 0).astype(np.int8), np.where(known[..., None], points, 0.0)
    inside = (t.position[rows] - body.T[:3, 3]) @ body.T[:3, :3]
    return Displacements(inside, *displaced(A, points, dof, np.arange(len(rows)), ages, _RECENT, rays, eyes, 0.0))


def places_in_view(local: Array) -> Array:
    """Where points (N, 3) in camera coordinates are seen: x/z, y/z, log z (N, 3)."""
    depth = np.maximum(local[:, 2:], 1e-9)
    return np.column_stack([local[:, :2] / depth, np.log(depth)])


def limit(test: float, size: IndexArray | int) -> Any:
    """χ²(6) from which a group of so many tracks (1 at least) moved: small ones have the heavier tails of tracks."""
    return test * (1.0 + _TAIL / size)


def classify_scene(moved: Displacements, place: Array, test: float, least: int = MIN_POINTS) -> Scene:
    """Groups of tracks that moved on their own, and every track's displacement against the rest.

    Tracks are seen at `place` (N, 3): x/z, y/z, log z; `test` is the χ²(6) from which a large group moved, and a group
    has `least` tracks. Every χ² is divided by the ratio of the rest's median to what it should be, if that is more
    than 1.
    """
    n = len(moved.d)
    if n < 3 * MIN_POINTS:
        return Scene([], np.zeros(n), np.zeros(6), np.diag(1.0 / kernels.PRIOR))
    sums = kernels.normal_equations(moved.points, moved.d, moved.W, moved.lag)
    asked = limit(test, np.maximum(np.arange(n + 1), 1))
    codes = np.sort(kernels.window_codes(place, _SIZES), axis=1)
    group, values, alone, common, information, scale = kernels.groups_apart(sums, place, codes, _SIZES, asked, least)
    heavier = tail(alone[group < 0])  # of what is in no group: before, other groups would be part of it
    groups = [
        Group(np.flatnonzero(group == k), value / heavier, moved, common) for k, value in enumerate(values.tolist())
    ]
    groups = [group for group in groups if group.test > limit(test, len(group.members))]
    return Scene(groups, alone, common, scale * heavier * np.linalg.inv(information))


def tail(alone: Array) -> float:
    """How much heavier the tail of tracks' χ²(3) is, 1 at least: small groups agree by chance then."""
    return max(1.0, quantile(alone, 0.75) / _UPPER_QUARTILE) if len(alone) else 1.0


def find_groups(
    frame: Frame, tracks: Tracks, bodies: Mapping[int, Body]
) -> tuple[dict[int | None, Scene], IndexArray, list[tuple[int | None, IndexArray]]]:
    """Test the free tracks against the world, and the tracks on bodies against these; notes in place what is in doubt.

    Returns what world (None) and bodies say, by id; rows of tracks in groups that may move; and those groups that
    moved, each with the id of the body that it is a part of, or None.
    """
    c = frame.setup.config
    least = MIN_FRAMES * frame.dt * c.min_speed
    rows, scene = _classified(frame, tracks, np.flatnonzero(tracks.found & (tracks.body < 0)))
    groups = [rows[g.members][~tracks.still[rows[g.members]]] for g in scene.groups]
    moving = [members for g, members in zip(scene.groups, groups) if g.moves(c.moves, least)]
    scenes: dict[int | None, Scene] = {None: scene}
    parts = []
    for body in bodies.values():
        if body.measured and body.proven:
            on, scenes[body.id] = _classified(frame, tracks, membership.tracks_on(body, tracks), body)
            parts += [(body.id, on[g.members]) for g in scenes[body.id].groups if g.moves(c.moves, least)]
    suspects = np.concatenate([np.zeros(0, np.intp), *groups])
    tracks.doubtful[:] = False
    tracks.doubtful[rows] = (scene.alone > kernels.FITS) & ~tracks.still[rows]
    tracks.doubtful[suspects] = True
    fit(tracks, np.flatnonzero(tracks.doubtful), frame.times, c.max_speed)
    of_parts = among(len(tracks), np.concatenate([np.zeros(0, np.intp), *(members for _, members in parts)]))
    alike = of_parts | among(len(of_parts), np.concatenate([np.zeros(0, np.intp), *moving]))
    tracks.streak[:] = np.where(alike, tracks.streak + 1, np.maximum(tracks.streak - 1, 0))
    alone = [(None, members) for members in groups if 2 * of_parts[members].sum() <= len(members)]
    return scenes, suspects, [*parts, *alone]


def lasting(group: tuple[int | None, IndexArray], tracks: Tracks, frame: Frame) -> IndexArray:
    """Those of a group's tracks that have moved alike for some frames; none where they are too few."""
    whole, members = group
    members = members[(tracks.body[members] == -1) | (tracks.body[members] == (-1 if whole is None else whole))]
    if (tracks.streak[members] >= RUN).sum() < MIN_POINTS - 1:
        return members[:0]
    return np.asarray(members[tracks.streak[members] > 0])


def _classified(frame: Frame, tracks: Tracks, rows: IndexArray, body: Body | None = None) -> tuple[IndexArray, Scene]:
    """Those of the tracks that are known well, tested in the world or in a body's axes."""
    t = tracks
    rows, place = well_known(frame.T_world_left, t.position, t.covariance, t.dof, rows, MIN_FRAMES, FARTHEST)
    return rows, classify_scene(moved_in(body, tracks, rows, frame), place, frame.setup.config.suspect)


def moving_group(frame: Frame, tracks: Tracks, members: IndexArray) -> tuple[IndexArray, Body] | None:
    """Those of the tracks `members` (K,) that lie together and move alike, and their body; None if too few or too far.

    What lies among them and rather stands still would slow them down.
    """
    members = members[compact(tracks.position[members])]
    while len(members) >= MIN_POINTS:
        body = _with_common_twist(frame, tracks, members)
        if not frame.resolves(body.middle):
            return None
        moves: BoolArray = membership.membership_test(body, tracks, members)[0] > 0
        if moves.all():
            return members, body
        members = members[moves]
    return None


def _with_common_twist(frame: Frame, tracks: Tracks, members: IndexArray) -> Body:
    """The body of tracks with the twist of ``V = v + ω × r`` that fits them best over the window.

    A prior on ω keeps the depth noise of few, close points from turning it wildly. The present twist differs from the
    mean by what a third of the window's time allows.
    """
    models = frame.setup.models
    motion = constant_velocity(tracks, members, frame.times, frame.setup.config.max_speed)
    centre = motion.position.mean(axis=0)
    J = -points_by_pose(motion.position - centre)
    JA = np.swapaxes(J, 1, 2) @ np.linalg.inv(motion.velocity_covariance)
    prior = np.repeat([models.initial_angular_velocity_sigma**-2, 1e-9], 3)
    covariance = np.linalg.inv((JA @ J).sum(axis=0) + np.diag(prior))
    twist = covariance @ (JA @ motion.velocity[:, :, None]).sum(axis=0)[:, 0]
    linear, angular = models.velocity_variance(-float(frame.times.min()) / 3.0)
    return _body_of(members, centre, twist, covariance + np.diag([angular] * 3 + [linear] * 3), frame, tracks)


def body_of_region(frame: Frame, tracks: Tracks, region: Region) -> Body:
    """The body of a followed region's tracks, with its velocity."""
    P = frame.setup.models.initial_angular_velocity_sigma**2 * np.eye(6)
    P[3:, 3:] = region.covariance[3:, 3:]
    twist, centre = np.concatenate([np.zeros(3), region.state[3:]]), tracks.position[region.rows].mean(axis=0)
    return _body_of(region.rows, centre, twist, P, frame, tracks)


def _body_of(
    members: IndexArray, centre: Array, twist: Array, covariance: Array, frame: Frame, tracks: Tracks
) -> Body:  # fmt: skip
    """A body, without an id yet, that has a twist [ω, v] (6,) of a `covariance` (6, 6) about `centre` (3,)."""
    size, stamp = frame.setup.config.size, frame.features.stamp
    body = new_body(0, centre, twist, frame.times, stamp, size, covariance)
    return membership.fitted(body, tracks, members, frame.slot)


def parting(
    setup: Setup, tracks: Tracks, now: int, eyes: Array, features: StereoFeatures, at: IndexArray, rows: IndexArray,
    T_world_left: Array,
) -> IndexArray:  # fmt: skip
    """Those of the landmarks `at` (K,), seen as features `rows`, that part from the rest of them.

    The camera was at `eyes` (W, 3) in the window's frames. Three are enough, whose displacements are nine numbers: of a
    body near the camera that begins to move, as many of its landmarks carry the camera along. In a run's first frames
    single ones part, too, and however many: what moves from the beginning on would else pull the camera along, and the
    world's axes with it.
    """
    t, free, slot = tracks, tracks.body[at] < 0, now % WINDOW
    at, rows = at[free], rows[free]
    z = measurement_rows(features.uv_left[rows], features.uv_right[rows])
    position, A, p, dof = t.position[at], t.A[at], t.p[at], t.dof[at]
    theirs = changed(t, position=position, anchor=t.anchor[at], A=A, p=p, dof=dof)
    record_in(theirs, np.arange(len(at)), setup, T_world_left, z, slot)
    local = transform(inverse(T_world_left), position)
    known = local[:, 2] > FARTHEST * np.sqrt(np.trace(t.covariance[at], axis1=1, axis2=2))
    well = known & (dof[:, slot] > 0) & (t.count(at) >= MIN_FRAMES)
    k = np.flatnonzero(well if now >= WINDOW else dof[:, slot] > 0)
    eyes, ages = eyes.copy(), (slot - np.arange(WINDOW)) % WINDOW
    eyes[slot] = T_world_left[:3, 3]
    rays = position[k] - eyes[slot]
    precise = A[k] / _PRECISE**2, p[k], dof[k], np.arange(len(k))
    moved = Displacements(rays, *displaced(*precise, ages, 1, rays, eyes, setup.slide))
    view = places_in_view(local)
    scene = classify_scene(moved, view[k], setup.config.suspect, MINIMAL_POINTS)
    if now < WINDOW:
        return at[k[~scene.rest | (scene.alone > kernels.FITS * tail(scene.alone[scene.rest]))]]
    if (~scene.rest).sum() > kernels.LARGEST * len(k):  # it is rather the poses before that were wrong
        return at[:0]
    parts = among(len(at), k[~scene.rest])
    for group in scene.groups:  # what is not known well and lies among them moves as they do
        low, high = view[k[group.members]].min(axis=0), view[k[group.members]].max(axis=0)
        beyond = 0.5 * (high - low)
        parts |= ~well & (local[:, 2] > 0) & ((view > low - beyond) & (view < high + beyond)).all(axis=1)
    return at[parts]
