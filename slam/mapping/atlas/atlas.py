"""The atlas: keyframes and loops of a run, and where the map stands to the frame that the back end estimates in.

The back end goes on in its own frame, *odom*, which drifts but never jumps. A loop moves the keyframes; the pose of
odom in the map, ``T_map_odom``, is then such that the newest keyframe is where the pose graph has it. All poses that
the system reports are in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from slam.data import Estimate
from slam.geometry.se3 import Array, adjoint, inverse, log, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.mapping.atlas.chain import Chain, adjoints, shared_out
from slam.mapping.atlas.keyframes import Keyframe, Loop, what_was_added
from slam.mapping.atlas.places import PlaceIndex, Vectors
from slam.mapping.atlas.rows import KeyframeRows
from slam.rig_error import CommonError

if TYPE_CHECKING:
    from slam.mapping.atlas.pose_graph import Solution


@dataclass(frozen=True)
class Anchor:
    """What the pose graph said of the last keyframe when a loop was closed last.

    Attributes:
        covariance: of its pose, perturbing on the right, and of the common errors (6 + n, 6 + n).
        common: the common errors (n,), where their variance was one.
        rig: what they stand for, see `slam.rig_error.CommonError`.
    """

    covariance: Array
    common: Array
    rig: CommonError

    def common_as(self, rig: CommonError) -> Array:
        """The common errors (n,), where they stand for what they do now: the rig's posterior changes meanwhile."""
        if rig.scale.shape != self.rig.scale.shape:
            return np.zeros(rig.scale.shape[1])
        error = self.rig.scale @ self.common + self.rig.known - rig.known
        return np.asarray(np.linalg.lstsq(rig.scale, error, rcond=None)[0])

    def later(self, back: Array, shares: Array) -> Array:
        """Covariance (6, 6) of a later pose, without the noise since.

        Its path goes on with the common errors uncorrected: what they were found to be counts as an error too.

        Args:
            back: adjoint (6, 6) of the keyframe's pose seen from the later one.
            shares: derivative (6, m) of the motion since by the common errors.
        """
        J = np.concatenate([back, shares @ self.rig.scale], axis=1)
        found = shares @ (self.rig.scale @ self.common + self.rig.known)
        return np.asarray(J @ self.covariance @ J.T + np.outer(found, found))


@dataclass(frozen=True)
class Atlas:
    """What a run keeps of the places that it has been to.

    Attributes:
        keyframes: in order of time.
        rows: their poses and what else the pose graph needs of them.
        index: which of them look alike.
        loops: those that the pose graph holds.
        spare: verified loops that it does not hold: refused, unconfirmed, or such that tell nothing new; the last ones.
        dropped: number of loops of this run that it holds no more, to save time.
        refused: loops that contradict the path, as the numbers of both keyframes.
        corrected: poses T_map_left (C, 4, 4) of the first keyframes, as the last loop put them.
        anchor: how well the last of these is known; None without a loop.
        T_map_odom: pose (4, 4) of the back end's frame in the map.
        pending: the last loop that was seen, whether the pose graph holds it or not.
        confirmed: whether a keyframe just before it had seen the same return.
        restarts: how often another back end had taken over when the last keyframe was made.
        known: number of keyframes that are from an earlier run: the first ones, in the map that this run started in.
    """

    keyframes: tuple[Keyframe, ...] = ()
    rows: KeyframeRows = field(default_factory=KeyframeRows)
    index: PlaceIndex = field(default_factory=PlaceIndex)
    loops: tuple[Loop, ...] = ()
    spare: tuple[Loop, ...] = ()
    dropped: int = 0
    refused: tuple[tuple[int, int], ...] = ()
    corrected: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    anchor: Anchor | None = None
    T_map_odom: Array = field(default_factory=lambda: np.eye(4))
    pending: Loop | None = None
    confirmed: bool = False
    restarts: int = 0
    known: int = 0

    def __len__(self) -> int:
        return len(self.keyframes)

    @classmethod
    def of_earlier_run(cls, keyframes: Sequence[Keyframe], poses: Array, loops: Sequence[Loop] = ()) -> Atlas:
        """The places of a saved map.

        Args:
            keyframes: their poses are in the frame of the back end that saw them.
            poses: theirs in the map (K, 4, 4).
            loops: that led to these.
        """
        atlas = cls()
        for keyframe in keyframes:
            atlas = atlas.with_new(replace(keyframe, frame=-1), keyframe.descriptors.astype(np.float32))
        return replace(atlas, loops=tuple(loops), corrected=poses, known=len(atlas))

    def with_new(self, keyframe: Keyframe, descriptors: Vectors) -> Atlas:
        """With one more keyframe, of descriptors (F, D)."""
        rows, index = self.rows.with_new(keyframe), self.index.with_new(descriptors)
        return replace(self, keyframes=(*self.keyframes, keyframe), rows=rows, index=index)

    def poses_in_map(self) -> Array:
        """Poses T_map_left (K, 4, 4) of all keyframes."""
        return self._in_map(self.rows.poses)

    def summary(self) -> dict[str, int]:
        """Numbers of keyframes, of loops closed in this run, and of loops refused as they contradict the path.

        In a prior map, its keyframes are counted too, and apart as ``known``.
        """
        closed = sum(loop.second >= self.known for loop in self.loops)
        known = {"known": self.known} if self.known else {}
        return {"keyframes": len(self), **known, "closed": closed + self.dropped, "refused": len(self.refused)}

    def with_loop(self, loop: Loop, most: int) -> Atlas:
        """With one loop more; of more than `most`, those are dropped whose neighbours on the path are nearest."""
        loops, dropped = (*self.loops, loop), self.dropped
        while len(loops) > most:
            at = np.array([self.keyframes[k.second].travelled for k in loops])
            least = 1 + int(np.argmin(at[2:] - at[:-2]))
            dropped += loops[least].second >= self.known
            loops = loops[:least] + loops[least + 1 :]
        return replace(self, loops=loops, dropped=dropped)

    def with_spare(self, loop: Loop, most: int) -> Atlas:
        """With one loop more that the pose graph does not hold; the last `most` are kept."""
        return replace(self, spare=(*self.spare, loop)[-most:])

    def with_loops(self, held: Sequence[Loop], believed: Sequence[Loop], most: int) -> Atlas:
        """With other loops in the pose graph; those that it held, and that are not `believed` any more, are refused.

        The numbers of loops dropped before stay. Both are in order of their second keyframes.
        """
        good, kept = {x.pair for x in believed}, {x.pair for x in held}
        out = [x for x in self.loops if x.pair not in kept]
        refused = [pair for pair in self.refused if pair not in good]
        refused += [x.pair for x in out if x.pair not in good]
        spare = [x for x in (*self.spare, *out) if x.pair not in kept]
        atlas = replace(self, loops=(), spare=tuple(spare[-most:]), refused=tuple(refused))
        for loop in held:
            atlas = atlas.with_loop(loop, most)
        return replace(atlas, pending=held[-1], confirmed=True)

    def solved_by(self, solution: Solution, rig: CommonError) -> Atlas:
        """With the keyframes where the pose graph has them; `rig` says what its common errors stand for."""
        return replace(
            self,
            corrected=solution.poses,
            anchor=Anchor(solution.covariance, solution.common, rig),
            T_map_odom=solution.poses[-1] @ inverse(self.keyframes[-1].T_odom_left),
        )

    def closed_in(self, frame: int) -> int | None:
        """Index of the frame whose place `frame` showed again, where it closed a loop."""
        if not self.loops or self.keyframes[self.loops[-1].second].frame != frame:
            return None
        return self.keyframes[self.loops[-1].first].frame

    def refused_in(self, frame: int) -> int | None:
        """Index of the frame whose place `frame` seemed to show again, where that was refused."""
        if not self.refused or self.keyframes[self.refused[-1][1]].frame != frame:
            return None
        return self.keyframes[self.refused[-1][0]].frame

    def chain(self, rig: CommonError, path: Trajectory | None = None) -> Chain:
        """The keyframes' path in odom: as it was estimated at the time, or as `path` has it now.

        Args:
            rig: what common errors stand for now.
            path: the path so far.
        """
        poses, count, m = self.rows.poses.copy(), len(self), len(rig.known)
        if path is not None:
            poses[self.known :] = path.poses[np.searchsorted(path.stamps, self.rows.stamps[self.known :])]
        shares = self.rows.shares
        if shares.shape[2] != m:  # all are of a prior map that was made without them
            shares = np.zeros((count, 6, m))
        common = (shares.reshape(6 * count, m) @ rig.root).reshape(count, 6, rig.scale.shape[1] + 1)
        common[1:] -= adjoints(inverse(poses[1:]) @ poses[:-1]) @ common[:-1]
        return Chain(poses, self.rows.steps, common[:, :, :-1], common[:, :, -1])

    def in_map(self, chain: Chain) -> Array:
        """Poses T_map_left (K, 4, 4) of all keyframes, those since the last loop by `T_map_odom`."""
        return self._in_map(chain.poses)

    def _in_map(self, poses: Array) -> Array:
        """Poses (K, 4, 4) of all keyframes in odom, taken to the map."""
        return np.concatenate([self.corrected, self.T_map_odom @ poses[len(self.corrected) :]])

    def pose_in_map(self, number: int) -> Array:
        """Pose T_map_left (4, 4) of a keyframe."""
        if number < len(self.corrected):
            return np.asarray(self.corrected[number])
        return self.T_map_odom @ self.keyframes[number].T_odom_left

    def estimate(self, estimate: Estimate, common: CommonError) -> Estimate:
        """An estimate in odom, taken to the map; after a loop it is as certain as the pose graph says.

        Args:
            estimate: with covariances by noise and by the common error.
            common: what the pose's error has in common with those of other frames.
        """
        if self.anchor is None:
            return estimate
        T, R = self.T_map_odom, self.T_map_odom[:3, :3]
        before = self.keyframes[len(self.corrected) - 1]
        back = adjoint(inverse(estimate.T_world_left) @ before.T_odom_left)
        noise = what_was_added(estimate.covariance - common.covariance, back @ before.covariance @ back.T)
        covariance = self.anchor.later(back, common.shares - back @ before.shares) + noise
        return replace(
            estimate,
            T_world_left=T @ estimate.T_world_left,
            covariance=covariance,
            positions=estimate.positions @ R.T + T[:3, 3],
            covariances=R @ landmarks_by_pose(estimate, covariance) @ R.T,
        )

    def path(self, path: Trajectory) -> Trajectory:
        """A path in odom, taken to the map; what loops move two keyframes by is shared out evenly in time between."""
        if self.anchor is None or not len(path):
            return path
        from slam.mapping.atlas.pose_graph import solve

        chain = self.chain(self.anchor.rig, path)
        moved = solve(chain, self.loops, self.in_map(chain)).poses
        stamps = self.rows.stamps[self.known :]
        return Trajectory(path.stamps, _between_keyframes(path, stamps, moved[self.known :]))


def landmarks_by_pose(estimate: Estimate, covariance: Array) -> Array:
    """Covariances (N, 3, 3) of landmarks after the camera's pose, from which they are seen, has got another one (6, 6).

    What a landmark's covariance has more than the pose's at its place is its own, and stays. A landmark that was surer
    in the estimate keeps its covariance: its place does not depend on where the camera is now.
    """
    T, P = estimate.T_world_left, estimate.covariances
    J = T[:3, :3] @ points_by_pose(transform(inverse(T), estimate.positions))
    before, after = (J @ pose @ np.swapaxes(J, 1, 2) for pose in (estimate.covariance, covariance))
    moved = what_was_added(P, before) + after
    surer = np.trace(moved, axis1=1, axis2=2) < np.trace(P, axis1=1, axis2=2)
    return np.where(surer[:, None, None], moved, P)


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
