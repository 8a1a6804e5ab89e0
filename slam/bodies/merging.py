"""Bodies that turn out to be one: a part that was found by itself, or the piece of it that was seen first.

What lies in the extent of an older body and went with it is a part of it. A young body that shows more of a thing than
the older one takes that one's place.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.bodies import membership
from slam.bodies.bodies import Body, continued
from slam.geometry.se3 import inverse
from slam.tracks.table import Tracks

_MERGES = 24  # frames in which a body turns out to be a part of another at once; later after so many
_DISTINCT = 2.0  # distinctness from which two bodies are never one: they are asked in every frame


def merge(bodies: dict[int, Body], tracks: Tracks) -> None:
    """Merge bodies that move as an older one does, in place: young ones at once, others only if that lasts.

    It has to last because the parts of an articulated body move alike now and then. If fewer members of the older
    body are seen, that one is merged into the younger.
    """
    for id in sorted(bodies, reverse=True):
        body = bodies.get(id)  # it may have taken the place of another
        if body is None or not body.measured:
            continue
        mine = _members(tracks, id)
        whole = bodies.get(-1 if body.apart_from is None else body.apart_from)
        if whole is not None and whole.measured and whole.id not in body.distinct:
            body = bodies[id] = _told_apart(body, mine, whole, _members(tracks, whole.id), tracks)
        older = {id: b for id, b in bodies.items() if id < body.id and id not in body.distinct}
        whole = membership.body_around(older, tracks, mine, body)
        alike = body.alike + 1 if whole is not None else 0
        body = bodies[id] = replace(body, alike=alike) if alike != body.alike else body
        young = body.seen < _MERGES and (whole is None or whole.id != body.apart_from)
        if whole is not None and (young or alike > _MERGES):
            membership.add_members(whole, tracks, mine, sure=True)
            del bodies[id]
            tracks.give_up(np.flatnonzero(tracks.body == id))
        elif whole is None and young:
            _outgrow(bodies, body, list(older.values()), tracks)


def _outgrow(bodies: dict[int, Body], body: Body, older: list[Body], tracks: Tracks) -> None:
    """Let a young body replace older ones with the same motion of which fewer members are seen."""
    for known in older:
        mine, theirs = _members(tracks, body.id), _members(tracks, known.id)
        if not known.measured or known.id == body.apart_from or len(theirs) >= len(mine):
            continue
        if math.dist(body.middle, known.middle) > body.across + known.across:
            continue
        if not membership.moves_with(body, tracks, theirs):
            continue
        body = bodies[body.id] = _told_apart(body, mine, known, theirs, tracks)
        if known.id not in body.distinct and membership.distinctness(body, mine, known, theirs, tracks) < 1.0:
            bodies[known.id] = _in_place_of(known, body, theirs, tracks)
            tracks.body[tracks.body == body.id] = known.id
            del bodies[body.id]
            return


def _told_apart(body: Body, mine: NDArray[np.intp], other: Body, theirs: NDArray[np.intp], tracks: Tracks) -> Body:
    """A body that knows of another one, if their seen members have moved apart by now: they are never one again."""
    apart = membership.distinctness(body, mine, other, theirs, tracks) > _DISTINCT
    return replace(body, distinct=body.distinct | {other.id}) if apart else body


def _in_place_of(known: Body, body: Body, mine: NDArray[np.intp], tracks: Tracks) -> Body:
    """A body under the id of a known one that is a part of it; its seen members `mine` go over."""
    tracks.give_up(np.flatnonzero((tracks.body == known.id) & ~tracks.found))
    grown = continued(body, known)
    own = np.flatnonzero(tracks.body == body.id)
    membership.take_to(tracks, own, inverse(grown.T) @ body.T)
    membership.add_members(grown, tracks, mine, sure=True)
    return grown


def _members(tracks: Tracks, id: int) -> NDArray[np.intp]:
    """Rows of a body's seen members."""
    return np.flatnonzero((tracks.body == id) & tracks.found)
