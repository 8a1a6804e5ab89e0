"""The state as a problem for the solver: only the landmarks that take part, and the motion between successive poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backends.window.state import WindowState
from slam.data import IndexArray
from slam.models import EstimatorModels
from slam.window.motion import LONGEST, RATIO, STANDS, velocity_sigmas
from slam.window.problem import Motion, Places, Rows, Window
from slam.window.stereo import RectifiedStereo


def motion_between(s: WindowState, models: EstimatorModels) -> Motion:
    """The motion model between all poses of the window that follow each other."""
    f, dt = s.frames, np.minimum(np.diff(s.stamps), LONGEST)
    follows = (np.diff(f) == 1) & (f[1:] != s.begun)
    before = np.concatenate([[False], follows[:-1]]) & follows
    begins = follows & (f[1:] == s.begun + 1)
    rests = follows & s.rests[1:]
    i = np.flatnonzero(before | begins | rests)  # what the motion model said of others is in the prior
    if not len(i):
        return Motion.none()
    earlier = np.where(before[i], dt[i - 1], 1.0)
    first = ~before[i] | (dt[i] > RATIO * earlier) | rests[i]
    poses = np.stack([np.where(first, -1, i - 1), i, i + 1], axis=1)
    sigmas = np.where(rests[i, None], STANDS / dt[i, None], velocity_sigmas(models, dt[i], first))
    return Motion(poses, np.stack([earlier, dt[i]], axis=1), 1 / sigmas)


def problem(
    s: WindowState, stereo: RectifiedStereo, models: EstimatorModels, rows: Rows | None = None,
    places: Places | None = None, motion: Motion | None = None,
) -> tuple[Window, IndexArray]:  # fmt: skip
    """The problem of a state, and rows of the landmarks that its points are (N,).

    With some of the rows, places and motions alone, if they are given.
    """
    rows, places = s.rows if rows is None else rows, s.places if places is None else places
    marks = s.landmarks
    used = np.zeros(len(marks), bool)
    used[rows.point], used[places.point], used[s.prior.points] = True, True, True
    points = np.flatnonzero(used)
    index = np.empty(len(marks), np.intp)
    index[points] = np.arange(len(points))
    window = Window(
        stereo, s.poses, marks.position[points], replace(rows, point=index[rows.point]),
        mean=marks.mean[points], information=marks.information[points],
        places=replace(places, point=index[places.point]) if len(places) else places,
        motion=motion_between(s, models) if motion is None else motion,
        prior=replace(s.prior, points=index[s.prior.points]),
    )  # fmt: skip
    return window, points
