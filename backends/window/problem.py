"""The state as a problem for the solver: only the landmarks that take part, and the motion between successive poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backends.window.state import State
from slam.data import IndexArray
from slam.models import EstimatorModels
from slam.window.motion import LONGEST, is_first, velocity_sigmas
from slam.window.problem import Motion, Places, Rows, Window
from slam.window.stereo import RectifiedStereo


@dataclass(frozen=True, eq=False)
class Problem:
    """A window and the landmarks' rows that its points are (N,)."""

    window: Window
    points: IndexArray


def motion_between(s: State, models: EstimatorModels) -> Motion:
    """The motion model between all poses of the window that follow each other."""
    f, t = s.frames, s.stamps
    poses, interval, weight = [], [], []
    for i in range(1, len(f)):
        if f[i] != f[i - 1] + 1 or f[i] == s.begun:
            continue
        dt = min(t[i] - t[i - 1], LONGEST)
        before = min(t[i - 1] - t[i - 2], LONGEST) if i > 1 and f[i - 2] == f[i] - 2 and f[i] > s.begun + 1 else None
        first = is_first(before, dt)
        if before is None and f[i] > s.begun + 1:
            continue  # what the motion model said of it is in the prior
        poses.append((-1 if first else i - 2, i - 1, i))
        interval.append((1.0 if before is None else before, dt))
        weight.append(1 / velocity_sigmas(models, dt, first))
    if not poses:
        return Motion.none()
    return Motion(np.array(poses), np.array(interval), np.array(weight))


def problem(
    s: State, stereo: RectifiedStereo, models: EstimatorModels, rows: Rows | None = None, places: Places | None = None,
    motion: Motion | None = None,
) -> Problem:  # fmt: skip
    """The problem of a state; some of its rows, places and motions if they are given."""
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
    return Problem(window, points)
