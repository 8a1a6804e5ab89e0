"""The window moves on: one of its poses leaves, and what it has measured becomes part of the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backends.window.state import Left, WindowConfig, WindowState
from slam.data import BoolArray
from slam.geometry.arrays import among
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
    """The state with one pose less.

    The oldest pose is the one that the prior is relative to, and stays for some frames; the next one leaves. Landmarks
    that it has measured join the prior, if they are still measured: they keep their covariance with all the others.
    Those that nothing will measure again leave with all their measurements, and so do landmarks beyond the prior's
    limit, which are then estimated afresh.

    Raises:
        numpy.linalg.LinAlgError: the information of what leaves is not positive definite.
    """
    leaving = 0 if s.frames[-1] - s.frames[0] > config.reference else 1
    leaving += leaving == s.solved  # landmarks are known relative to that one
    marks, rows, places, count = s.landmarks, s.rows, s.places, len(s.landmarks)
    its_rows, its_places = rows.pose == leaving, places.pose == leaving
    known = among(count, places.point[its_places])
    here = known | among(count, rows.point[its_rows])
    there, member = among(count, rows.point[~its_rows]), among(count, s.prior.points)
    alive = marks.ids >= 0

    new = here & ~member & (there | known | (marks.information[:, 0, 0] > 0))
    joins, ends = new & alive, (new | member) & ~alive
    surplus = int((member & alive).sum() + joins.sum()) - config.landmarks
    if surplus > 0:
        ends, joins = _without_oldest(surplus, s, member & alive, joins, ends, there)
    taken_rows = its_rows & (member | joins)[rows.point] | ends[rows.point]
    taken_places = its_places | ends[places.point]
    moves = (s.motion.poses == leaving).any(axis=1)
    w = replace(
        problem(s, stereo), rows=rows.select(taken_rows), places=places.select(taken_places),
        motion=s.motion.select(moves), joining=np.flatnonzero(joins),
        information=np.where((member | joins | ends)[:, None, None], marks.information, 0.0),
    )  # fmt: skip
    ending, stays = ends[s.prior.points], np.arange(len(s.frames)) != leaving
    prior, conditional, cost = marginalised(w, leaving, ending, field(w.rows.z))
    gone, stay = s.prior.points[ending], prior.points
    left = Left(
        int(s.frames[leaving]), s.poses[leaving], marks.serial[gone], marks.position[gone], s.frames[stays],
        s.poses[stays], marks.serial[stay], marks.position[stay], conditional,
    )  # fmt: skip
    rows, places = rows.select(~taken_rows & ~its_rows), places.select(~taken_places)
    motion = s.motion.select(~moves)
    index = np.arange(count)
    used = alive | among(count, np.concatenate([rows.point, places.point, stay]))
    free = marks.information
    if (joins | ends).any():
        free = np.where((joins | ends)[:, None, None], 0.0, free)
    marks = replace(marks, information=free)
    if not used.all():  # landmarks that were removed take no part any more
        index, marks = np.cumsum(used) - 1, marks.select(used)
    each = np.repeat(stays, 6)
    return replace(
        s, frames=s.frames[stays], stamps=s.stamps[stays], poses=s.poses[stays], covariance=s.covariance[each][:, each],
        by_rig=s.by_rig[each], solved=s.solved - (s.solved > leaving), cost=s.cost - cost, past=(*s.past, left),
        rows=replace(rows, pose=rows.pose - (rows.pose > leaving), point=index[rows.point]),
        places=replace(places, pose=places.pose - (places.pose > leaving), point=index[places.point]),
        motion=replace(motion, poses=motion.poses - (motion.poses > leaving)),
        prior=replace(prior, points=index[stay]), landmarks=marks,
    )  # fmt: skip


def _without_oldest(
    surplus: int, s: WindowState, members: BoolArray, joins: BoolArray, ends: BoolArray, there: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """More landmarks end, and fewer join: members out of view that were measured longest ago, then those that join.

    Of those, one that is known in the world does not end: it stays known, and what the pose measured of it is dropped.
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
