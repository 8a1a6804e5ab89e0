"""The estimate of a moving body: the camera in its last frames, moving among the body's points.

Seen from the body it is the camera that moves: so a body is a window of camera poses in the body and of points, solved
by `slam.window`. What ties the frames together besides the points is the body's motion, constant velocity in the world
but for random impulses, by the camera's own motion with its uncertainty. Frames that leave are marginalised, so that a
body that is seen for long does not drift. The camera's estimate is read and never changed.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from slam.bodies.belief import BodyBelief, Points, begun, carried, compact, slid, window
from slam.bodies.config import MIN_POINTS, RUN
from slam.chi_square import chi_square_limit, chi_square_limits
from slam.data import BoolArray, IdArray, IndexArray, RecentPoses
from slam.geometry.arrays import changed, isin
from slam.geometry.rig import MINIMAL_POINTS, StereoRig, measurement_rows
from slam.geometry.se3 import Array, adjoint, inverse, log, pose, so3_exp, so3_left_jacobian, so3_log, transform, twice
from slam.models import EstimatorModels
from slam.object_data import ObjectEstimate, ObjectObservations
from slam.window import pose_only
from slam.window.gating import INFLATION
from slam.window.problem import Rows
from slam.window.solver import Solution, linearised, solve
from slam.window.stereo import RectifiedStereo, relative_covariance

FRAMES = 4  #: cost: frames of a window; older ones are marginalised
_LEAST = 2  # points that must agree with a body that has more: one agrees with some pose always


@dataclass(frozen=True, eq=False)
class _Seen:
    """Observations of a body in the rectified rig."""

    given: ObjectObservations
    z: Array  # pixels (M, 3)
    local: Array  # where they triangulate to (M, 3)
    deep: BoolArray  # which have a depth (M,)
    least: int  # number of known points that must agree


@dataclass(frozen=True, eq=False)
class _Expected:
    """A belief with a new frame that is not measured yet."""

    belief: BodyBelief  # with the predicted pose; it has no covariance yet
    # of the new pose given the last one (6, 6): by the velocity, its impulse, and the camera's motion
    covariance: Array
    impulse: Array  # what the impulse adds to it (6, 6)
    local: Array  # covariances of the points in the new camera, for a known motion since the last frame (N, 3, 3)


class BodyEstimator:
    """Estimates bodies one by one; all that is known of one is its `BodyBelief`."""

    def __init__(self, rig: StereoRig, models: EstimatorModels) -> None:
        self.stereo = RectifiedStereo.of(rig)
        self.sigma = models.pixel_sigma
        self.models = models.objects
        self.gate = models.gate_probability

    def updated(
        self, belief: BodyBelief | None, id: int, seen: ObjectObservations | None, cameras: RecentPoses, least: int = 1
    ) -> BodyBelief | None:
        """The belief after one more frame, the newest of the camera's `FRAMES` + 1 last poses.

        Where fewer than `least` points agree it is predicted. A body of which nothing is known begins anew, if at least
        three points have a depth; else it stays None.
        """
        measured = after = None
        if seen is not None:
            z = measurement_rows(seen.uv_left, seen.uv_right - self.stereo.doffs)
            local = self.stereo.triangulate(z)
            measured = _Seen(seen, z, local, np.asarray(np.isfinite(local).all(axis=1)), least)
        if belief is not None and len(cameras) > 1:
            with suppress(np.linalg.LinAlgError):
                after = self._followed(belief, id, measured, cameras)
        if measured is not None and belief is None:
            with suppress(np.linalg.LinAlgError):
                return self._begun(id, measured, cameras)
        return after

    def _begun(self, id: int, seen: _Seen, cameras: RecentPoses) -> BodyBelief | None:
        """A new belief: the body's frame is put where it is said to be. False stereo matches are left out."""
        X, stamp, near = cameras.poses[-1], float(cameras.stamps[-1]), seen.deep.copy()
        near[seen.deep] = compact(seen.local[seen.deep])
        if near.sum() < MINIMAL_POINTS:
            return None
        T = seen.given.T_world_object
        velocity, sigmas = self.models.first_velocity(seen.given)
        none = np.zeros(0, np.int64)
        estimate = ObjectEstimate(
            id, stamp, T, np.zeros((6, 6)), velocity, np.diag(sigmas**2), True, none, none
        )  # fmt: skip
        b = begun(stamp, inverse(T) @ X, velocity, sigmas, estimate)
        b, joined = self._joined(b, seen, near)
        return self._reported(b, id, cameras, True, seen.given.points[joined], none)

    def _followed(self, b: BodyBelief, id: int, seen: _Seen | None, cameras: RecentPoses) -> BodyBelief:
        """The belief with a further frame; LinAlgError where it cannot be solved."""
        cameras = _of(cameras, np.append(b.stamps, cameras.stamps[-1]))
        if len(b) >= FRAMES:
            motion = carried(b, _part(cameras, 0, len(b)), self.models)
            b = slid(b, self.stereo, motion, self.models.drift / self.stereo.f)
            cameras = _part(cameras, 1, len(cameras))
        expected = self._expected(b, cameras)
        rejected = none = np.zeros(0, np.int64)
        if seen is not None:
            after = self._corrected(b, expected, id, seen, cameras)
            if after is not None:
                return after
            rejected = np.sort(seen.given.points[isin(seen.given.points, b.points.ids)])
        return self._reported(self._predicted(expected.belief, cameras), id, cameras, False, none, rejected)

    def _corrected(
        self, before: BodyBelief, expected: _Expected, id: int, seen: _Seen, cameras: RecentPoses
    ) -> BodyBelief | None:
        """The belief by what was seen; None where too little agrees, or the motion would be no body's."""
        b, used, rejected = self._solved(expected, seen, cameras)
        if b is None:
            return None
        b, joined = self._joined(b, seen, ~isin(seen.given.points, np.concatenate([used, rejected])))
        good = np.sort(np.concatenate([used, seen.given.points[joined]]))
        after = self._reported(b, id, cameras, True, good, np.sort(rejected))
        e, last, dt = after.estimate, before.estimate, float(b.stamps[-1] - b.stamps[-2])
        possible = self.models.possible(
            e.velocity, e.velocity_covariance, last.velocity, last.velocity_covariance, dt
        )  # fmt: skip
        return after if possible else None

    def _expected(self, b: BodyBelief, cameras: RecentPoses) -> _Expected:
        """With the new frame's pose as the motion model predicts it."""
        dt = float(cameras.stamps[-1] - cameras.stamps[-2])
        T, velocity = cameras.poses[-2] @ inverse(b.poses[-1]), b.estimate.velocity
        T = pose(so3_exp(dt * velocity[:3]) @ T[:3, :3], T[:3, 3] + dt * velocity[3:])
        Y = inverse(T) @ cameras.poses[-1]
        b = changed(
            b, stamps=cameras.stamps, poses=np.concatenate([b.poses, Y[None]]), scales=np.append(b.scales, 1.0),
            points=changed(b.points, unseen=b.points.unseen + 1),
        )  # fmt: skip
        by_step = adjoint(inverse(Y)) * dt
        back = twice(T[:3, :3].T)
        impulses = by_step * np.sqrt(np.repeat(self.models.velocity_variance(dt)[::-1], 3))
        covariance = by_step @ back @ b.estimate.velocity_covariance @ back.T @ by_step.T
        turn = Y[:3, :3].T @ b.poses[-2][:3, :3]
        way, impulse = cameras.covariance[-12:, -12:], impulses @ impulses.T
        covariance = covariance + impulse + relative_covariance(way, cameras.poses[-2], cameras.poses[-1])
        return _Expected(b, covariance, impulse, turn @ b.points.local @ turn.T)

    def _predicted(self, b: BodyBelief, cameras: RecentPoses) -> BodyBelief:
        """With the covariances of a frame in which nothing was measured."""
        e = linearised(window(b, self.stereo, carried(b, cameras, self.models)))
        solution = Solution(e.window, e, np.linalg.cholesky(e.H), e.cost)
        local, _ = solution.point_covariances(len(b) - 1)
        return changed(b, covariance=solution.pose_covariance, points=changed(b.points, local=local))

    def _solved(
        self, expected: _Expected, seen: _Seen, cameras: RecentPoses
    ) -> tuple[BodyBelief | None, IdArray, IdArray]:
        """The belief by what was seen of its points, and the ids used and rejected; None where too little agrees."""
        b = expected.belief
        place = {i: row for row, i in enumerate(b.points.ids.tolist()) if i >= 0}
        rows = np.array([place.get(i, -1) for i in seen.given.points.tolist()], np.intp)
        known = np.flatnonzero(rows >= 0)
        rows, z, ids = rows[known], seen.z[known], seen.given.points[known]
        if not len(rows):
            return None, ids, ids
        Y, used, scale = self._agreement(expected, rows, z)
        b = changed(
            b, poses=np.concatenate([b.poses[:-1], Y[None]]), scales=np.append(b.scales[:-1], scale)
        )  # fmt: skip
        motion = carried(b, cameras, self.models)
        limits = chi_square_limits(2 + np.isfinite(z[:, 2]), self.gate)
        enough = max(seen.least, min(_LEAST, (int(b.alive.sum()) + 1) // 2))
        while True:  # without those that disagree with the others
            if used.sum() < enough:
                return None, ids[:0], ids
            tried = changed(b, rows=b.rows.joined(Rows.of(len(b) - 1, rows[used], z[used], self.sigma)))
            solution = solve(window(tried, self.stereo, motion))
            local, _ = solution.point_covariances(len(b) - 1)
            distances = solution.left_out_distances(-1, rows[used], z[used], local[rows[used]], self.sigma)
            excess = distances / limits[used]
            bad = excess > max(1.0, 0.5 * float(excess.max()))  # the worst draw the pose, and others seem bad
            if not bad.any():
                break
            used[np.flatnonzero(used)[bad]] = False
        return self._after(tried, solution, local, rows, used), ids[used], ids[~used]

    def _agreement(self, expected: _Expected, rows: IndexArray, z: Array) -> tuple[Array, BoolArray, float]:
        """The pose on which most observations agree, which ones, and by what factor the impulse must be larger."""
        b = expected.belief
        predicted, points = b.poses[-1], b.points.position[rows]
        local = transform(inverse(predicted), points)
        noise = pose_only.residual_noise(self.stereo, self.sigma, local, expected.local[rows], z)
        most, limit = max(MIN_POINTS, (len(rows) + 1) // 2), chi_square_limit(6, self.gate)
        first = None
        for factor in (0.0, *INFLATION):
            information = np.linalg.inv(expected.covariance + factor**2 * expected.impulse)
            problem = pose_only.PoseProblem(self.stereo, points, z, noise, predicted, information, self.gate)
            Y, used = pose_only.solve(problem, predicted)
            off = log(inverse(predicted) @ Y)
            tried = Y, used, float(np.hypot(1.0, factor))
            first = first or tried
            if len(rows) < most or (used.sum() >= most and off @ information @ off < limit):
                return tried
        assert first is not None
        return first

    def _after(self, b: BodyBelief, solution: Solution, local: Array, rows: IndexArray, used: BoolArray) -> BodyBelief:
        """The belief at a solution; points that failed too often are given up."""
        p = b.points
        failures, unseen, ids = p.failures.copy(), p.unseen.copy(), p.ids.copy()
        failures[rows] = np.where(used, 0, failures[rows] + 1)
        unseen[rows] = 0
        ids[failures >= RUN] = -1
        w = solution.window
        return changed(
            b, poses=w.poses, covariance=solution.pose_covariance,
            points=changed(p, ids=ids, position=w.points, local=local, failures=failures, unseen=unseen),
        )  # fmt: skip

    def _joined(self, b: BodyBelief, seen: _Seen, new: BoolArray) -> tuple[BodyBelief, IndexArray]:
        """With those of the new observations that have a depth, as far as there is room; and which they are."""
        which = np.flatnonzero(new & seen.deep)
        alive, unseen = np.flatnonzero(b.alive), b.points.unseen
        hidden = alive[unseen[alive] > 0]
        surplus = len(alive) + len(which) - self.models.points
        gone = hidden[np.argsort(-unseen[hidden], kind="stable")][: max(surplus, 0)]  # the longest unseen make room
        which = which[: self.models.points - len(alive) + len(gone)]
        if not len(which):
            return b, which
        ids = b.points.ids.copy()
        ids[gone] = -1
        h = seen.local[which]
        own = self.stereo.rig.triangulation_covariance(h, self.sigma)
        new_points = Points.new(seen.given.points[which], transform(b.poses[-1], h), own, b.poses[-1][:3, 3])
        at = len(ids) + np.arange(len(which))
        points = changed(b.points, ids=ids).joined(new_points)
        return changed(
            b, points=points, rows=b.rows.joined(Rows.of(len(b) - 1, at, seen.z[which], self.sigma))
        ), which  # fmt: skip

    def _reported(
        self, b: BodyBelief, id: int, cameras: RecentPoses, measured: bool, used: IdArray, rejected: IdArray
    ) -> BodyBelief:
        """With the estimate of its newest frame, where the camera's uncertainty is part of all that is in the world."""
        X, Y = cameras.poses[-2:], b.poses[-2:]
        k = 6 * len(Y)
        by_pose = np.zeros((k, k))
        for i, A in enumerate(adjoint(Y)):
            by_pose[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = A
        P = by_pose @ (b.covariance[-k:, -k:] + cameras.covariance[-k:, -k:]) @ by_pose.T  # of the body's poses
        T = X[-len(Y) :] @ inverse(Y)
        velocity, spread = b.velocity, np.diag(b.sigmas**2)
        if len(b) > 1:
            velocity, J = _velocity(T[0], T[1], float(b.stamps[-1] - b.stamps[-2]))
            spread = J @ P @ J.T
        estimate = ObjectEstimate(
            id, float(b.stamps[-1]), T[-1], P[-6:, -6:], velocity, spread, measured, used, rejected
        )  # fmt: skip
        if not all(np.isfinite(a).all() for a in (estimate.T_world_object, estimate.covariance, velocity, spread)):
            raise np.linalg.LinAlgError("a body's estimate is not finite")
        return changed(b, estimate=estimate)


def _of(cameras: RecentPoses, stamps: Array) -> RecentPoses:
    """The camera's poses at some of their stamps (K,), ascending; LinAlgError where one of them is not there."""
    n, first = len(cameras), len(cameras) - len(stamps)
    if first >= 0 and (cameras.stamps[first:] == stamps).all():
        return _part(cameras, first, n)
    at = np.searchsorted(cameras.stamps, stamps).clip(0, n - 1)
    if first < 0 or (cameras.stamps[at] != stamps).any():
        raise np.linalg.LinAlgError("the camera's poses in a body's frames are not known")
    rows = (6 * at[:, None] + np.arange(6)).reshape(-1)
    return RecentPoses(cameras.stamps[at], cameras.poses[at], cameras.covariance[rows[:, None], rows])


def _part(cameras: RecentPoses, first: int, end: int) -> RecentPoses:
    """The camera's poses from one to before another."""
    if end - first == len(cameras):
        return cameras
    P = cameras.covariance[6 * first : 6 * end, 6 * first : 6 * end].copy()
    return RecentPoses(cameras.stamps[first:end], cameras.poses[first:end], P)


def _velocity(before: Array, after: Array, dt: float) -> tuple[Array, Array]:
    """Velocity [ω, v] (6,) in world axes between two poses, and derivatives (6, 12) by both, perturbed on the right."""
    turn = so3_log(after[:3, :3] @ before[:3, :3].T)
    J = np.zeros((6, 12))
    by_turn = np.linalg.inv(so3_left_jacobian(turn)) @ after[:3, :3] / dt
    J[:3, :3], J[:3, 6:9] = -by_turn, by_turn
    J[3:, 3:6], J[3:, 9:] = -before[:3, :3] / dt, after[:3, :3] / dt
    return np.concatenate([turn, after[:3, 3] - before[:3, 3]]) / dt, J
