"""The steps of the smoother: functions from a state to the next.

Errors of the rig are considered, not estimated (Schmidt, 1966). The pose follows from the landmarks as they stand, and
each landmark from its measurements given the poses: these gains move the derivatives by the errors, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from backends.smoother.config import SmootherConfig
from backends.smoother.graph import Graph, Solved, SolverError
from backends.smoother.landmarks import VARIABLE, SmootherLandmarks, inverses
from backends.smoother.state import Known, Sight, SmootherState, Tie
from slam.data import IdArray, IndexArray, UpdateReport, UpdateStatus
from slam.geometry.se3 import Array, adjoint, exp, inverse, log, points_by_pose, rotation_angle, transform
from slam.window import motion, pose_only
from slam.window.consensus import landmarks_pose
from slam.window.gating import MIN_CONSENSUS
from slam.window.recovery import Agreement, agreement, unknown_turn, world_covariance
from slam.window.stereo import RectifiedMeasurement, relative_covariance

_SURE = 3.0  # guard: deviations of a turn in frames that saw nothing; half a turn and more looks like another one


@dataclass(frozen=True, eq=False)
class Steps(RectifiedMeasurement):
    """What the steps need besides the state."""

    config: SmootherConfig  # limits

    @property
    def track(self) -> int:
        """Most poses that a smart factor spans: it ends before its first pose leaves."""
        return self.config.track if self.config.lag is None else min(self.config.track, self.config.lag + 1)

    # --- prediction ---

    def predicted(self, s: SmootherState, stamp: float, rests: bool = False) -> SmootherState:
        """With the newest frame at `stamp` [s], by the motion model. The very first one is a pose of the graph."""
        if not s.started:
            T = self.models.initial_pose
            sigmas = np.repeat([self.models.initial_rotation_sigma, self.models.initial_position_sigma], 3)
            s = replace(s, stamps=np.array([np.nan, stamp]), last=np.stack([T, T]), frame=0)
            return _begun(s, T, np.diag(sigmas**2), Sight.none())
        dt = min(stamp - s.stamps[1], motion.LONGEST)
        before = None if s.since == 0 else min(s.stamps[1] - s.stamps[0], motion.LONGEST)
        T, J, noise, first = motion.predicted(self.models, s.last, before, dt, rests)
        cross = J @ s.pair[:, 6:]
        own = _carried(J, s.pair) + noise
        own = 0.5 * (own + own.T)
        return replace(
            s, stamps=np.array([s.stamps[1], stamp]), last=np.stack([s.last[1], T]), frame=s.frame + 1,
            pair=np.block([[s.own, cross.T], [cross, own]]),
            shared=np.concatenate([s.shared[:, 6:], s.shared @ J.T], axis=1),
            by_rig=np.concatenate([s.by_rig[6:], J @ s.by_rig]), since=s.since + 1, inside=False, measured=False,
            follows_pose=s.inside,
            tie=_tie(s, inverse(s.poses[-1]) @ T, own, s.shared @ J.T, dt, first, rests),
        )  # fmt: skip

    def in_view(self, s: SmootherState) -> tuple[IndexArray, Array, Array, Array]:
        """Landmarks in the angle of view (paper A, Fig. 3), their pixels, and innovation covariances (M, 2, 2)."""
        T, marks, rows = s.last[1], s.landmarks, s.landmarks.order
        rows = rows[self.visible(T, marks.position[rows])]
        local, own = pose_only.seen_from(T, marks.position[rows], marks.from_newest[rows])
        by_pose = points_by_pose(local)
        by_motion = np.where(marks.world[rows, None, None], s.covariance, s.own)
        C = own + by_pose @ by_motion @ np.swapaxes(by_pose, 1, 2)
        return rows, *self.pixels(local, C)

    # --- update ---

    def updated(
        self, s: SmootherState, graph: Graph, ids: IdArray, z: Array, guess: Array | None
    ) -> tuple[SmootherState, UpdateReport]:
        """After measurements z (M, 3) of landmarks."""
        rows, s = s.landmarks.rows_of(ids), replace(s, measured=True)
        if not len(rows):
            return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no landmark was observed")
        try:
            one = self._problem(s, rows, z)
            R, start = s.poses[-1][:3, :3], one.predicted if guess is None else guess
            lost = len(s.sights[-1]) >= MIN_CONSENSUS and unknown_turn(R @ s.spread[-1][:3, :3] @ R.T - s.turned)
            found = agreement(
                one, start, lambda: landmarks_pose(self, one.points, z, one.predicted, s.number), s.contradicted, lost
            )
            s = replace(s, contradicted=found.contradicted)
            if not found.used.any():
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", ids.copy())
            after, nis, why = self._corrected(s, graph, one, found, rows, z)
        except (np.linalg.LinAlgError, SolverError) as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"smoother: the pose cannot be solved for: {error}")
        used = found.used
        reason = f"smoother: built anew after {why}" if why else ""
        return after, UpdateReport(UpdateStatus.OK, reason, ids[used], ids[~used], nis, int(np.isfinite(z[used]).sum()))

    def _problem(self, s: SmootherState, rows: IndexArray, z: Array) -> pose_only.PoseProblem:
        """The newest pose alone, with the motion model as its prior, and landmarks as they stand."""
        T, marks = s.last[1], s.landmarks
        local, own = pose_only.seen_from(T, marks.position[rows], marks.from_newest[rows])
        noise = pose_only.residual_noise(self.stereo, self.models.pixel_sigma, local, own, z)
        P = s.covariance if s.inside or marks.world[rows].any() else s.own
        probability = self.models.gate_probability
        return pose_only.PoseProblem(self.stereo, marks.position[rows], z, noise, T, np.linalg.inv(P), probability)

    def _corrected(
        self, s: SmootherState, graph: Graph, one: pose_only.PoseProblem, found: Agreement, rows: IndexArray, z: Array
    ) -> tuple[SmootherState, float, str]:
        """The state after an update, its NIS, and why gtsam failed, if it did."""
        used, marks = found.used, s.landmarks
        seen, number = rows[used], s.number + (found.jump is not None or not s.inside)
        if found.jump is not None:
            marks = marks.without_measurements(np.ones(len(marks), bool)).measured(seen, z[used], number, self.track)
            after = _begun(s, found.T, world_covariance(s.covariance), Sight.of(marks, seen, z[used]))
            known = {serial: one for serial, one in s.known.items() if one.pose < 0}
            after = replace(after, known=known, landmarks=marks)
            return self.settled(after, graph.rebuilt(after)), float("nan"), ""
        one = replace(one, points=one.points[used], z=z[used], noise=one.noise[used])
        field, before = self.field(one.z), marks.by_rig[seen]
        G, F = _by_pose_and_rig(one, found.T, before, field)
        x = log(inverse(one.predicted) @ found.T)
        nis = float(one.distances(found.T).sum() + x @ one.information @ x)
        by_rig = np.linalg.solve(one.information + G.T @ G, one.information @ s.by_rig[6:] + G.T @ F)
        marks = replace(marks, by_rig=marks.by_rig.copy())
        own = marks.from_newest[seen]
        marks.by_rig[seen] = _landmarks_by_rig(one, found.T, by_rig, before, field, own, self.models.pixel_sigma)
        linear = math.sqrt(self.stereo.f / self.models.pixel_sigma)
        marks = marks.with_variables(seen, z[used], number, self.track, self.config.landmarks, found.T, linear)
        marks = marks.measured(seen, z[used], number, self.track, graph.oldest(s, number), graph.number)
        sight = Sight.of(marks, seen, z[used])
        if s.inside:  # the very first frame, in a map that is known
            after = replace(
                s, sights=(*s.sights[:-1], sight), poses=np.concatenate([s.poses[:-1], found.T[None]]),
                last=np.stack([s.last[0], found.T]), landmarks=marks, by_rig=np.concatenate([s.by_rig[:6], by_rig]),
            )  # fmt: skip
            return self.settled(after, graph.rebuilt(after)), nis, ""
        after = replace(_joined(_smoothed(s, found.T, G.T @ G, by_rig), sight), landmarks=marks)
        solved, why = graph.followed(after)
        after = self.settled(after, solved)
        drift = _drift(solved.covariance, after.poses[-2], after.poses[-1])
        marks = after.landmarks.without_variables(number) if why else after.landmarks
        return replace(after, landmarks=marks.left_behind(seen, after.poses[-1], drift)), nis, why

    def settled(self, s: SmootherState, solved: Solved) -> SmootherState:
        """The state with what the graph says: the newest frame is a pose of it."""
        poses = np.concatenate([s.poses[: s.of(solved.first)], solved.poses])
        P, last = solved.covariance, s.last.copy()
        pair: Array = np.zeros((12, 12))
        shared: Array = np.zeros((6, 12))
        if s.since:
            newest_first = np.roll(s.pair, 6, (0, 1))
            if len(P) == 12 and s.follows_pose:
                newest_first, last[0] = np.roll(P, 6, (0, 1)), poses[-2]
            else:
                last[0] = poses[-1] @ inverse(s.last[1]) @ s.last[0]
            pair, shared = _before(newest_first, poses[-1], last[0])
        last[1] = poses[-1]
        spread = np.concatenate([s.spread[: -len(solved.spread)], solved.spread])
        marks = s.landmarks.refined(self.stereo, self.models.pixel_sigma, s.first, poses)
        marks = marks.solved(solved.serials, solved.points, solved.linearised)
        known = {n: s.known[n] for n in s.sights[-1].serials.tolist() if n in s.known and s.known[n].used < 0}
        used = {n: replace(one, used=s.number) for n, one in known.items()}
        s = replace(
            s, poses=poses, last=last, pair=pair, shared=shared, spread=spread, landmarks=marks,
            known={**s.known, **used} if used else s.known,
        )  # fmt: skip
        lag = self.config.lag
        kept = len(s.poses) if lag is None else lag + 1 + self.config.past
        return s if lag is None or len(s.poses) < 1.5 * kept else s.without_old(kept, lag)

    # --- landmarks ---

    def added(self, s: SmootherState, ids: IdArray, z: Array) -> SmootherState:
        """With new landmarks at their first sight z (M, 3) in the newest pose (paper A, Eqs. 8 and 10).

        Raises MeasurementError where one is in the map already, or has no right pixel or no positive depth.
        """
        s.landmarks.require_new(ids)
        s = s if s.inside else _entered(s)
        marks, new = _seen_from_newest(s, ids, *self.first_sight(ids, z)), np.arange(len(ids))
        marks = replace(marks, information=np.zeros_like(marks.information)).measured(new, z, s.number, self.track)
        s = replace(s, sights=(*s.sights[:-1], s.sights[-1].joined(Sight.of(marks, new, z))))
        return _with(s, marks)

    def inserted(self, s: SmootherState, ids: IdArray, positions: Array, covariances: Array) -> SmootherState:
        """With landmarks known in the world; see `slam.interfaces.MapBackend.insert`."""
        none = np.zeros((len(ids), 3, s.by_rig.shape[1]))
        marks = SmootherLandmarks.of(ids, s.serials, positions, covariances, inverses(covariances), True, none)
        known = {serial: Known(x, P, -1) for serial, x, P in zip(marks.serial.tolist(), positions, covariances)}
        return replace(_with(s, marks), known={**s.known, **known}, measured=s.measured)

    def placed(self, s: SmootherState, ids: IdArray, local: Array, covariances: Array) -> SmootherState:
        """With landmarks known in the newest camera's coordinates; see `slam.interfaces.MapBackend.place`."""
        marks = _seen_from_newest(s, ids, local, covariances, np.zeros((len(ids), 3, s.by_rig.shape[1])))
        T, by_pose = inverse(s.poses[-1]) @ s.last[1], points_by_pose(local)
        there = T[:3, :3] @ (covariances + by_pose @ s.own @ np.swapaxes(by_pose, 1, 2)) @ T[:3, :3].T
        relative = zip(marks.serial.tolist(), transform(T, local), there)
        return replace(
            _with(s, marks), known={**s.known, **{serial: Known(x, P, s.number) for serial, x, P in relative}}
        )

    def removed(self, s: SmootherState, ids: IdArray) -> SmootherState:
        """Without landmarks; what their measurements say of the poses stays.

        Raises MeasurementError where one is not in the map.
        """
        keep = np.ones(len(s.landmarks), bool)
        keep[s.landmarks.rows_of(ids)] = False
        return replace(s, landmarks=s.landmarks.select(keep))

    def landmark_covariances(self, s: SmootherState, graph: Graph, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmarks in the world."""
        marks, joint = s.landmarks, graph.joint_covariance(s)[1]
        C = marks.covariances(self.stereo, self.models.pixel_sigma, rows, s.first, s.poses, joint)
        for i in np.flatnonzero(marks.factor[rows] == VARIABLE):
            found = graph.landmark_covariance(s, int(marks.serial[rows[i]]), marks.position[rows[i]])
            C[i] = C[i] if found is None else found
        return C


def _tie(
    s: SmootherState, relative: Array, own: Array, shared: Array, dt: float, first: bool, rests: bool
) -> Tie:  # fmt: skip
    """What the motion model says of the frame `dt` [s] after the last one, which is there relative to the graph.

    In a gap of frames of d_j [s], T together, impulses w_j change the velocity: the mean one in the gap differs from
    that before by ``Σ w_j a_j / T``, with a_j the time from frame j's start to the gap's end, and from the last one by
    ``Σ w_j b_j / T`` with ``b_j = T − a_j``. What the two ends of a gap share correlates the factors there. Each has
    the variance of its own and the covariance of both besides, with which they are as good as independent, and never
    too sure: ``Σ d_j a_j / T`` at its beginning and ``Σ d_j b_j / T`` at its end, times the model's variance by time.
    """
    tie, span, weight = Tie(relative, own, shared), dt, dt * dt
    if not s.inside:
        if s.tie is None or s.tie.span is None or s.tie.times is None or first or rests:
            return tie
        span, first = s.tie.span + dt, bool(np.isnan(s.tie.times[0]))
        weight = s.tie.weight + dt * span
    tie, before, earlier, changed = replace(tie, span=span, weight=weight), s.ties[-1], math.nan, 0.0
    if rests:
        return tie
    if not first:
        if before is None or before.span is None or motion.is_first(before.span, span):
            return tie
        turn = rotation_angle(s.poses[-2][:3, :3].T @ s.poses[-1][:3, :3]) * span / before.span
        if not s.inside and turn + _SURE * math.sqrt(own[:3, :3].diagonal().max()) > math.pi:
            return tie
        earlier, changed = -before.span, before.span - before.weight / before.span
    return replace(tie, times=np.array([earlier, 0.0, span]), over=weight / span + changed)


def _begun(s: SmootherState, T: Array, covariance: Array, sight: Sight) -> SmootherState:
    """With the newest frame, at T (4, 4), as the pose of the graph with which the problem begins (anew)."""
    number = s.number + 1 if s.started else 0
    return replace(
        s, begun=number, poses=np.concatenate([s.poses, T[None]]), sights=(*s.sights, sight), ties=(*s.ties, None),
        spread=np.concatenate([s.spread, covariance[None]]), last=np.stack([s.last[0], T]), pair=np.zeros((12, 12)),
        shared=np.zeros((6, 12)), prior=covariance, start=T, turned=T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T,
        since=0, inside=True, tie=None,
    )  # fmt: skip


def _smoothed(s: SmootherState, T: Array, information: Array, by_rig: Array) -> SmootherState:
    """With the newest frame at T (4, 4), by measurements with an information (6, 6), and the frame before it likewise.

    The newest one's derivatives by errors of the rig are `by_rig` (6, m).
    """
    own = np.linalg.inv(information + np.linalg.inv(s.own))
    gain = s.pair[:6, 6:] @ np.linalg.inv(s.own)
    P = s.pair.copy()
    P[:6, :6] -= gain @ (s.own - own) @ gain.T
    P[:6, 6:] = gain @ own
    P[6:, :6], P[6:, 6:] = P[:6, 6:].T, own
    before = s.last[0] @ exp(gain @ log(inverse(s.last[1]) @ T))
    both = np.concatenate([s.by_rig[:6] + gain @ (by_rig - s.by_rig[6:]), by_rig])
    return replace(s, last=np.stack([before, T]), pair=0.5 * (P + P.T), by_rig=both)


def _joined(s: SmootherState, sight: Sight) -> SmootherState:
    """With the newest frame as a pose of the graph, from which this was measured."""
    return replace(
        s, poses=np.concatenate([s.poses, s.last[1:]]), sights=(*s.sights, sight), ties=(*s.ties, s.tie),
        spread=np.concatenate([s.spread, s.covariance[None]]), inside=True,
    )  # fmt: skip


def _entered(s: SmootherState) -> SmootherState:
    """With the newest frame as a pose of the graph where it is predicted; the graph has it from the next update on."""
    pair, shared = _before(np.roll(s.pair, 6, (0, 1)), s.last[1], s.last[0])
    A, B = (adjoint(inverse(T) @ one) for T, one in ((s.last[1], s.poses[-1]), (s.last[0], s.last[1])))
    shared[:, :6] += A @ (s.shared[:, :6] - s.shared[:, 6:] @ B.T)
    marks = s.landmarks.left_behind(np.zeros(0, np.intp), s.last[1], s.own)
    return replace(_joined(s, Sight.none()), pair=pair, shared=shared, landmarks=marks, measured=True)


def _before(P: Array, newest: Array, before: Array) -> tuple[Array, Array]:
    """`SmootherState.pair` and `shared` where the newest frame is the newest pose of the graph.

    P (12, 12) is the joint covariance of that (4, 4), and of the frame before (4, 4).
    """
    pair, shared = np.zeros((12, 12)), np.zeros((6, 12))
    pair[:6, :6] = relative_covariance(P, newest, before)
    shared[:, :6] = P[:6, 6:] - P[:6, :6] @ adjoint(inverse(before) @ newest).T
    return pair, shared


def _by_pose_and_rig(one: pose_only.PoseProblem, T: Array, by_rig: Array, field: Array) -> tuple[Array, Array]:
    """Derivatives of whitened residuals by a pose T (3 M, 6), and by errors of the rig where it is known (3 M, m).

    The errors move the landmarks in the world by `by_rig` (M, 3, m), and measurements by `field` (M, 3, m).
    """
    local = (one.points - T[:3, 3]) @ T[:3, :3]
    D = one.whiteners @ one.stereo.project(local)[1]
    F = one.whiteners @ np.nan_to_num(field) - D @ T[:3, :3].T @ by_rig
    return (D @ points_by_pose(local)).reshape(-1, 6), F.reshape(3 * len(F), F.shape[2])


def _landmarks_by_rig(
    one: pose_only.PoseProblem, T: Array, pose: Array, by_rig: Array, field: Array, own: Array, sigma: float
) -> Array:
    """`by_rig` (M, 3, m) after the measurements, from a pose T (4, 4) that the errors move by `pose` (6, m).

    The landmarks had covariances `own` (M, 3, 3) where the pose is known; `sigma` is the noise of a pixel.
    """
    local = (one.points - T[:3, 3]) @ T[:3, :3]
    D = one.stereo.project(local)[1]
    D[np.isnan(one.z[:, 2]), 2] = 0.0
    H = D @ T[:3, :3].T
    rest = np.nan_to_num(field) - (D @ points_by_pose(local)) @ pose - H @ by_rig
    gain = own @ np.swapaxes(H, 1, 2) @ np.linalg.inv(H @ own @ np.swapaxes(H, 1, 2) + sigma**2 * np.eye(3))
    return np.asarray(by_rig + gain @ rest)


def _drift(P: Array, before: Array, newest: Array) -> Array:
    """By how much (6, 6) the newest pose is less certain than the one before, from their joint covariance (12, 12).

    It stands for the covariance of the motion between them, which it is where the motion has nothing to do with the
    error before.
    """
    A = adjoint(inverse(newest) @ before)
    values, vectors = np.linalg.eigh(P[6:, 6:] - A @ P[:6, :6] @ A.T)
    return np.asarray((vectors * values.clip(min=0)) @ vectors.T)


def _with(s: SmootherState, marks: SmootherLandmarks) -> SmootherState:
    return replace(s, landmarks=s.landmarks.joined(marks), serials=s.serials + len(marks), measured=True)


def _seen_from_newest(
    s: SmootherState, ids: IdArray, local: Array, covariances: Array, by_rig: Array
) -> SmootherLandmarks:
    """New landmarks at `local` (M, 3) in the newest camera, with covariances (M, 3, 3) in its axes.

    Errors of the rig move them there by `by_rig` (M, 3, m). From a frame that saw nothing else they are as uncertain as
    it is itself, given the newest pose of the graph.
    """
    T = s.last[1]
    if not s.inside:
        by_pose = points_by_pose(local)
        covariances = covariances + by_pose @ s.own @ np.swapaxes(by_pose, 1, 2)
    own = T[:3, :3] @ covariances @ T[:3, :3].T
    own = 0.5 * (own + np.swapaxes(own, 1, 2))
    by_rig = T[:3, :3] @ (by_rig - points_by_pose(local) @ s.by_rig[6:])
    return SmootherLandmarks.of(ids, s.serials, transform(T, local), own, inverses(own), False, by_rig)


def _carried(J: Array, P: Array) -> Array:
    """``J P Jᵀ`` (n, n), positive semidefinite whatever the rounding: after long gaps large numbers cancel."""
    values, vectors = np.linalg.eigh(P)
    A = J @ (vectors * np.sqrt(values.clip(min=0)))
    return np.asarray(A @ A.T)
