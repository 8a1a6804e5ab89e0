"""The atlas: keyframes and loops of a run, and the pose of the back end's frame in the map.

The back end keeps estimating in its own frame, *odom*, which drifts but never jumps. A loop moves the keyframes in the
map; ``T_map_odom``, the pose of odom in the map, then takes the newest keyframe to its pose in the pose graph. All
poses that the system reports are in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from slam.atlas.keyframes import Keyframe, Loop, covariance_growth
from slam.atlas.places import PlaceIndex
from slam.atlas.pose_graph import Chain, PoseGraph, between_keyframes
from slam.data import CommonError, Estimate
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.models import ANYWHERE, EstimatorModels

_ACTIVE = 200  # cost: loops in the pose graph at most: each makes the next one slower
_INACTIVE = 200  # cost: loops outside the pose graph that are kept
_UNKNOWN_DIRECTION = np.pi / np.sqrt(3)  # derived: standard deviation of an unknown angle [rad]


@dataclass(frozen=True, eq=False)
class MapAnchor:
    """A pose with its uncertainty in the map, from which those of later poses are propagated.

    It is the newest keyframe's at the last loop closure, or the first pose of a new back end that has started since.
    """

    T_odom_left: Array  # the pose (4, 4), as the back end estimated it then
    noise: Array  # its covariance (6, 6) in the back end, without the common errors
    # in the map: joint covariance (6 + n, 6 + n) of the pose, perturbing on the right, and of the common errors
    covariance: Array
    common: Array  # estimate of the common errors (n,), in units of their prior standard deviations
    rig: CommonError  # what the common errors stand for and how they move the pose, see `slam.data.CommonError`

    def belief(self, rig: CommonError) -> tuple[Array, Array]:
        """The common errors (n,) in units of `rig`, as the rig's posterior has changed since, and their covariance.

        They are zero, and the covariance (n, n) unity, if there are others by now.
        """
        if rig.root.shape != self.rig.root.shape:
            return np.zeros(rig.root.shape[1]), np.eye(rig.root.shape[1])
        return np.linalg.lstsq(rig.root, self.rig.root @ self.common, rcond=None)[0], self.covariance[6:, 6:]

    def later(self, back: Array, shares: Array) -> Array:
        """Covariance (6, 6) of a later pose, without the noise since; the anchor's pose there has the adjoint `back`.

        The path since is not corrected by the common errors, so their estimate counts as an error too, by `shares`
        (6, m), the derivative of the motion since.
        """
        J = np.concatenate([back, shares @ self.rig.root], axis=1)
        shared = shares @ self.rig.root @ self.common
        return np.asarray(J @ self.covariance @ J.T + np.outer(shared, shared))


@dataclass(frozen=True, eq=False)
class TrackingGap:
    """A time in which the camera moved without being tracked, and after which a new back end took over."""

    since: float  # time of the last measured pose before it [s]
    until: float  # time of the first pose after it [s]
    # of that pose (6, 6), perturbing on the right, see `covariance_after_unseen_motion`; None if the camera was found
    # elsewhere, so that nothing is known of its motion
    covariance: Array | None = None
    # the first pose after it, if a new map begins there that no loop has tied to the rest so far
    anchor: MapAnchor | None = None


@dataclass(frozen=True, eq=False)
class Atlas:
    """What a run keeps of the places that it has visited."""

    keyframes: tuple[Keyframe, ...] = ()  # in order of time
    index: PlaceIndex = field(default_factory=PlaceIndex)  # of their appearance, for place recognition
    loops: tuple[Loop, ...] = ()  # those in the pose graph
    # the latest verified loops outside the pose graph: refused, unconfirmed, or not informative
    inactive_loops: tuple[Loop, ...] = ()
    refused: tuple[tuple[int, int], ...] = ()  # loops that contradict the path, as pairs of keyframe numbers
    # poses T_map_left (C, 4, 4) of the first C keyframes, as of the last loop closure
    corrected: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    solved: MapAnchor | None = None  # the anchor at the last of these; None without a loop
    # from which the present pose's covariance is propagated: `solved`, or where a new map has started since
    anchor: MapAnchor | None = None
    T_map_odom: Array = field(default_factory=lambda: np.eye(4))  # pose (4, 4) of the back end's frame in the map
    pending: Loop | None = None  # the last loop that passed the gate, whether in the pose graph or not
    confirmed: bool = False  # whether another keyframe shortly before agreed with `pending`
    gaps: tuple[TrackingGap, ...] = ()  # one before each back end but the first
    restarts: int = 0  # number of gaps before the last keyframe
    dropped: int = 0  # number of this run's loops taken out of the pose graph to save time
    prior_count: int = 0  # number of keyframes of the prior map that this run started in; they come first

    def __len__(self) -> int:
        return len(self.keyframes)

    @classmethod
    def of_earlier_run(cls, keyframes: Sequence[Keyframe], poses: Array, loops: Sequence[Loop] = ()) -> Atlas:
        """The places of a saved map.

        Its keyframes have poses in the frame of the back end that estimated them; `poses` (K, 4, 4) are those in the
        map, which `loops` gave.
        """
        atlas = cls()
        for keyframe in keyframes:
            atlas = atlas.with_new(replace(keyframe, frame=-1))
        return replace(atlas, loops=tuple(loops), corrected=poses, prior_count=len(atlas))

    def with_new(self, keyframe: Keyframe) -> Atlas:
        """A copy with one more keyframe."""
        index = self.index.with_new(keyframe.descriptors)
        return replace(self, keyframes=(*self.keyframes, keyframe), index=index)

    @cached_property
    def stamps(self) -> Array:
        """Times of the keyframes (K,) [s]."""
        return np.array([k.stamp for k in self.keyframes], float)

    @cached_property
    def poses(self) -> Array:
        """Poses T_odom_left of the keyframes (K, 4, 4)."""
        return np.array([k.T_odom_left for k in self.keyframes], float).reshape(-1, 4, 4)

    @cached_property
    def travelled(self) -> Array:
        """Length of the path up to each keyframe (K,) [m]."""
        return np.array([k.travelled for k in self.keyframes], float)

    def inflated(self, first: int, last: int, factor: float) -> Atlas:
        """A copy in which the motions after keyframe `first` up to `last` have covariances larger by a factor."""
        grown = (replace(k, step_covariance=factor * k.step_covariance) for k in self.keyframes[first + 1 : last + 1])
        return replace(self, keyframes=(*self.keyframes[: first + 1], *grown, *self.keyframes[last + 1 :]))

    @cached_property
    def poses_in_map(self) -> Array:
        """Poses T_map_left (K, 4, 4) of all keyframes."""
        return self.in_map(self.poses)

    def summary(self) -> dict[str, int]:
        """Numbers of keyframes, of loops closed in this run, and of loops refused because they contradict the path.

        Keyframes of a prior map are included, and also counted separately as ``known``.
        """
        closed = sum(loop.second >= self.prior_count for loop in self.loops)
        prior = {"known": self.prior_count} if self.prior_count else {}
        return {"keyframes": len(self), **prior, "closed": closed + self.dropped, "refused": len(self.refused)}

    def with_loop(self, loop: Loop) -> Atlas:
        """A copy with one more loop; of too many, the one whose neighbours on the path are closest is dropped."""
        loops, dropped = (*self.loops, loop), self.dropped
        while len(loops) > _ACTIVE:
            at = self.travelled[[x.second for x in loops]]
            least = 1 + int(np.argmin(at[2:] - at[:-2]))
            dropped += loops[least].second >= self.prior_count
            loops = loops[:least] + loops[least + 1 :]
        return replace(self, loops=loops, dropped=dropped)

    def with_inactive_loop(self, loop: Loop) -> Atlas:
        """A copy with one more loop outside the pose graph."""
        return replace(self, inactive_loops=(*self.inactive_loops, loop)[-_INACTIVE:])

    def with_loops(self, chosen: Sequence[Loop], believed: Sequence[Loop]) -> Atlas:
        """A copy with other loops in the pose graph; previous ones that are not `believed` any more become refused.

        `chosen` and `believed` are in order of their second keyframes.
        """
        good, in_graph = {x.pair for x in believed}, {x.pair for x in chosen}
        out = [x for x in self.loops if x.pair not in in_graph]
        refused = [pair for pair in self.refused if pair not in good]
        refused += [x.pair for x in out if x.pair not in good]
        spare = [x for x in (*self.inactive_loops, *out) if x.pair not in in_graph][-_INACTIVE:]
        return replace(
            self, loops=tuple(chosen), inactive_loops=tuple(spare), refused=tuple(refused), pending=chosen[-1],
            confirmed=True,
        )  # fmt: skip

    def solved_by(self, graph: PoseGraph, rig: CommonError) -> Atlas:
        """A copy with the keyframes' poses by the pose graph; `rig` says what its common errors stand for."""
        last, poses = self.keyframes[-1], graph.keyframe_poses()
        shared = replace(rig, jacobian=last.jacobian)
        anchor = MapAnchor(last.T_odom_left, last.covariance, graph.covariance(), graph.common, shared)
        gaps = tuple(replace(gap, anchor=None) for gap in self.gaps)
        T_map_odom = poses[-1] @ inverse(last.T_odom_left)
        return replace(self, corrected=poses, solved=anchor, anchor=anchor, gaps=gaps, T_map_odom=T_map_odom)

    def relocalized(self, gap: TrackingGap, place: float | None) -> Atlas:
        """A copy with a gap after which the camera was found in the map.

        `place` [s] is the time of the keyframe by which it was found; None if it was found by the back end's landmarks.
        """
        anchor = self.anchor
        if place is not None:
            starts = [g.anchor for g in self.gaps if g.anchor is not None and g.until <= place]
            anchor = starts[-1] if starts else self.solved
        return replace(self, gaps=(*self.gaps, gap), anchor=anchor)

    def with_new_map(
        self, since: float, before: Estimate, after: Estimate, common: CommonError, models: EstimatorModels
    ) -> Atlas:
        """A copy with a new back end from here on, which takes its first pose for exact; in the map it is uncertain.

        The last pose was measured at `since` [s]. `before` is the earlier back end's last estimate, with the rig's
        uncertainty, of which `common` is a part; `after` is the new one's first, at the same pose.
        """
        n = common.root.shape[1]
        error, error_covariance = (np.zeros(n), np.eye(n)) if self.anchor is None else self.anchor.belief(common)
        P = covariance_after_unseen_motion(self.estimate(before, common).covariance, after.stamp - since, models)
        anchor = MapAnchor(after.T_world_left, after.covariance, block_diag(P, error_covariance), error, common)
        return replace(self, gaps=(*self.gaps, TrackingGap(since, after.stamp, P, anchor)), anchor=anchor)

    def partners(self, frame: int) -> tuple[int | None, int | None]:
        """The earlier frames with which `frame` closed a loop, and formed one that was refused; None for none."""
        closed, refused = (
            next((self.keyframes[one].frame for one, other in last if self.keyframes[other].frame == frame), None)
            for last in ([x.pair for x in self.loops[-1:]], self.refused[-1:])
        )
        return closed, refused

    def chain(self, rig: CommonError, path: Trajectory | None = None) -> Chain:
        """The keyframes' path in odom: as estimated at the time, or as revised in `path`.

        `rig` says what the common errors stand for now.
        """
        poses, count, m = self.poses.copy(), len(self), len(rig.root)
        if path is not None:
            poses[self.prior_count :] = path.poses[np.searchsorted(path.stamps, self.stamps[self.prior_count :])]
        none = np.zeros((6, m))  # of keyframes of a map that was made without the rig's uncertainty
        shares = np.array([k.jacobian if k.jacobian.shape[1] == m else none for k in self.keyframes])
        steps = np.array([k.step_covariance for k in self.keyframes])
        common = (shares.reshape(6 * count, m) @ rig.root).reshape(count, 6, rig.root.shape[1])
        common[1:] -= adjoint(inverse(poses[1:]) @ poses[:-1]) @ common[:-1]
        return Chain(poses, steps, common)

    def in_map(self, poses: Array) -> Array:
        """Poses (K, 4, 4) of all keyframes in the map, given those in odom; the last loop has set those before it."""
        return np.concatenate([self.corrected, self.T_map_odom @ poses[len(self.corrected) :]])

    def estimate(self, estimate: Estimate, common: CommonError, gaps: bool = True) -> Estimate:
        """An estimate in odom, transformed to the map; its covariance is propagated from the anchor, if there is one.

        Its covariances are by noise and by the `common` errors. With `gaps`, landmarks also get the uncertainty of the
        pose at which their map begins, which all share.
        """
        if self.anchor is None:
            return estimate
        T, R = self.T_map_odom, self.T_map_odom[:3, :3]
        anchor = self.anchor
        back = adjoint(inverse(estimate.T_world_left) @ anchor.T_odom_left)
        noise = covariance_growth(estimate.covariance - common.covariance, back @ anchor.noise @ back.T)
        covariance = anchor.later(back, common.jacobian - back @ anchor.rig.jacobian) + noise
        return replace(
            estimate,
            T_world_left=T @ estimate.T_world_left,
            covariance=covariance,
            positions=estimate.positions @ R.T + T[:3, 3],
            covariances=R @ landmarks_by_pose(estimate, covariance, may_grow=gaps and bool(self.gaps)) @ R.T,
        )

    def path(self, path: Trajectory) -> Trajectory:
        """A path in odom, transformed to the map; between keyframes the loops' corrections are interpolated in time."""
        if self.solved is None or not len(path):
            return path
        chain = self.chain(self.solved.rig, path)
        corrected = self.in_map(chain.poses)
        with suppress(np.linalg.LinAlgError):  # then the keyframes stay as the last loop left them
            corrected = PoseGraph.solved(chain, self.loops, corrected).keyframe_poses()
        stamps = self.stamps[self.prior_count :]
        return Trajectory(
            path.stamps, between_keyframes(path, stamps, corrected[self.prior_count :], self._unseen_time)
        )

    def _unseen_time(self, stamps: Array) -> Array:
        """Total duration (N,) [s] of gaps before each of `stamps` (N,) [s]."""
        times = np.array([(gap.since, gap.until) for gap in self.gaps]).reshape(-1, 2)
        lasted = np.clip(stamps[:, None], times[:, 0], times[:, 1]) - times[:, 0]
        return np.asarray(lasted.sum(axis=1))


def covariance_after_unseen_motion(covariance: Array, duration: float, models: EstimatorModels) -> Array:
    """Covariance (6, 6) of a predicted pose after a gap, in which the camera may have moved at any usual velocity.

    The motion model takes changes of velocity for white noise, which bends and stops in a long gap are not. So the
    motion model's initial velocity uncertainty acts throughout the gap as well, up to a wholly unknown direction and
    position. `covariance` (6, 6) is by the motion model, `duration` [s] that of the gap.
    """
    speeds = np.array([models.initial_angular_velocity_sigma, models.initial_velocity_sigma])
    most = np.array([_UNKNOWN_DIRECTION, ANYWHERE])
    P = covariance + np.diag(np.repeat(np.minimum(speeds * duration, most), 3) ** 2)
    largest = np.sqrt([np.linalg.eigvalsh(P[:3, :3])[-1], np.linalg.eigvalsh(P[3:, 3:])[-1]])
    scale = np.repeat(np.minimum(1.0, most / largest), 3)
    return np.asarray(scale[:, None] * P * scale)


def landmarks_by_pose(estimate: Estimate, covariance: Array, may_grow: bool = False) -> Array:
    """Covariances (N, 3, 3) of landmarks when the camera pose they are seen from has another covariance (6, 6).

    The pose's part of each landmark's covariance is exchanged for the new one; the rest, the landmark's own, stays. A
    landmark whose covariance would grow keeps its old one, as its position does not depend on the present pose. With
    `may_grow` it grows: in a new back end, all landmarks share the uncertainty of the pose at which it began.
    """
    T, P = estimate.T_world_left, estimate.covariances
    J = T[:3, :3] @ points_by_pose(transform(inverse(T), estimate.positions))
    before, after = (J @ pose @ np.swapaxes(J, 1, 2) for pose in (estimate.covariance, covariance))
    exchanged = covariance_growth(P, before) + after
    surer = np.trace(exchanged, axis1=1, axis2=2) < np.trace(P, axis1=1, axis2=2)
    return np.where((surer | may_grow)[:, None, None], exchanged, P)
