"""The path: every frame hangs at a pose of the graph, or is one."""

from __future__ import annotations

import numpy as np

from backends.smoother.graph import Graph
from backends.smoother.state import SmootherState
from slam.data import IndexArray, RecentPoses
from slam.geometry.se3 import Array, adjoint, inverse
from slam.geometry.trajectory import Trajectory


class Path:
    """All frames, and all poses of the graph, also those that the state keeps no more."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._number: list[int] = []  # of the pose of the graph at which each frame hangs
        self._relative: list[Array] = []  # its pose relative to that (4, 4)
        self._own: list[Array] = []  # covariance of that (6, 6)
        self._poses: list[Array] = []  # of the graph, by number

    def extend(self, s: SmootherState) -> None:
        """Take in a new frame. An earlier try at the same frame is overwritten."""
        f = s.frame
        self._stamps[f:], self._number[f:] = [float(s.stamps[1])], [0]
        self._relative[f:], self._own[f:] = [np.eye(4)], [s.own]
        self.follow(s)

    def follow(self, s: SmootherState) -> None:
        """Take in what has become of the last two frames and of the graph."""
        self._poses[s.first :] = list(s.poses)
        f = s.frame
        self._number[f], self._relative[f], self._own[f] = s.number, inverse(s.poses[-1]) @ s.last[1], s.own
        if s.since and not s.inside and self._number[f - 1] == s.number:
            self._relative[f - 1], self._own[f - 1] = inverse(s.poses[-1]) @ s.last[0], s.pair[:6, :6]

    def moved(self, s: SmootherState, D: Array) -> Path:
        """The path of a state whose oldest poses were moved by D (4, 4) in the world, as all before them are."""
        other = Path()
        for name, rows in vars(self).items():
            setattr(other, name, rows.copy())
        other._poses = [D @ T for T in self._poses]
        other.follow(s)
        return other

    def frames(self, number: int) -> tuple[Array, IndexArray]:
        """Stamps [s] of the frames from a pose of the graph on, and numbers of the poses at which they hang (F,)."""
        first = self._number.index(number)
        return np.array(self._stamps[first:]), np.array(self._number[first:], np.intp)

    def trajectory(self, s: SmootherState) -> Trajectory:
        """Poses of all frames."""
        if not self._stamps:
            return Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        poses = np.array(self._poses)[self._number] @ np.array(self._relative)
        poses[-1] = s.last[1]
        return Trajectory(np.array(self._stamps), poses)

    def recent(self, s: SmootherState, graph: Graph, count: int) -> RecentPoses:
        """The last frames, at most so many, that hang at poses of the graph that are still smoothed."""
        first, joint = graph.joint_covariance(s, self._number[max(0, s.frame + 1 - count)])
        frames = [f for f in range(max(0, s.frame + 1 - count), s.frame + 1) if self._number[f] >= first]
        J, own = np.zeros((6 * len(frames), len(joint))), np.zeros((6 * len(frames), 6 * len(frames)))
        for i, f in enumerate(frames):
            rows, k = slice(6 * i, 6 * i + 6), self._number[f] - first
            J[rows, 6 * k : 6 * k + 6] = adjoint(inverse(self._relative[f]))
            own[rows, rows] = self._own[f]
        near = sum(self._number[f] == s.number for f in frames[-2:])
        if not s.inside:
            gain, rest = s.followed
            J[-6 * near :, -6:], own[-6 * near :, -6 * near :] = gain[-6 * near :], rest[-6 * near :, -6 * near :]
        P = J @ joint @ J.T + own
        poses = np.array([self._poses[self._number[f]] @ self._relative[f] for f in frames])
        poses[-1] = s.last[1]
        return RecentPoses(np.array([self._stamps[f] for f in frames]), poses, 0.5 * (P + P.T))
