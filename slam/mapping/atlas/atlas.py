"""The atlas: keyframes and loops of a run, and where the map stands to the frame that the back end estimates in.

The back end goes on in its own frame, *odom*, which drifts but never jumps. A loop moves the keyframes; the pose of
odom in the map, ``T_map_odom``, is then such that the newest keyframe is where the pose graph has it. All poses that
the system reports are in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slam.data import Estimate
from slam.geometry.se3 import Array, adjoint, inverse, log
from slam.geometry.trajectory import Trajectory
from slam.mapping.atlas.chain import Chain, shared_out
from slam.mapping.atlas.keyframes import Keyframe, what_was_added
from slam.mapping.atlas.loops import Loop
from slam.mapping.atlas.places import PlaceIndex


@dataclass(frozen=True)
class Atlas:
    """What a run keeps of the places that it has been to.

    Attributes:
        keyframes: in order of time.
        index: which of them look alike.
        loops: those that the pose graph holds.
        refused: number of sightings that contradicted the path.
        corrected: poses T_map_left (C, 4, 4) of the first keyframes, as the last loop put them.
        anchor: covariance (6, 6) of the last of these; None without a loop.
        T_map_odom: pose (4, 4) of the back end's frame in the map.
        pending: the last loop that was seen, whether the pose graph holds it or not.
        confirmed: whether a keyframe just before it had seen the same return.
        restarts: how often another back end had taken over when the last keyframe was made.
        known: number of keyframes that are from an earlier run: the first ones, in the map that this run started in.
    """

    keyframes: tuple[Keyframe, ...] = ()
    index: PlaceIndex = field(default_factory=PlaceIndex)
    loops: tuple[Loop, ...] = ()
    refused: int = 0
    corrected: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    anchor: Array | None = None
    T_map_odom: Array = field(default_factory=lambda: np.eye(4))
    pending: Loop | None = None
    confirmed: bool = False
    restarts: int = 0
    known: int = 0

    def __len__(self) -> int:
        return len(self.keyframes)

    @classmethod
    def of_earlier_run(cls, keyframes: Sequence[Keyframe]) -> Atlas:
        """The places of a saved map; poses of its keyframes are in the map."""
        index = PlaceIndex()
        for keyframe in keyframes:
            index = index.with_new(keyframe.descriptors.astype(np.float32))
        poses = np.array([k.T_odom_left for k in keyframes]).reshape(-1, 4, 4)
        return cls(tuple(replace(k, frame=-1) for k in keyframes), index, corrected=poses, known=len(keyframes))

    def in_map_as_keyframes(self) -> tuple[Keyframe, ...]:
        """The keyframes for a saved map, their poses in the map."""
        return tuple(replace(k, T_odom_left=self.pose_in_map(i)) for i, k in enumerate(self.keyframes))

    def summary(self) -> dict[str, int]:
        """Numbers of keyframes, of loops in the pose graph, and of sightings that contradicted the path."""
        return {"keyframes": len(self), "closed": len(self.loops), "refused": self.refused}

    def closed_in(self, frame: int) -> int | None:
        """Index of the frame whose place `frame` showed again, where it closed a loop."""
        if not self.loops or self.keyframes[self.loops[-1].second].frame != frame:
            return None
        return self.keyframes[self.loops[-1].first].frame

    def chain(self, path: Trajectory | None = None) -> Chain:
        """The keyframes' path in odom: as it was estimated at the time, or as `path` has it now."""
        poses = np.array([k.T_odom_left for k in self.keyframes]).reshape(-1, 4, 4)
        if path is not None:
            rows = np.searchsorted(path.stamps, [k.stamp for k in self.keyframes[self.known :]])
            poses[self.known :] = path.poses[rows]
        return Chain(poses, np.array([k.step_covariance for k in self.keyframes]))

    def in_map(self, chain: Chain) -> Array:
        """Poses T_map_left (K, 4, 4) of all keyframes, those since the last loop by `T_map_odom`."""
        return np.concatenate([self.corrected, self.T_map_odom @ chain.poses[len(self.corrected) :]])

    def pose_in_map(self, number: int) -> Array:
        """Pose T_map_left (4, 4) of a keyframe."""
        if number < len(self.corrected):
            return np.asarray(self.corrected[number])
        return self.T_map_odom @ self.keyframes[number].T_odom_left

    def positions(self) -> Array:
        """Positions (K, 3) [m] of all keyframes in the map."""
        since = np.array([k.T_odom_left[:3, 3] for k in self.keyframes[len(self.corrected) :]]).reshape(-1, 3)
        T = self.T_map_odom
        return np.concatenate([self.corrected[:, :3, 3], since @ T[:3, :3].T + T[:3, 3]])

    def estimate(self, estimate: Estimate) -> Estimate:
        """An estimate in odom, taken to the map; after a loop its pose is as certain as the pose graph says."""
        if self.anchor is None:
            return estimate
        T, R = self.T_map_odom, self.T_map_odom[:3, :3]
        before = self.keyframes[len(self.corrected) - 1]
        back = adjoint(inverse(estimate.T_world_left) @ before.T_odom_left)
        since = what_was_added(estimate.covariance, back @ before.covariance @ back.T)
        return replace(
            estimate,
            T_world_left=T @ estimate.T_world_left,
            covariance=back @ self.anchor @ back.T + since,
            positions=estimate.positions @ R.T + T[:3, 3],
            covariances=R @ estimate.covariances @ R.T,
        )

    def path(self, path: Trajectory) -> Trajectory:
        """A path in odom, taken to the map; what loops move two keyframes by is shared out evenly in time between."""
        if not self.loops or not len(path):
            return path
        from slam.mapping.atlas.pose_graph import solve

        chain = self.chain(path)
        moved = solve(chain, self.loops, self.in_map(chain)).poses
        stamps = np.array([k.stamp for k in self.keyframes[self.known :]])
        return Trajectory(path.stamps, _between_keyframes(path, stamps, moved[self.known :]))


def _between_keyframes(path: Trajectory, stamps: Array, moved: Array) -> Array:
    """Poses (N, 4, 4) of a path whose keyframes, at `stamps` (K,), are moved to other poses (K, 4, 4)."""
    rows = np.searchsorted(path.stamps, stamps)
    odom = path.poses[rows]
    at = np.clip(np.searchsorted(stamps, path.stamps, side="right") - 1, 0, len(stamps) - 1)
    to = np.minimum(at + 1, len(stamps) - 1)
    step = inverse(odom[at]) @ odom[to]
    change = log(inverse(step) @ inverse(moved[at]) @ moved[to])
    span = np.where(to > at, stamps[to] - stamps[at], 1.0)
    share = np.clip((path.stamps - stamps[at]) / span, 0.0, 1.0)
    return shared_out(
        moved[at], inverse(odom[at]) @ path.poses, inverse(path.poses) @ odom[to], share[:, None] * change
    )
