"""Measurements that are mended: the poses of the lag are solved for again."""

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
    """With corrected measurements; MeasurementError if one is not finite."""
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
    first = s.oldest(steps.config.lag, s.number)
    now, spread, joint, start = s.poses[s.of(first) :], s.spread, s.joint, s.start
    with suppress(SolverError):  # then the next update tries again
        solved = graph.rebuilt(s, _AGAIN)
        now, spread = solved.poses, np.concatenate([spread[:-1], solved.spread[-1:]])
        joint = solved.joint if s.anchor == s.number else joint
        if not s.anchored:
            M = s.poses[-1] @ inverse(now[-1])
            graph.displaced(M)
            now = M @ now
            now[-1] = s.poses[-1]
            start = M @ start
    D = now[0] @ inverse(s.poses[s.of(first)])
    moved = np.concatenate([D @ s.poses[: s.of(first)], now])
    marks, left = s.landmarks, D @ s.left_poses
    unseen = ~marks.world & ~(marks.pose >= first).any(axis=1)
    position = np.where(unseen[:, None], transform(D, marks.position), marks.position)
    marks = replace(marks, position=position, mean=np.where(unseen[:, None], position, marks.mean))
    marks = marks.refined(steps.stereo, steps.models.pixel_sigma, s.first, moved)
    return replace(
        s, poses=moved, left_poses=left, landmarks=marks, spread=spread, joint=joint, start=start, solved=graph.number
    )  # fmt: skip
