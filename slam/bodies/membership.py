"""Which tracks belong to a body, which features lie on it, and which bodies are one.

A track's measurements are compared with a fixed point in the world and with a fixed point in the body. The difference
of the two χ² over the window, a log-likelihood ratio, decides. What lies in the extent of an older body and went with
it is a part of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from slam.bodies.bodies import Body, hidden, in_body_axes, of_bodies, with_extent
from slam.bodies.body_kernels import distances_from_box, improve_members, membership_squares, weighted_means
from slam.bodies.config import CLEAR, EXPLAINED, MIN_FRAMES, RUN, WINDOW
from slam.bodies.fits import fit_positions, times_vectors
from slam.bodies.frame import Frame
from slam.bodies.track_kernels import LEAST
from slam.chi_square import SIGMAS, chi_square_limit, chi_square_limits
from slam.data import BoolArray, IndexArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array, exp, points_by_pose, transform
from slam.tracks.table import Tracks

MARGIN = 0.25  # how far from a body's extent its further features may lie, as a share of the extent's diagonal
_ROUNDS = 3  # numerics: of fitting poses and points in turn
_OFF = 0.2  # how far a pose may be from a constant velocity, before anything is known [rad] and [m]
_NEAR = SIGMAS**2  # of the distance from a body's extent up to which a track may join
_LOOSE = 4.0  # times the 99 % limit that the χ² of a member may be whose motion is explained for the most part
_DISTINCT = 2.0  # distinctness from which two bodies are never one: they are asked in every frame


def membership_test(body: Body, tracks: Tracks, rows: IndexArray) -> tuple[Array, BoolArray, IndexArray]:
    """Compare the fit of tracks (N,) to a body with that to the still world, over the window.

    By how much χ² the body explains them better, whether it explains them at all, and the frames that say so (N,) each.
    """
    (fixed, still), (count, numbers) = _squares(body, tracks, rows)
    limit = _limits(3 * WINDOW)[np.maximum(numbers - 3, 1)]
    fits = (fixed < limit) | ((fixed < EXPLAINED * still) & (fixed < _LOOSE * limit))
    return still - fixed, fits, count


def _squares(body: Body, tracks: Tracks, rows: IndexArray) -> tuple[Array, IndexArray]:
    """χ² of "one fixed point" in a body and in the world (2, N), and the slots and numbers that they are of (2, N)."""
    t = tracks
    found, counts = membership_squares(t.A, t.p, t.dof, t.anchor, rows, body.history, body.known)
    return found.T, counts.T


@cache
def _limits(most: int) -> Array:
    """99 % limits of χ² for 0 to `most` degrees of freedom."""
    return chi_square_limits(np.arange(most + 1), 0.99)


def fitted(body: Body, tracks: Tracks, rows: IndexArray, slot: int) -> Body:
    """A new body with its poses over the window, which were those of a constant velocity, fitted to tracks."""
    body = _with_poses_fitted(changed(body, known=np.asarray(tracks.dof[rows].any(axis=0))), tracks, rows)
    points, A, _ = in_body_axes(body, tracks, rows)
    return with_extent(changed(body, T=body.history[slot]), weighted_means(points, A))


def _with_poses_fitted(body: Body, tracks: Tracks, rows: IndexArray) -> Body:
    """A body with its poses over the window fitted to what tracks measured."""
    for _ in range(_ROUNDS):
        points, A, _ = in_body_axes(body, tracks, rows)
        y = weighted_means(points, A)
        J = -points_by_pose(y)
        JA = np.swapaxes(J, 1, 2)[:, None] @ A
        normal = (JA @ J[:, None]).sum(axis=0) + _OFF**-2 * np.eye(6)
        right = times_vectors(JA, points - y[:, None]).sum(axis=0)
        body = changed(body, history=body.history @ exp(np.linalg.solve(normal, right[..., None])[..., 0]))
    return body


def add_members(body: Body, tracks: Tracks, rows: IndexArray, sure: bool = False) -> None:
    """Make tracks members of a body, in place; their points in it are what they measured over the window."""
    points, A, _ = in_body_axes(body, tracks, rows)
    tracks.body[rows], tracks.misfit[rows], tracks.streak[rows], tracks.doubtful[rows] = body.id, 0, 0, False
    tracks.local[rows], tracks.local_information[rows] = weighted_means(points, A), A.sum(axis=1)
    tracks.sure[rows] = sure


def remove_members(tracks: Tracks, rows: IndexArray, body: Body) -> None:
    """Make members free tracks without measurements, in place."""
    tracks.position[rows] = transform(body.T, tracks.local[rows])
    tracks.forget_past(rows)
    tracks.unfound[rows] = 1


def update_members(every: Mapping[int, Body], frame: Frame, tracks: Tracks) -> dict[int, tuple[Array, int]]:
    """Add the tracks that fit a measured body to its members, and remove those that do not, in place.

    Inside a body no proof of motion is needed. Returns by how much χ² each body explains its seen members better than
    the still world (K,), and for how many others the still world is clearly better: inside it, and behind one that is
    not proven, through which nothing should be seen.
    """
    said: dict[int, tuple[Array, int]] = {}
    bodies = {id: body for id, body in every.items() if body.measured}
    for body in bodies.values():
        _improve(body, tracks, frame.slot)
    kept = {body.id: _expel(body, tracks) for body in bodies.values()}
    free = np.flatnonzero((tracks.body < 0) & tracks.found)
    free = free[tracks.count(free) >= 2]
    best, whose = np.full(len(free), -np.inf), np.full(len(free), -1)
    for body in bodies.values():
        near = np.flatnonzero(_distances(body, tracks, free, MARGIN) < _NEAR)
        gain, against = _gain_of_joining(body, tracks, free[near])
        if not body.proven:
            behind = free[hidden([body], frame.eye, tracks.position[free])]
            against += int((membership_test(body, tracks, behind)[0] < -CLEAR).sum())
        said[body.id] = kept[body.id], against
        better = gain > best[near]
        best[near[better]], whose[near[better]] = gain[better], body.id
    for body in bodies.values():
        mine = free[whose == body.id]
        streak = tracks.streak[mine]
        add_members(body, tracks, mine)
        tracks.streak[mine] = streak  # they may be of a part that is about to be found
    return said


def _gain_of_joining(body: Body, tracks: Tracks, rows: IndexArray) -> tuple[Array, int]:
    """By how much χ² a body explains tracks (N,) better than the still world; −∞ for those that may not join it.

    And how many of them stand still inside it.
    """
    away = _distances(body, tracks, rows, 0.0)
    inside = away < _NEAR
    proof = tracks.expelled[rows]
    gain, fits, count = membership_test(body, tracks, rows)
    better = gain > np.where(inside & ~proof, -body.solid, CLEAR)
    joins = better & fits & (count >= np.where(proof, MIN_FRAMES, 2)) & ~tracks.still[rows]
    against = (away == 0.0) & (gain < -CLEAR)
    return np.where(joins, gain, -np.inf), int(against.sum())


def _expel(body: Body, tracks: Tracks) -> Array:
    """Remove members that do not fit the body, in place.

    Returns the gains of the seen ones that stay (K,), less what the body's poses, fitted to them, gain by chance.
    """
    mine = np.flatnonzero(tracks.body == body.id)
    (gain, fits, count), seen = membership_test(body, tracks, mine), tracks.found[mine]
    most_fit = 2 * fits[seen].sum() > seen.sum()  # else it is the body's pose that is wrong
    unfit = ~fits & (count >= MIN_FRAMES) & most_fit
    stays = tracks.still[mine] & (body.moving | ~tracks.sure[mine])
    wrong = stays | (tracks.misfit[mine] >= RUN) | (seen & ((gain < -CLEAR) | unfit))
    tracks.sure[mine] |= fits & (gain > CLEAR)
    remove_members(tracks, mine[wrong & ~seen], body)
    tracks.expelled[mine[wrong]] = True
    left = mine[wrong & seen]  # these keep their measurements
    tracks.body[left], tracks.misfit[left], tracks.streak[left] = -1, 0, 0
    fit_positions(tracks, left)
    stay = seen & ~wrong
    return gain[stay] - 6.0 * float(body.known.sum()) / max(int(stay.sum()), 1)


def tracks_on_bodies(bodies: Mapping[int, Body], tracks: Tracks) -> tuple[IndexArray, IndexArray]:
    """Rows of seen tracks on a proven body, members or inside its extent, and of those that may lie on any body."""
    on = tracks.found & of_bodies(tracks, (body for body in bodies.values() if body.proven))
    near = tracks.found & (tracks.body >= 0) & ~on
    free = np.flatnonzero(tracks.found & (tracks.body < 0) & ~tracks.still)
    for body in bodies.values():
        if not body.measured:
            continue
        close = free[_distances(body, tracks, free, MARGIN) < _NEAR]
        near[close] = True
        inside = close[_distances(body, tracks, close, 0.0) < _NEAR]
        if len(inside) and body.proven:
            asked = np.where(tracks.expelled[inside], CLEAR, -body.solid)
            on[inside[membership_test(body, tracks, inside)[0] > asked]] = True
    return np.flatnonzero(on), np.flatnonzero(near & ~on)


def tracks_on(body: Body, tracks: Tracks) -> IndexArray:
    """Rows of the seen tracks that belong to a body, or lie on or near it and belong to none."""
    free = np.flatnonzero(tracks.found & (tracks.body < 0))
    near = free[_distances(body, tracks, free, MARGIN) < _NEAR]
    return np.concatenate([np.flatnonzero(tracks.found & (tracks.body == body.id)), near])


def reappeared(bodies: Mapping[int, Body], new: Body, max_speed: float, whole: int | None = None) -> Body | None:
    """The body out of view that a new one is, by position and velocity, perhaps seen from another side; else None.

    The middle of what is seen may be off the body's by half its size, and no body is faster than `max_speed` [m/s]. The
    place of one that is gone says nothing, as it may be anywhere: it is known by its looks alone. But a part of a
    `whole` is one that was known of it.
    """
    best, least = None, chi_square_limit(6, 0.99)
    for body in bodies.values():
        if body.measured or not body.proven or (body.gone if whole is None else body.apart_from != whole):
            continue
        gap = new.middle - body.middle
        reach = 0.5 * (body.across + new.across) + max_speed * (new.seen_at - body.seen_at)
        J = -body.T[:3, :3] @ points_by_pose(0.5 * (body.lower + body.upper)[None])[0]
        place = J @ body.covariance @ J.T + (body.across**2 + new.across**2) / 12.0 * np.eye(3)
        change = new.velocity[3:] - body.velocity[3:]
        velocity = (new.velocity_covariance + body.velocity_covariance)[3:, 3:]
        off = float(gap @ np.linalg.solve(place, gap) + change @ np.linalg.solve(velocity, change))
        if np.linalg.norm(gap) <= reach and off < least:
            best, least = body, off
    return best


def distinctness(one: Body, ones: IndexArray, other: Body, others: IndexArray, tracks: Tracks) -> float:
    """How far tracks of two bodies are from having moved like one rigid body; from 1 on they have not.

    The increase of χ² if all share the poses of one, relative to its 99 % limit.
    """
    both = one.known & other.known
    one, other = changed(one, known=both), changed(other, known=both)

    def left(body: Body, rows: IndexArray) -> float:
        return float(_squares(_with_poses_fitted(body, tracks, rows), tracks, rows)[0][0].sum())

    every = np.concatenate([ones, others])
    more = left(one, every) - left(one, ones) - left(other, others)
    return more / chi_square_limit(6 * max(int(both.sum()), 1), 0.99)


def _distances(body: Body, tracks: Tracks, rows: IndexArray, margin: float) -> Array:
    """Squared distances (N,) of tracks from a body's extent, widened by a share `margin`, in their own noise."""
    wider = margin * body.across
    found: Array = distances_from_box(
        body.T, body.lower - wider, body.upper + wider, tracks.position, tracks.covariance, rows
    )
    return found


def _improve(body: Body, tracks: Tracks, slot: int) -> None:
    """Take this frame's measurements into the members' points, in place."""
    t = tracks
    mine = np.flatnonzero((t.body == body.id) & (t.misfit == 0) & (t.dof[:, slot] > 0))
    improve_members(body.T, t.A, t.p, t.anchor, mine, slot, t.local, t.local_information)


def merge(bodies: dict[int, Body], tracks: Tracks) -> None:
    """Make one of two bodies that have moved as one, in place, under the older id.

    Young bodies are merged at once; old ones, and parts of the other, only if that lasts: the parts of an articulated
    body move alike now and then. What has clearly moved apart once is never one again.
    """
    for id in sorted(bodies, reverse=True):
        body, mine, whole = bodies[id], _members(tracks, id), None
        if not body.measured:
            continue
        for other in [b for b in bodies.values() if b.id < id and b.measured and b.id not in body.distinct]:
            apart = _apart(body, mine, other, _members(tracks, other.id), tracks)
            if apart > _DISTINCT:
                body = changed(body, distinct=body.distinct | {other.id})
            elif apart < 1.0 and whole is None:
                whole = other
        body = bodies[id] = changed(body, alike=0 if whole is None else body.alike + 1)
        if whole is None or not (body.alike > 2 * WINDOW or (body.seen < 2 * WINDOW and whole.id != body.apart_from)):
            continue
        add_members(whole, tracks, mine, sure=True)
        tracks.give_up(np.flatnonzero(tracks.body == id))
        del bodies[id]


def _apart(body: Body, mine: IndexArray, other: Body, theirs: IndexArray, tracks: Tracks) -> float:
    """How far a body is from being one with an older one, see `distinctness`: below 1 it is, from 1 on it may not be.

    The one of which more is seen must explain the other, which lies in or beside it. A fresh body is no more than that.
    """
    part, larger = other.id == body.apart_from, len(theirs) >= len(mine)
    whole, few, rows = (other, body, mine) if larger else (body, other, theirs)
    near = _distances(whole, tracks, rows, 2.0 * MARGIN * (1.0 + few.across / whole.across)) < _NEAR
    beside = 2 * near.sum() > len(rows)
    fixed, still = _squares(whole, tracks, rows)[0].sum(axis=1)
    left = fixed / max(still, LEAST)
    explained = beside and left < 2 * EXPLAINED  # as a share of the χ² of "still"
    if explained and larger and not part and body.seen <= WINDOW:
        return 0.0
    if not (explained or part):
        return 1.0
    apart = distinctness(body, mine, other, theirs, tracks)
    return apart if explained else max(apart, 1.0)


def _members(tracks: Tracks, id: int) -> IndexArray:
    """Rows of a body's seen members."""
    return np.flatnonzero((tracks.body == id) & tracks.found)
