"""Measurements that are mended: the poses of the lag are solved for again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from backends.smoother.graph import Graph, SolverError
from backends.smoother.state import SmootherState
from backends.smoother.steps import Steps, anchored
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
    """The last poses after a correction; unless landmarks are known in the world, the newest one stays where it is."""
    s = anchored(s)
    marks, oldest = s.landmarks, s.oldest(steps.config.lag, s.number)
    try:
        solved = graph.rebuilt(s, _AGAIN)
    except SolverError:  # the next update tries again
        return replace(s, landmarks=marks.refined(steps.stereo, steps.models.pixel_sigma, s.first, s.poses))
    if not s.fixed:
        M = s.poses[-1] @ inverse(solved.poses[-1])
        graph.displaced(M)
        solved, s = solved.displaced(M), replace(s, start=M @ s.start)
        solved = replace(solved, poses=np.concatenate([solved.poses[:-1], s.poses[-1:]]))  # to the last digit
    D = solved.poses[0] @ inverse(s.poses[s.of(oldest)])
    unseen = ~marks.world & ~(marks.pose >= oldest).any(axis=1)
    position = np.where(unseen[:, None], transform(D, marks.position), marks.position)
    marks = replace(marks, position=position, mean=np.where(unseen[:, None], position, marks.mean))
    poses = np.concatenate([D @ s.poses[: s.of(oldest)], s.poses[s.of(oldest) :]])
    return steps.settled(replace(s, poses=poses, left_poses=D @ s.left_poses, landmarks=marks), solved)
