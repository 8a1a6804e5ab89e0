"""Measurements that are mended: the poses of the graph are solved for again."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from backends.smoother.graph import Graph, SolverError
from backends.smoother.state import SmootherState
from backends.smoother.steps import Steps
from slam.geometry.se3 import Array, inverse, transform
from slam.window.stereo import RectifiedStereo

_AGAIN = 2  # numerics: steps of Gauss and Newton after the first


def corrected(s: SmootherState, correct: Callable[[Array], Array]) -> SmootherState:
    """With corrected measurements.

    Raises:
        MeasurementError: a corrected measurement is not finite.
    """
    marks, shape = s.landmarks, s.landmarks.z.shape
    counts = np.cumsum([0, *map(len, s.sights)])
    rows = np.concatenate([*(sight.z for sight in s.sights), marks.z.reshape(-1, 3)[marks.pose.ravel() >= 0]])
    out = RectifiedStereo.corrected("smoother", rows, correct)
    sights = tuple(replace(sight, z=out[a:b]) for sight, a, b in zip(s.sights, counts, counts[1:]))
    z = marks.z.reshape(-1, 3).copy()
    z[marks.pose.ravel() >= 0] = out[counts[-1] :]
    return replace(s, sights=sights, landmarks=replace(marks, z=z.reshape(shape)), revisions=s.revisions + 1)


def rebuilt(s: SmootherState, steps: Steps, graph: Graph) -> SmootherState:
    """The last poses after a correction: the newest one stays where it is, the others and the landmarks move."""
    first = graph.oldest(s)
    try:
        now = graph.rebuilt(s, _AGAIN).poses
    except SolverError:
        now = s.poses[s.of(first) :]
    if not s.anchored:
        now = s.poses[-1] @ inverse(now[-1]) @ now
    D = now[0] @ inverse(s.poses[s.of(first)])
    moved = np.concatenate([D @ s.poses[: s.of(first)], now])
    marks = s.landmarks
    away = ~marks.world & ~(marks.pose >= first).any(axis=1)
    position = np.where(away[:, None], transform(D, marks.position), marks.position)
    marks = replace(marks, position=position, mean=np.where(away[:, None], position, marks.mean))
    last = s.last.copy()
    last[1] = moved[-1] @ inverse(s.poses[-1]) @ s.last[1]
    before = s.poses[-1] if s.inside is False or len(moved) < 2 else s.poses[-2]
    after = moved[-1] if s.inside is False or len(moved) < 2 else moved[-2]
    last[0] = after @ inverse(before) @ s.last[0]
    s = replace(s, poses=moved, last=last, landmarks=marks.refined(steps.stereo, steps.sigma, s.first, moved))
    with suppress(SolverError):  # then the next update tries again
        graph.rebuilt(s)
    return s
