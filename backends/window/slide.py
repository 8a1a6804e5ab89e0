"""The window moves on: one of its poses leaves, and what it has measured becomes part of the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backends.window.config import WindowConfig
from backends.window.past import Left
from backends.window.problem import motion_between, problem
from backends.window.state import WindowState
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array
from slam.models import EstimatorModels
from slam.window.marginal import Conditional, marginalised
from slam.window.stereo import Field, RectifiedStereo


def slid(
    s: WindowState, stereo: RectifiedStereo, models: EstimatorModels, config: WindowConfig, field: Field
) -> WindowState:
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
    here, there = np.zeros(count, bool), np.zeros(count, bool)
    here[rows.point[rows.pose == leaving]] = True
    here[places.point[places.pose == leaving]] = True
    there[rows.point[rows.pose != leaving]] = True
    known = np.zeros(count, bool)
    known[places.point[places.pose == leaving]] = True
    known |= marks.information[:, 0, 0] > 0
    alive = marks.ids >= 0
    member = np.zeros(count, bool)
    member[s.prior.points] = True

    joins = here & ~member & alive & (there | known)
    ends = (member & ~alive) | (here & ~member & ~alive & (there | known))
    surplus = int((member & alive).sum() + joins.sum()) - config.landmarks
    if surplus > 0:
        ends, joins = _without_oldest(surplus, s, member & alive, joins, ends, there)
    absorbed_row = (rows.pose == leaving) & (member | joins)[rows.point] | ends[rows.point]
    absorbed_place = (places.pose == leaving) | ends[places.point]
    motion = motion_between(s, models)
    motion = motion.select((motion.poses == leaving).any(axis=1))

    w, active = problem(s, stereo, models, rows.select(absorbed_row), places.select(absorbed_place), motion)
    keeps = (member | joins | ends)[active]
    w = replace(
        w, information=np.where(keeps[:, None, None], marks.information[active], 0.0),
        joining=np.flatnonzero(joins[active]),
    )  # fmt: skip
    ending = ends[s.prior.points]
    prior, conditional, cost = marginalised(w, leaving, ending, field(w.rows.z))
    past = s.past.with_one(_left(s, leaving, active[prior.points], s.prior.points[ending], conditional))
    stays = ~absorbed_row & (rows.pose != leaving)
    free = marks.information.copy()
    free[joins | ends] = 0.0
    s = replace(
        s, frames=np.delete(s.frames, leaving), stamps=np.delete(s.stamps, leaving),
        rests=np.delete(s.rests, leaving),
        poses=np.delete(s.poses, leaving, axis=0), covariance=_without(s.covariance, leaving),
        by_rig=np.delete(s.by_rig, 6 * leaving + np.arange(6), axis=0),
        rows=_earlier(rows.select(stays), leaving), places=_earlier(places.select(~absorbed_place), leaving),
        prior=replace(prior, points=active[prior.points]), cost=s.cost - cost, past=past,
        landmarks=replace(marks, information=free), solved=s.solved - (s.solved > leaving),
    )  # fmt: skip
    return _compact(s)


def _left(s: WindowState, leaving: int, stayed: IndexArray, ended: IndexArray, conditional: Conditional) -> Left:
    """The record of what leaves."""
    marks, stay = s.landmarks, np.arange(len(s.frames)) != leaving
    return Left(
        int(s.frames[leaving]), s.poses[leaving], marks.serial[ended], marks.position[ended], s.frames[stay],
        s.poses[stay], marks.serial[stayed], marks.position[stayed], conditional,
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


def _earlier(rows, leaving):  # type: ignore[no-untyped-def]
    """Rows or places of a window without one pose."""
    return replace(rows, pose=rows.pose - (rows.pose > leaving))


def _without(P: Array, leaving: int) -> Array:
    keep = np.ones(len(P), bool)
    keep[6 * leaving : 6 * leaving + 6] = False
    return P[np.ix_(keep, keep)]


def _compact(s: WindowState) -> WindowState:
    """Without landmarks that were removed and take no part any more."""
    marks = s.landmarks
    used = marks.ids >= 0
    used[s.rows.point], used[s.places.point], used[s.prior.points] = True, True, True
    if used.all():
        return s
    index = np.cumsum(used) - 1
    return replace(
        s, landmarks=marks.select(used), rows=replace(s.rows, point=index[s.rows.point]),
        places=replace(s.places, point=index[s.places.point]), prior=replace(s.prior, points=index[s.prior.points]),
    )  # fmt: skip
