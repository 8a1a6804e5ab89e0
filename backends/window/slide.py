"""The window moves on: poses leave, and what they have measured becomes part of the prior."""

from __future__ import annotations

import numpy as np

from backends.window.state import Left, WindowConfig, WindowState
from slam.data import BoolArray
from slam.geometry.arrays import among, changed
from slam.window.marginal import marginalised
from slam.window.problem import Window
from slam.window.stereo import Field, RectifiedStereo


def problem(s: WindowState, stereo: RectifiedStereo) -> Window:
    """The state as a problem for the solver; landmarks without measurements take no part."""
    marks = s.landmarks
    return Window(
        stereo, s.poses, marks.position, s.rows, mean=marks.mean, information=marks.information, places=s.places,
        motion=s.motion, prior=s.prior,
    )  # fmt: skip


def slid(s: WindowState, stereo: RectifiedStereo, config: WindowConfig, field: Field) -> WindowState:
    """The state with two poses less at once, which takes hardly longer than one.

    The oldest pose is the one that the prior is relative to, and stays for some frames; the next ones leave. Landmarks
    that they have measured join the prior, if they are still measured: they keep their covariance with all the others.
    Those that nothing will measure again leave with all their measurements, and so do landmarks beyond the prior's
    limit, which are then estimated afresh. Raises LinAlgError where the information of what leaves is not positive
    definite.
    """
    K, oldest = len(s.frames), 0 if s.frames[-1] - s.frames[0] > config.reference else 1
    # landmarks are known relative to the pose that was solved for; the last two poses say how the camera moves
    leaving = [k for k in range(oldest, K - 1) if k != s.solved][: min(2, K - 2)]
    gone = among(K, np.array(leaving))
    marks, rows, places, count = s.landmarks, s.rows, s.places, len(s.landmarks)
    its_rows, its_places = gone[rows.pose], gone[places.pose]
    known = among(count, places.point[its_places])
    sights = np.bincount(rows.point[its_rows], minlength=count)
    here = known | (sights > 0)
    there, member = among(count, rows.point[~its_rows]), among(count, s.prior.points)
    alive = marks.ids >= 0

    new = here & ~member & (there | known | (marks.information[:, 0, 0] > 0))
    joins, ends = new & alive, (new | member) & ~alive | here & ~member & ~new & (sights > 1)
    surplus = int((member & alive).sum() + joins.sum()) - config.landmarks
    if surplus > 0:
        ends, joins = _without_oldest(surplus, s, member & alive, joins, ends, there)
    taken_rows = its_rows & (member | joins)[rows.point] | ends[rows.point]
    taken_places = its_places | ends[places.point]
    moves = (gone[s.motion.poses] & (s.motion.poses >= 0)).any(axis=1)
    w = changed(
        problem(s, stereo), rows=rows.select(taken_rows), places=places.select(taken_places),
        motion=s.motion.select(moves), joining=np.flatnonzero(joins),
        information=np.where((member | joins | ends)[:, None, None], marks.information, 0.0),
    )  # fmt: skip
    ending, stays = ends[s.prior.points], ~gone
    prior, conditional, cost = marginalised(w, leaving, ending, field(w.rows.z))
    end, stay = s.prior.points[ending], prior.points
    left = Left(
        s.frames[gone], s.poses[gone], marks.serial[end], marks.position[end], s.frames[stays], s.poses[stays],
        marks.serial[stay], marks.position[stay], conditional,
    )  # fmt: skip
    rows, places = rows.select(~taken_rows & ~its_rows), places.select(~taken_places)
    motion = s.motion.select(~moves)
    index = np.arange(count)
    used = alive | among(count, np.concatenate([rows.point, places.point, stay]))
    free = marks.information
    if (joins | ends).any():
        free = np.where((joins | ends)[:, None, None], 0.0, free)
    marks = changed(marks, information=free)
    if not used.all():  # landmarks that were removed take no part any more
        index, marks = np.cumsum(used) - 1, marks.select(used)
    each, place = np.repeat(stays, 6), np.cumsum(stays) - 1
    return changed(
        s, frames=s.frames[stays], stamps=s.stamps[stays], poses=s.poses[stays], covariance=s.covariance[each][:, each],
        by_rig=s.by_rig[each], solved=int(place[s.solved]), cost=s.cost - cost, past=(*s.past, left),
        rows=changed(rows, pose=place[rows.pose], point=index[rows.point]),
        places=changed(places, pose=place[places.pose], point=index[places.point]),
        motion=changed(motion, poses=np.where(motion.poses < 0, -1, place[motion.poses])),
        prior=changed(prior, points=index[stay]), landmarks=marks,
    )  # fmt: skip


def _without_oldest(
    surplus: int, s: WindowState, members: BoolArray, joins: BoolArray, ends: BoolArray, there: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """More landmarks end, and fewer join: members out of view that were measured longest ago, then those that join.

    Of those, one that is known in the world does not end: it stays known, and what the poses measured of it is dropped.
    """
    ends, joins = ends.copy(), joins.copy()
    out_of_view = np.flatnonzero(members & ~there)
    oldest = out_of_view[np.argsort(s.landmarks.last[out_of_view], kind="stable")][:surplus]
    ends[oldest] = True
    surplus -= len(oldest)
    if surplus > 0:
        last = np.flatnonzero(joins)[::-1][:surplus]
        joins[last], ends[last] = False, s.landmarks.information[last, 0, 0] == 0
    return ends, joins
