"""The atlas: keyframes and loops of a run, and where the map stands to the frame that the back end estimates in.

The back end goes on in its own frame, *odom*, which drifts but never jumps. A loop moves the keyframes; the pose of
odom in the map, ``T_map_odom``, is then such that the newest keyframe is where the pose graph has it. All poses that
the system reports are in the map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from slam.data import Estimate
from slam.geometry.se3 import Array, adjoint, inverse, log, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.mapping.atlas.chain import Chain, adjoints, shared_out
from slam.mapping.atlas.keyframes import Keyframe, Loop, what_was_added
from slam.mapping.atlas.places import PlaceIndex, Vectors
from slam.mapping.atlas.rows import KeyframeRows
from slam.models import ANYWHERE, EstimatorModels
from slam.rig_error import CommonError

if TYPE_CHECKING:
    from slam.mapping.atlas.pose_graph import Solution

_UNKNOWN_DIRECTION = np.pi / np.sqrt(3)  # derived: standard deviation of an angle of which nothing is known [rad]


@dataclass(frozen=True)
class Anchor:
    """How well a pose is known in the map, from which later ones follow.

    That of the last keyframe when a loop was closed last; or the one at which another back end has begun anew since.

    Attributes:
        T_odom_left: the pose (4, 4), as the back end had it then.
        noise: its covariance (6, 6) in the back end, by noise alone.
        covariance: in the map: of the pose, perturbing on the right, and of the common errors (6 + n, 6 + n).
        common: the common errors (n,), where their variance was one.
        rig: what they stand for, and what they do to the pose, see `slam.rig_error.CommonError`.
    """

    T_odom_left: Array
    noise: Array
    covariance: Array
    common: Array
    rig: CommonError

    def belief(self, rig: CommonError) -> tuple[Array, Array]:
        """The common errors (n,) and their covariance (n, n); where they are others by now, as before any loop."""
        if rig.scale.shape != self.rig.scale.shape:
            return np.zeros(rig.scale.shape[1]), np.eye(rig.scale.shape[1])
        return self.common_as(rig), self.covariance[6:, 6:]

    def common_as(self, rig: CommonError) -> Array:
        """The common errors (n,), where they stand for what they do now: the rig's posterior changes meanwhile."""
        if rig.scale.shape != self.rig.scale.shape:
            return np.zeros(rig.scale.shape[1])
        return np.asarray(np.linalg.lstsq(rig.scale, self.rig.scale @ self.common, rcond=None)[0])

    def later(self, back: Array, shares: Array) -> Array:
        """Covariance (6, 6) of a later pose, without the noise since.

        Its path goes on with the common errors uncorrected: what they were found to be counts as an error too.

        Args:
            back: adjoint (6, 6) of the keyframe's pose seen from the later one.
            shares: derivative (6, m) of the motion since by the common errors.
        """
        J = np.concatenate([back, shares @ self.rig.scale], axis=1)
        found = shares @ self.rig.scale @ self.common
        return np.asarray(J @ self.covariance @ J.T + np.outer(found, found))


@dataclass(frozen=True)
class Gap:
    """A time in which the camera was moved unseen, after which another back end has taken over.

    Attributes:
        since: time of the last measured pose before it [s].
        until: time of the first pose after it [s].
        covariance: of that pose (6, 6), perturbing on the right, see `moved_unseen`; None where the camera was found
            elsewhere, so that nothing is known of how it came there.
        anchor: that pose, where a map of its own begins with it that no loop has tied to the rest so far.
    """

    since: float
    until: float
    covariance: Array | None = None
    anchor: Anchor | None = None


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
        solved: how well the last of these is known; None without a loop.
        anchor: from which the present pose follows: that one, or where a map of its own has begun since.
        T_map_odom: pose (4, 4) of the back end's frame in the map.
        pending: the last loop that was seen, whether the pose graph holds it or not.
        confirmed: whether a keyframe just before it had seen the same return.
        gaps: one before each back end but the first.
        restarts: how many of these were before the last keyframe.
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
    solved: Anchor | None = None
    anchor: Anchor | None = None
    T_map_odom: Array = field(default_factory=lambda: np.eye(4))
    pending: Loop | None = None
    confirmed: bool = False
    gaps: tuple[Gap, ...] = ()
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
        last = self.keyframes[-1]
        shared = replace(rig, shares=last.shares)
        anchor = Anchor(last.T_odom_left, last.covariance, solution.covariance, solution.common, shared)
        return replace(
            self,
            corrected=solution.poses,
            solved=anchor,
            anchor=anchor,
            gaps=tuple(replace(gap, anchor=None) for gap in self.gaps),
            T_map_odom=solution.poses[-1] @ inverse(last.T_odom_left),
        )

    def found_again(self, gap: Gap, place: float | None) -> Atlas:
        """With a gap after which the camera was found in the map.

        Args:
            gap: which has just ended.
            place: time of the keyframe in whose place it was found [s]; None where it was by landmarks it has.
        """
        anchor = self.anchor
        if place is not None:
            begun = [g.anchor for g in self.gaps if g.anchor is not None and g.until <= place]
            anchor = begun[-1] if begun else self.solved
        return replace(self, gaps=(*self.gaps, gap), anchor=anchor)

    def begun_anew(
        self, since: float, before: Estimate, after: Estimate, common: CommonError, models: EstimatorModels
    ) -> Atlas:
        """With another back end from here on, which takes the pose of the last one for exact: the map does not.

        Args:
            since: time of the last measured pose [s].
            before: the last estimate of the earlier one, with the rig's uncertainty.
            after: the first one of the other, at the same pose.
            common: what the pose's error has in common with those of other frames.
            models: say how fast a camera moves.
        """
        n = common.scale.shape[1]
        error, known = (np.zeros(n), np.eye(n)) if self.anchor is None else self.anchor.belief(common)
        P = moved_unseen(self.estimate(before, common).covariance, after.stamp - since, models)
        anchor = Anchor(after.T_world_left, after.covariance, block_diag(P, known), error, common)
        return replace(self, gaps=(*self.gaps, Gap(since, after.stamp, P, anchor)), anchor=anchor)

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
        poses, count, m = self.rows.poses.copy(), len(self), len(rig.scale)
        if path is not None:
            poses[self.known :] = path.poses[np.searchsorted(path.stamps, self.rows.stamps[self.known :])]
        shares = self.rows.shares
        if shares.shape[2] != m:  # all are of a prior map that was made without them
            shares = np.zeros((count, 6, m))
        common = (shares.reshape(6 * count, m) @ rig.scale).reshape(count, 6, rig.scale.shape[1])
        common[1:] -= adjoints(inverse(poses[1:]) @ poses[:-1]) @ common[:-1]
        return Chain(poses, self.rows.steps, common)

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

    def estimate(self, estimate: Estimate, common: CommonError, gaps: bool = True) -> Estimate:
        """An estimate in odom, taken to the map; after a loop or a restart it is as certain as its anchor says.

        Args:
            estimate: with covariances by noise and by the common error.
            common: what the pose's error has in common with those of other frames.
            gaps: whether landmarks are also as uncertain as where their map begins, which is the same for all of them.
        """
        if self.anchor is None:
            return estimate
        T, R = self.T_map_odom, self.T_map_odom[:3, :3]
        anchor = self.anchor
        back = adjoint(inverse(estimate.T_world_left) @ anchor.T_odom_left)
        noise = what_was_added(estimate.covariance - common.covariance, back @ anchor.noise @ back.T)
        covariance = anchor.later(back, common.shares - back @ anchor.rig.shares) + noise
        return replace(
            estimate,
            T_world_left=T @ estimate.T_world_left,
            covariance=covariance,
            positions=estimate.positions @ R.T + T[:3, 3],
            covariances=R @ landmarks_by_pose(estimate, covariance, may_grow=gaps and bool(self.gaps)) @ R.T,
        )

    def path(self, path: Trajectory) -> Trajectory:
        """A path in odom, taken to the map; what loops move two keyframes by is shared out evenly in time between."""
        if self.solved is None or not len(path):
            return path
        from slam.mapping.atlas.pose_graph import solve

        chain = self.chain(self.solved.rig, path)
        moved = solve(chain, self.loops, self.in_map(chain)).poses
        stamps = self.rows.stamps[self.known :]
        return Trajectory(path.stamps, _between_keyframes(path, stamps, moved[self.known :], self._unseen_time))

    def _unseen_time(self, stamps: Array) -> Array:
        """Time (N,) [s] before `stamps` in which back ends had been moved unseen."""
        times = np.array([(gap.since, gap.until) for gap in self.gaps]).reshape(-1, 2)
        lasted = np.clip(stamps[:, None], times[:, 0], times[:, 1]) - times[:, 0]
        return np.asarray(lasted.sum(axis=1))


def moved_unseen(covariance: Array, duration: float, models: EstimatorModels) -> Array:
    """Covariance (6, 6) of a predicted pose after a gap, in which a camera may have moved as cameras of its kind do.

    The prediction takes changes of velocity for noise. Over a gap, a bend or a stop is none: the velocity after it is
    that of a camera of which nothing is known. Nor can a direction or a place be more uncertain than unknown ones.

    Args:
        covariance: by the motion model (6, 6).
        duration: of the gap [s].
        models: velocities of a camera of this kind.
    """
    speeds = np.array([models.initial_angular_velocity_sigma, models.initial_velocity_sigma])
    most = np.array([_UNKNOWN_DIRECTION, ANYWHERE])
    P = covariance + np.diag(np.repeat(np.minimum(speeds * duration, most), 3) ** 2)
    largest = np.sqrt([np.linalg.eigvalsh(P[:3, :3])[-1], np.linalg.eigvalsh(P[3:, 3:])[-1]])
    scale = np.repeat(np.minimum(1.0, most / largest), 3)
    return np.asarray(scale[:, None] * P * scale)


def landmarks_by_pose(estimate: Estimate, covariance: Array, may_grow: bool = False) -> Array:
    """Covariances (N, 3, 3) of landmarks after the camera's pose, from which they are seen, has got another one (6, 6).

    What a landmark's covariance has more than the pose's at its place is its own, and stays. A landmark that was surer
    in the estimate keeps its covariance: its place does not depend on where the camera is now. Not so where they
    `may_grow`: in a back end that was begun anew, all landmarks are as uncertain as where it was begun.
    """
    T, P = estimate.T_world_left, estimate.covariances
    J = T[:3, :3] @ points_by_pose(transform(inverse(T), estimate.positions))
    before, after = (J @ pose @ np.swapaxes(J, 1, 2) for pose in (estimate.covariance, covariance))
    moved = what_was_added(P, before) + after
    surer = np.trace(moved, axis1=1, axis2=2) < np.trace(P, axis1=1, axis2=2)
    return np.where((surer | may_grow)[:, None, None], moved, P)


def _between_keyframes(path: Trajectory, stamps: Array, moved: Array, unseen_time: Callable[[Array], Array]) -> Array:
    """Poses (N, 4, 4) of a path whose keyframes, at `stamps` (K,), are moved to other poses (K, 4, 4).

    Between two keyframes the change is shared out evenly in time; where the camera was moved unseen between them, over
    that time alone, which `unseen_time` gives.
    """
    rows = np.searchsorted(path.stamps, stamps)
    odom = path.poses[rows]
    at = np.clip(np.searchsorted(stamps, path.stamps, side="right") - 1, 0, len(stamps) - 1)
    to = np.minimum(at + 1, len(stamps) - 1)
    step = inverse(odom[at]) @ odom[to]
    change = log(inverse(step) @ inverse(moved[at]) @ moved[to])
    since, span = (unseen_time(x) - unseen_time(stamps[at]) for x in (path.stamps, stamps[to]))
    seen = span <= 0
    since, span = np.where(seen, path.stamps - stamps[at], since), np.where(seen, stamps[to] - stamps[at], span)
    share = np.clip(since / np.where(to > at, span, 1.0), 0.0, 1.0)
    return shared_out(
        moved[at], inverse(odom[at]) @ path.poses, inverse(path.poses) @ odom[to], share[:, None] * change
    )
