"""The path: all poses, also those that the state keeps no more."""

from __future__ import annotations

import numpy as np

from backends.smoother.graph import Graph
from backends.smoother.state import SmootherState
from slam.data import RecentPoses
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


def recent(s: SmootherState, graph: Graph, count: int) -> RecentPoses:
    """The last poses, at most so many, of those that are still smoothed."""
    first, P = graph.joint_covariance(s, max(s.begun, s.number + 1 - count), s.number)
    return RecentPoses(s.stamps[s.of(first) :], s.poses[s.of(first) :], 0.5 * (P + P.T))
