"""Groups of tracks that move on their own: before the update, and after it, when they make a body.

A near body that starts to move would carry the camera along. Points of a far wall hardly tell a step sideways from a
turn, and three points before it decide. So before each update the landmarks found in a frame are compared with where
their tracks saw them: those that lie together, and whose motion is not that of the rest, are two explanations of one
frame, by the camera's motion and by theirs. The camera keeps with the rest, which is wider spread, and the covariance
of its pose grows by what the withheld measurements would have told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from slam.bodies import membership
from slam.bodies.belief import compact
from slam.bodies.bodies import Body, in_body_axes, new_body
from slam.bodies.fits import constant_velocity, fit_velocities, measure
from slam.bodies.frame import Frame, Setup
from slam.bodies.regions import Region
from slam.bodies.scene import (
    FARTHEST,
    LAG,
    Displacements,
    Scene,
    classify_scene,
    displacements,
    known_well,
    places_in_view,
    tail,
)
from slam.bodies.scene_kernels import LARGEST
from slam.bodies.track_kernels import fit_fixed_points, inverses
from slam.data import BoolArray, IndexArray, StereoFeatures
from slam.geometry.arrays import among
from slam.geometry.pnp import measurement_rows
from slam.geometry.se3 import Array, inverse, points_by_pose, transform
from slam.tracks.table import Tracks

_ROUNDS = 3  # of leaving out what rather stands still, and fitting again
_AROUND = 0.5  # of a group's extent in view, how far beyond it landmarks of unknown motion are taken for a part of it
_LEAST_NOISE = 0.05  # [px] of a pixel from frame to frame: correlation finds it no better; errors of the rig are below
_RIDGE = 1e-6  # numerics: share of the trace


def find_groups(
    frame: Frame, tracks: Tracks, bodies: Mapping[int, Body]
) -> tuple[Scene, IndexArray, list[tuple[int | None, IndexArray]]]:
    """Test the free tracks against the world, and the tracks on bodies against these; notes in place what is in doubt.

    Returns the still world, as it appears to move; rows of tracks in groups that may move; and those groups that moved,
    each with the id of the body that it is a part of, or None.
    """
    c = frame.setup.config
    least = LAG * frame.dt * c.min_speed
    rows, scene = _classified(frame, tracks, np.flatnonzero(tracks.found & (tracks.body < 0)))
    groups = [rows[g.members][~tracks.still[rows[g.members]]] for g in scene.groups]
    moving = [members for g, members in zip(scene.groups, groups) if g.moves(c.group_test, least)]
    parts = [
        (body.id, on[g.members])
        for body in bodies.values()
        if body.measured and body.proven
        for on, test in [_classified(frame, tracks, membership.tracks_on(body, tracks, c.margin), body)]
        for g in test.groups
        if g.moves(c.group_test, least)
    ]
    suspects = np.concatenate([np.zeros(0, np.intp), *groups])
    tracks.doubtful[:] = False
    tracks.doubtful[rows] = (scene.alone > c.doubtful) & ~tracks.still[rows]
    tracks.doubtful[suspects] = True
    fit_velocities(tracks, np.flatnonzero(tracks.doubtful), frame.times, c.max_speed)
    of_parts = among(len(tracks), np.concatenate([np.zeros(0, np.intp), *(members for _, members in parts)]))
    alike = of_parts | among(len(tracks), np.concatenate([np.zeros(0, np.intp), *moving]))
    tracks.streak[:] = np.where(alike, tracks.streak + 1, np.maximum(tracks.streak - 1, 0))
    alone = [(None, members) for members in groups if 2 * of_parts[members].sum() <= len(members)]
    return scene, suspects, [*parts, *alone]


def lasting(group: tuple[int | None, IndexArray], tracks: Tracks, frame: Frame) -> IndexArray:
    """Those of a group's tracks that have moved alike for some frames; none where they are too few."""
    whole, members = group
    c = frame.setup.config
    members = members[(tracks.body[members] == -1) | (tracks.body[members] == (-1 if whole is None else whole))]
    if (tracks.streak[members] >= c.confirm).sum() < c.min_support - 1:
        return members[:0]
    return np.asarray(members[tracks.streak[members] > 0])


def _classified(frame: Frame, tracks: Tracks, rows: IndexArray, body: Body | None = None) -> tuple[IndexArray, Scene]:
    """Those of the tracks that are known well, tested in the world or in a body's axes."""
    c = frame.setup.config
    rows, place = known_well(tracks, rows, frame.T_world_left, c.min_frames)
    inside = None if body is None else in_body_axes(body, tracks, rows)
    moved = displacements(tracks, rows, frame.ages, frame.poses[:, :3, 3], frame.setup.slide, inside)
    if body is not None:
        moved = replace(moved, points=(tracks.position[rows] - body.T[:3, 3]) @ body.T[:3, :3])
    return rows, classify_scene(moved, place, c.suspect, c.min_support)


@dataclass(frozen=True, eq=False)
class MovingGroup:
    """Tracks that move alike."""

    members: IndexArray  # their rows (K,)
    centre: Array  # the point (3,) that the twist is about [m], world coordinates
    twist: Array  # [ω, v] (6,) at the centre [rad/s, m/s]
    covariance: Array  # of the twist (6, 6)

    def body(self, id: int, frame: Frame, tracks: Tracks) -> Body:
        """A new body with the group's twist, fitted to its tracks."""
        size, stamp = frame.setup.config.size, frame.features.stamp
        body = new_body(id, self.centre, self.twist, frame.times, stamp, size, self.covariance)
        return membership.fitted(body, tracks, self.members, frame.slot)


def moving_group(frame: Frame, tracks: Tracks, members: IndexArray) -> MovingGroup | None:
    """Those of the tracks `members` (K,) that lie together and move alike; None if they are too few or too far."""
    members = members[compact(tracks.position[members])]
    for _ in range(_ROUNDS + 1):
        if len(members) < frame.setup.config.min_support:
            return None
        group = _with_common_twist(frame, tracks, members)
        if not frame.resolves(group.centre):
            return None
        moves: BoolArray = membership.membership_test(group.body(0, frame, tracks), tracks, members).gain > 0
        if moves.all():
            break
        members = members[moves]  # what lies among them and rather stands still slows them down
    return group


def _with_common_twist(frame: Frame, tracks: Tracks, members: IndexArray) -> MovingGroup:
    """Tracks with the twist of ``V = v + ω × r`` that fits them best over the window.

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
    return MovingGroup(members, centre, twist, covariance + np.diag([angular] * 3 + [linear] * 3))


def region_group(frame: Frame, tracks: Tracks, region: Region) -> MovingGroup:
    """A followed region's tracks, with its velocity."""
    P = frame.setup.models.initial_angular_velocity_sigma**2 * np.eye(6)
    P[3:, 3:] = region.covariance[3:, 3:]
    twist = np.concatenate([np.zeros(3), region.state[3:]])
    return MovingGroup(region.rows, tracks.position[region.rows].mean(axis=0), twist, P)


def parting(
    setup: Setup, tracks: Tracks, now: int, features: StereoFeatures, at: IndexArray, rows: IndexArray,
    T_world_left: Array,
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Which landmarks `at` (K,), seen as features `rows`, part from the rest, or are too young and lie among those.

    And which moved since they were first seen, in a run's first frames, in which means of tracks are no better: what
    moves from the beginning on would else pull the camera along, and the world's axes with it.
    """
    c, t = setup.config, tracks
    parts, moved = np.zeros((2, len(at)), bool)
    z = measurement_rows(features.uv_left[rows], features.uv_right[rows])
    mine = np.flatnonzero((t.body[at] < 0) & (t.count(at) >= c.min_frames))
    position, covariance = np.empty_like(t.position), np.empty_like(t.covariance)
    fit_fixed_points(t.A, t.p, t.anchor, at[mine], position, covariance)
    ages, seen = 1 + (now - 1 - np.arange(c.window)) % c.window, t.dof[at[mine]] > 0
    age = (seen @ ages) / np.maximum(seen.sum(axis=1), 1)
    mean = position[at[mine]], covariance[at[mine]]
    known, view, scene = _compared(setup, T_world_left, *mean, age, z[mine], FARTHEST)
    young = np.setdiff1d(np.arange(len(at)), mine[known])
    local = transform(inverse(T_world_left), t.position[at[young]])
    young, place = young[local[:, 2] > 0], places_in_view(local[local[:, 2] > 0])
    few = (~scene.rest).sum() <= LARGEST * len(known)  # else it is rather the poses before that were wrong
    for group in scene.groups if few else ():
        parts[mine[known[group.members]]] = True
        low, high = view[group.members].min(axis=0), view[group.members].max(axis=0)
        beyond = _AROUND * (high - low)
        parts[young] |= ((place > low - beyond) & (place < high + beyond)).all(axis=1)
    if now < c.window:  # slots are frames
        first = (t.dof[at] > 0).argmax(axis=1)
        was = inverses(t.A[at, first], _RIDGE, 0.0)
        known, _, scene = _compared(setup, T_world_left, t.anchor[at], was, now - first.astype(float), z, 0.0)
        moved[known] = ~scene.rest | (scene.alone > c.doubtful * tail(scene.alone[scene.rest]))
    return parts, moved


def _compared(
    setup: Setup, T_world_left: Array, before: Array, P: Array, age: Array, z: Array, far: float
) -> tuple[IndexArray, Array, Scene]:
    """How points `before` (N, 3), of covariances P (N, 3, 3), have moved in `age` (N,) frames to pixels z (N, 3).

    Those whose depth is more than `far` deviations (K,), where the camera saw them (K, 3), and the groups among them,
    in the noise of the rest.
    """
    c = setup.config
    points, A, dof = measure(setup.rig, T_world_left, before, z, setup.sigma)
    local = transform(inverse(T_world_left), before)
    known = np.flatnonzero((dof > 0) & (local[:, 2] > far * np.sqrt(np.trace(P, axis1=1, axis2=2))))
    W = inverses(inverses(A[known], _RIDGE, 0.0) + P[known], _RIDGE, 0.0)
    moved = Displacements(before[known] - T_world_left[:3, 3], (points - before)[known], W, age[known])
    view = places_in_view(local[known])
    return known, view, classify_scene(moved, view, c.suspect, c.min_support, (_LEAST_NOISE / setup.sigma) ** 2)
