"""The path: all poses, also those that the state keeps no more."""

from __future__ import annotations

import numpy as np

from backends.smoother.state import SmootherState
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory


class Path:
    """Stamps and poses by number."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[Array] = []

    def follow(self, s: SmootherState) -> None:
        """Take in what a state has become; an earlier try at the same frame is overwritten."""
        self._stamps[s.first :], self._poses[s.first :] = s.stamps.tolist(), list(s.poses)

    def moved(self, s: SmootherState, D: Array) -> Path:
        """The path of a state whose oldest poses were moved by D (4, 4) in the world, as all before them are."""
        other = Path()
        other._stamps, other._poses = self._stamps.copy(), [D @ T for T in self._poses]
        other.follow(s)
        return other

    def trajectory(self) -> Trajectory:
        """All of it."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))
