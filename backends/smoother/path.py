"""The camera's path as the smoother has it: the poses of all frames, and the newest one before it is measured."""

from __future__ import annotations

from copy import copy

import numpy as np

from backends.smoother.motion import bounded
from backends.smoother.pose_set import PredictedPose
from slam.data import IndexArray
from slam.geometry.se3 import Array


def grown(array: np.ndarray, rows: int) -> np.ndarray:
    """`array` with room for at least `rows` rows: itself, or a copy of twice the size."""
    if rows <= len(array):
        return array
    larger = np.zeros((max(rows, 2 * len(array)), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


class Path:
    """Stamps and poses ``T_world_left`` of all frames.

    Attributes:
        count: number of frames.
        measured: those in which landmarks were measured, ascending.
        jumps: those whose poses do not follow from the ones before; the camera goes on from there at an unknown speed.
        rests: those in which the camera has not moved since the frame before.
        predicted: the newest pose while it is only predicted: it is not among the frames yet. None otherwise.
    """

    def __init__(self) -> None:
        self.count = 0
        self.measured: list[int] = []
        self.jumps: list[int] = []
        self.rests: set[int] = set()
        self.predicted: PredictedPose | None = None
        self._stamps = np.zeros(64)
        self._poses = np.zeros((64, 4, 4))

    @property
    def stamps(self) -> Array:
        """Times (F,) [s]; a view."""
        return self._stamps[: self.count]

    @property
    def poses(self) -> Array:
        """Poses (F, 4, 4); a view that may be written to."""
        return self._poses[: self.count]

    def interval(self, i: int) -> float:
        """The time from the frame before frame `i` to that frame [s], as far as the motion model counts it."""
        return bounded(float(self._stamps[i] - self._stamps[i - 1]))

    def newest(self, most: int, first: int = 0) -> IndexArray:
        """The two newest frames and before them those with measurements, from `first` on, at most so many together.

        A landmark's position depends on the poses that measured it alone, so that the other poses are not needed.
        """
        older = [i for i in self.measured[-most:] if first <= i < self.count - 2]
        recent = range(max(first, self.count - 2), self.count)
        return np.array([*older[max(0, len(older) + len(recent) - most) :], *recent], np.intp)

    def note_measured(self) -> None:
        """Note that landmarks were measured in the newest frame."""
        if not self.measured or self.measured[-1] < self.count - 1:
            self.measured.append(self.count - 1)

    def jumped(self, frame: int) -> bool:
        """Whether the pose of a frame does not follow from those before it."""
        return frame in self.jumps

    def upto(self, count: int) -> Path:
        """The first `count` frames; they share their memory with this."""
        out = copy(self)
        out.count = count
        return out

    def append(self, stamp: float, T_world_left: Array) -> None:
        """Add a frame; if its pose was predicted, this takes the prediction's place."""
        self._stamps = grown(self._stamps, self.count + 1)
        self._poses = grown(self._poses, self.count + 1)
        self._stamps[self.count], self._poses[self.count] = stamp, T_world_left
        self.count += 1
        self.predicted = None
