"""Finding bodies: groups of tracks that move on their own, and the body that one of them makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from slam.bodies import membership
from slam.bodies.bodies import Body, in_body_axes, new_body
from slam.bodies.fits import constant_velocity, fit_velocities
from slam.bodies.frame import Frame
from slam.bodies.points import compact
from slam.bodies.regions import Region
from slam.bodies.scene import LAG, Scene, classify_scene, displacements, known_well
from slam.data import BoolArray, IndexArray
from slam.geometry.arrays import among
from slam.geometry.se3 import Array, points_by_pose
from slam.tracks.table import Tracks

_ROUNDS = 3  # of leaving out what rather stands still, and fitting again
_FAR = 3.0  # so many times the median distance from the median point is no part of a new body


def find_groups(
    frame: Frame, tracks: Tracks, bodies: Mapping[int, Body]
) -> tuple[Scene, IndexArray, list[tuple[int | None, IndexArray]]]:
    """Test the free tracks against the world, and the tracks on bodies against these; notes in place what is in doubt.

    What moves otherwise than the body on which it lies is a part of that.

    Returns:
        the still world, as it appears to move; rows of tracks in groups that may move; and those that have moved alike
        for some frames, each group with the id of the body that it is a part of, or None.
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
    members = members[compact(tracks.position[members], _FAR)]
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
    """Tracks with the twist that fits them best.

    Velocities of a rigid body's points are ``V = v + ω × r``, linear in [ω, v]. Without a prior the depth noise of few,
    close points would turn it wildly. The twist is the mean over the window: the present one differs by what a third of
    its time allows.
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
