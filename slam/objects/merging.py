"""Bodies that turn out to be one: one motion explains the tracks of both as well as two motions do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.data import IndexArray
from slam.geometry.se3 import inverse
from slam.objects import membership
from slam.objects.bodies import Body, continued
from slam.objects.tracks import Tracks

_MERGES = 24  # frames in which a body turns out to be a part of another at once; later after so many
_DISTINCT = 2.0  # distinctness from which a part is never one with its whole again


def merge(bodies: dict[int, Body], tracks: Tracks) -> None:
    """Merge bodies that move alike under the older one's id, in place: young ones at once, others only if that lasts.

    It has to last because the parts of an articulated body move alike now and then. What more tracks show is the motion
    of both.
    """
    for id in sorted(bodies, reverse=True):
        body = bodies[id]
        if not body.measured:
            continue
        mine = _members(tracks, id)
        whole = bodies.get(-1 if body.apart_from is None else body.apart_from)
        if whole is not None and whole.measured and not body.distinct:
            apart = membership.distinctness(body, mine, whole, _members(tracks, whole.id), tracks) > _DISTINCT
            body = bodies[id] = replace(body, distinct=apart)
        for known in [other for other in bodies.values() if other.id < id and other.measured]:
            if body.distinct and known.id == body.apart_from:
                continue
            theirs = _members(tracks, known.id)
            larger = (known, theirs, body, mine) if len(theirs) >= len(mine) else (body, mine, known, theirs)
            if not membership.are_one(*larger, tracks):
                continue
            body = bodies[id] = replace(body, alike=body.alike + 1)
            young = body.seen < _MERGES and known.id != body.apart_from
            if young or body.alike > _MERGES:
                _unite(bodies, body, mine, known, theirs, tracks)
            break
        else:
            bodies[id] = replace(body, alike=0) if body.alike else body


def _unite(
    bodies: dict[int, Body], body: Body, mine: IndexArray, known: Body, theirs: IndexArray, tracks: Tracks
) -> None:
    """Make one body of two, in place, under the id of the known one."""
    del bodies[body.id]
    if len(theirs) >= len(mine):
        bodies[known.id] = membership.with_reach(known, tracks, mine)
        membership.add_members(bodies[known.id], tracks, mine, sure=True)
        tracks.give_up(np.flatnonzero(tracks.body == body.id))
        return
    tracks.give_up(np.flatnonzero((tracks.body == known.id) & ~tracks.seen))
    grown = bodies[known.id] = continued(body, known)
    own = np.flatnonzero(tracks.body == body.id)
    membership.take_to(tracks, own, inverse(grown.T) @ body.T)
    membership.add_members(grown, tracks, theirs, sure=True)
    tracks.body[own] = known.id


def _members(tracks: Tracks, id: int) -> IndexArray:
    """Rows of a body's seen members."""
    return np.flatnonzero((tracks.body == id) & tracks.seen)
