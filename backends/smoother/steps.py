"""The steps of the smoother: functions from a state to the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from backends.smoother import joint
from backends.smoother.config import SmootherConfig
from backends.smoother.graph import Graph, Solved, SolverError
from backends.smoother.landmarks import SmootherLandmarks, inverses
from backends.smoother.state import Known, Sight, SmootherState
from slam.data import IdArray, IndexArray, UpdateReport, UpdateStatus
from slam.geometry.se3 import Array, adjoint, inverse, log, points_by_pose, transform
from slam.window import pose_only
from slam.window.consensus import landmarks_pose
from slam.window.gating import MIN_CONSENSUS
from slam.window.recovery import Agreement, agreement, unknown_turn, world_covariance
from slam.window.stereo import RectifiedMeasurement

_DARK = 100  # cost: frames without a measurement after which half of them leave: they would be poses of the graph
_AGAIN = 2  # numerics: steps of Gauss and Newton after the usual ones where measurements were corrected


@dataclass(frozen=True, eq=False)
class Steps(RectifiedMeasurement):
    """What the steps need besides the state."""

    config: SmootherConfig  # options

    @property
    def track(self) -> int:
        """Most poses that a smart factor spans: it ends before its first pose leaves."""
        return self.config.track if self.config.lag is None else min(self.config.track, self.config.lag + 1)

    # --- prediction ---

    def predicted(self, s: SmootherState, stamp: float, rests: bool = False) -> SmootherState:
        """With the newest frame at `stamp` [s], by the motion model."""
        if s.started and self.config.lag is not None and s.number - s.anchor >= _DARK:
            s = s.without_dark(_DARK // 2)
        s = replace(
            s, stamps=np.append(s.stamps, stamp), rests=np.append(s.rests, rests),
            sights=(*s.sights, Sight.none()), measured=False,
        )  # fmt: skip
        if not s.started:
            T = self.models.initial_pose
            sigmas = np.repeat([self.models.initial_rotation_sigma, self.models.initial_position_sigma], 3)
            P: Array = np.diag(sigmas**2)
            return _begun(replace(s, poses=T[None], covariances=P[None], ticks=np.zeros(1, np.intp)), T, P)
        T, J, noise, _ = s.moved(self.models, s.number + 1)
        P = joint.moved(s.joint, J, noise)
        covariances = np.concatenate([s.covariances, joint.in_world(P, s.poses[s.of(s.anchor)], T)[None]])
        return replace(
            s, poses=np.concatenate([s.poses, T[None]]), ticks=np.append(s.ticks, s.ticks[-1]), joint=P,
            covariances=covariances, by_rig=np.concatenate([s.by_rig[6:], J @ s.by_rig]),
        )  # fmt: skip

    def in_view(self, s: SmootherState) -> tuple[IndexArray, Array, Array, Array]:
        """Landmarks in the angle of view (paper A, Fig. 3), their pixels, and innovation covariances (M, 2, 2)."""
        T, marks, rows = s.poses[-1], s.landmarks, s.landmarks.order
        rows = rows[self.visible(T, marks.position[rows])]
        local, own = pose_only.seen_from(T, marks.position[rows], marks.from_newest[rows])
        by_pose = points_by_pose(local)
        by_motion = np.where(marks.world[rows, None, None], s.covariances[-1], s.relative)
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
            at, start = s.of(s.anchor), one.predicted if guess is None else guess
            since = _attitude(s.poses[at], s.covariances[at]) - _attitude(s.start, s.prior)  # since the problem began
            lost = len(s.sights[at]) >= MIN_CONSENSUS and unknown_turn(since)
            found = agreement(
                one, start, lambda: landmarks_pose(self, one.points, z, one.predicted, s.number), s.contradicted, lost
            )
            s = replace(s, contradicted=found.contradicted)
            # where the turn is unknown, few are linearised where it is not
            if (unknown_turn(s.relative) and found.used.sum() < MIN_CONSENSUS) or not found.used.any():
                return s, UpdateReport.nothing(UpdateStatus.EMPTY, "no observation passed the gate", ids.copy())
            after, nis, why = self._corrected(s, graph, one, found, rows, z)
        except (np.linalg.LinAlgError, SolverError) as error:
            return s, UpdateReport.nothing(UpdateStatus.FAILED, f"smoother: the pose cannot be solved for: {error}")
        used = found.used
        reason = f"smoother: built anew after {why}" if why else ""
        return after, UpdateReport(UpdateStatus.OK, reason, ids[used], ids[~used], nis, int(np.isfinite(z[used]).sum()))

    def _problem(self, s: SmootherState, rows: IndexArray, z: Array) -> pose_only.PoseProblem:
        """The newest pose alone, with the motion model as its prior, and landmarks as they stand."""
        T, marks = s.poses[-1], s.landmarks
        local, own = pose_only.seen_from(T, marks.position[rows], marks.from_newest[rows])
        noise = pose_only.residual_noise(self.stereo, self.models.pixel_sigma, local, own, z)
        P = s.covariances[-1] if s.anchor == s.number or marks.world[rows].any() else s.relative
        probability = self.models.gate_probability
        return pose_only.PoseProblem(self.stereo, marks.position[rows], z, noise, T, np.linalg.inv(P), probability)

    def _corrected(
        self, s: SmootherState, graph: Graph, one: pose_only.PoseProblem, found: Agreement, rows: IndexArray, z: Array
    ) -> tuple[SmootherState, float, str]:
        """The state after an update, its NIS, and why gtsam failed, if it did."""
        used, marks = found.used, s.landmarks
        seen, number = rows[used], s.number
        if found.jump is not None:
            return self._anew(s, graph, found.T, world_covariance(s.covariances[-1]), seen, z[used])
        one = replace(one, points=one.points[used], z=z[used], noise=one.noise[used])
        x = log(inverse(one.predicted) @ found.T)
        nis = float(one.distances(found.T).sum() + x @ one.information @ x)
        s = self._considered(s, one, found.T, seen)
        ratio = math.sqrt(self.stereo.f / self.models.pixel_sigma)
        after = replace(_seeing(s), poses=np.concatenate([s.poses[:-1], found.T[None]]))
        last, tick = s.tick(marks.pose.max(axis=1, initial=-1)), int(after.ticks[-1])
        marks = s.landmarks.with_variables(seen, last, one.z, tick, self.track, self.config.landmarks, found.T, ratio)
        after = replace(after, landmarks=marks)
        after = self._measured(after, seen, one.z, s.oldest(self.config.lag or SmootherConfig.lag, number))
        solved, why = graph.update(after)
        after = self._settled(after, solved)
        marks = after.landmarks.without_variables() if why else after.landmarks
        return replace(after, landmarks=marks.left_behind(seen, after.poses[-1], solved.drift)), nis, why

    def _considered(self, s: SmootherState, one: pose_only.PoseProblem, T: Array, seen: IndexArray) -> SmootherState:
        """With derivatives by errors of the rig after measurements, which put the newest pose at T (4, 4).

        The errors are considered, not estimated (Schmidt, 1966). The pose follows from the landmarks as they stand, and
        each landmark from its measurements given the poses: these gains move the derivatives by the errors, too.
        """
        marks, pose = s.landmarks, s.by_rig[6:]
        own, by_rig = marks.from_newest[seen], marks.by_rig.copy()
        local = (one.points - T[:3, 3]) @ T[:3, :3]
        D = self.stereo.project(local)[1]
        D[np.isnan(one.z[:, 2]), 2] = 0.0
        G, H = D @ points_by_pose(local), D @ T[:3, :3].T  # measurements by pose and landmarks
        rest = np.nan_to_num(self.field(one.z)) - H @ by_rig[seen]
        A, b = ((one.whiteners @ M).reshape(3 * len(M), M.shape[2]) for M in (G, rest))
        pose = np.linalg.solve(one.information + A.T @ A, one.information @ pose + A.T @ b)
        S = H @ own @ np.swapaxes(H, 1, 2) + self.models.pixel_sigma**2 * np.eye(3)
        by_rig[seen] += own @ np.swapaxes(H, 1, 2) @ np.linalg.inv(S) @ (rest - G @ pose)
        before = s.by_rig[:6] + s.gain @ (pose - s.by_rig[6:])
        return replace(s, by_rig=np.concatenate([before, pose]), landmarks=replace(marks, by_rig=by_rig))

    def _anew(
        self, s: SmootherState, graph: Graph, T: Array, P: Array, seen: IndexArray, z: Array
    ) -> tuple[SmootherState, float, str]:
        """As `_corrected`, with the newest pose, at T (4, 4) with a covariance P (6, 6), as the first of a problem."""
        s = self._measured(_begun(_seeing(s), T, P), seen, z, s.number)
        return self._settled(s, graph.rebuild(s)), float("nan"), ""

    def _measured(self, s: SmootherState, rows: IndexArray, z: Array, oldest: int) -> SmootherState:
        """With measurements z (M, 3) of landmarks from the newest pose; see `SmootherLandmarks.measured`."""
        marks, tick = s.landmarks, int(s.ticks[-1])
        since = marks.spans(rows, s.tick(marks.pose[rows].max(axis=1)), tick, self.track, int(s.tick(s.solved)))
        marks = marks.measured(rows, z, s.number, since, oldest)
        sight = s.sights[-1].joined(Sight(marks.serial[rows], since, z))
        return replace(s, landmarks=marks, sights=(*s.sights[:-1], sight))

    def _settled(self, s: SmootherState, solved: Solved) -> SmootherState:
        """The state with what the graph says: the newest pose is the anchor."""
        poses = np.concatenate([s.poses[: s.of(solved.oldest)], solved.poses])
        covariances = np.concatenate([s.covariances[: -len(solved.covariances)], solved.covariances])
        marks = s.landmarks.refined(self.stereo, self.models.pixel_sigma, s.first, poses)
        marks = marks.solved(solved.serials, solved.points, solved.linearised)
        known = {n: s.known[n] for n in s.sights[-1].serials.tolist() if n in s.known and s.known[n].used < 0}
        used = {n: replace(one, used=s.number) for n, one in known.items()}
        s = replace(
            s, poses=poses, joint=solved.joint, covariances=covariances, landmarks=marks,
            anchor=s.number, solved=s.number, known={**s.known, **used} if used else s.known,
        )  # fmt: skip
        lag, past = self.config.lag, self.config.past
        return s if lag is None or len(s.poses) < 1.5 * (lag + 1 + past) else s.without_old(past, lag)

    def revised(self, s: SmootherState, graph: Graph, correct: Callable[[Array], Array]) -> SmootherState:
        """After a correction of the measurements; unless landmarks are known in the world, the newest pose stays.

        Raises MeasurementError where a corrected measurement is not finite.
        """
        s = _anchored(s.corrected(correct))
        marks, oldest = s.landmarks, s.oldest(self.config.lag, s.number)
        try:
            solved = graph.rebuild(s, _AGAIN, hold=not s.fixed)
        except SolverError:  # the next update tries again
            return replace(s, landmarks=marks.refined(self.stereo, self.models.pixel_sigma, s.first, s.poses))
        D = solved.poses[0] @ inverse(s.poses[s.of(oldest)])
        unseen = ~marks.world & ~(marks.pose >= oldest).any(axis=1)
        position = np.where(unseen[:, None], transform(D, marks.position), marks.position)
        marks = replace(marks, position=position, mean=np.where(unseen[:, None], position, marks.mean))
        poses = np.concatenate([D @ s.poses[: s.of(oldest)], s.poses[s.of(oldest) :]])
        start = graph.to_state @ s.start
        return self._settled(replace(s, poses=poses, left_poses=D @ s.left_poses, start=start, landmarks=marks), solved)

    # --- landmarks ---

    def added(self, s: SmootherState, ids: IdArray, z: Array) -> SmootherState:
        """With new landmarks at their first sight z (M, 3) in the newest pose (paper A, Eqs. 8 and 10).

        Raises MeasurementError where one is in the map already, or has no right pixel or no positive depth.
        """
        s.landmarks.require_new(ids)
        s, rows = _anchored(s), len(s.landmarks) + np.arange(len(ids))
        marks = _seen_from_newest(s, ids, *self.first_sight(ids, z))
        s = _with(s, replace(marks, information=np.zeros_like(marks.information)))
        return self._measured(s, rows, z, 0)

    def inserted(self, s: SmootherState, ids: IdArray, positions: Array, covariances: Array) -> SmootherState:
        """With landmarks known in the world; see `slam.interfaces.MapBackend.insert`."""
        none = np.zeros((len(ids), 3, s.by_rig.shape[1]))
        marks = SmootherLandmarks.of(ids, s.serials, positions, covariances, inverses(covariances), True, none)
        known = {serial: Known(x, P, -1) for serial, x, P in zip(marks.serial.tolist(), positions, covariances)}
        s = replace(s, revisions=s.revisions + (not s.fixed))
        return replace(_with(s, marks), known={**s.known, **known}, measured=s.measured)

    def placed(self, s: SmootherState, ids: IdArray, local: Array, covariances: Array) -> SmootherState:
        """With landmarks known in the newest camera's coordinates; see `slam.interfaces.MapBackend.place`."""
        s = _anchored(s)
        marks = _seen_from_newest(s, ids, local, covariances, np.zeros((len(ids), 3, s.by_rig.shape[1])))
        known = {n: Known(x, P, s.number) for n, x, P in zip(marks.serial.tolist(), local, covariances)}
        return replace(_with(s, marks), known={**s.known, **known})

    def removed(self, s: SmootherState, ids: IdArray) -> SmootherState:
        """Without landmarks; what their measurements say of the poses stays.

        Raises MeasurementError where one is not in the map.
        """
        keep = np.ones(len(s.landmarks), bool)
        keep[s.landmarks.rows_of(ids)] = False
        return replace(s, landmarks=s.landmarks.select(keep))

    def landmark_covariances(self, s: SmootherState, graph: Graph, rows: IndexArray) -> Array:
        """Covariances (M, 3, 3) of landmarks in the world."""
        marks, end = s.landmarks, s.of(s.anchor) + 1
        C = marks.covariances(rows, s.anchor, s.poses[:end], s.covariances[:end])
        for i in np.flatnonzero(marks.variable[rows]):
            found = graph.landmark_covariance(s, int(marks.serial[rows[i]]), marks.position[rows[i]])
            C[i] = C[i] if found is None else found
        return C


def _attitude(T: Array, P: Array) -> Array:
    """Covariance (3, 3) about the world's axes of the attitude of a pose T (4, 4) with a covariance P (6, 6) [rad²]."""
    return np.asarray(T[:3, :3] @ P[:3, :3] @ T[:3, :3].T)


def _begun(s: SmootherState, T: Array, P: Array) -> SmootherState:
    """With the newest pose, at T (4, 4) with a covariance P (6, 6), as the one with which the problem begins (anew).

    Landmarks go on as they stand; what they were measured from is no part of it.
    """
    marks = s.landmarks.without_measurements(np.ones(len(s.landmarks), bool)).without_variables()
    return replace(
        s, poses=np.concatenate([s.poses[:-1], T[None]]), covariances=np.concatenate([s.covariances[:-1], P[None]]),
        joint=np.pad(P, (0, 12)), prior=P, start=T, begun=s.number, anchor=s.number, landmarks=marks,
        known={serial: one for serial, one in s.known.items() if one.pose < 0},
    )  # fmt: skip


def _anchored(s: SmootherState) -> SmootherState:
    """With the newest pose as the anchor, where it is predicted if nothing was measured; landmarks are relative to it.

    Nothing but the motion ties it to the last: where it may have turned anyhow, the problem begins anew. The motion's
    covariance, which is linear in the turn, is of no direction then.
    """
    if s.anchor == s.number:
        return s
    s = replace(_seeing(s), landmarks=s.landmarks.left_behind(np.zeros(0, np.intp), s.poses[-1], s.relative))
    if unknown_turn(s.relative):
        largest = [np.linalg.eigvalsh(s.covariances[-1][part, part]).max() for part in (slice(3), slice(3, 6))]
        return _begun(s, s.poses[-1], 2 * np.diag(np.repeat(largest, 3)))
    by_anchor = adjoint(inverse(s.poses[-1]) @ s.poses[s.of(s.anchor)])
    return replace(s, joint=joint.anchored(s.joint, by_anchor, s.poses[-2:]), anchor=s.number)


def _seeing(s: SmootherState) -> SmootherState:
    """With the newest pose as one that saw something."""
    return replace(s, ticks=np.append(s.ticks[:-1], s.ticks[-2:][0] + 1))


def _with(s: SmootherState, marks: SmootherLandmarks) -> SmootherState:
    return replace(s, landmarks=s.landmarks.joined(marks), serials=s.serials + len(marks), measured=True)


def _seen_from_newest(
    s: SmootherState, ids: IdArray, local: Array, covariances: Array, by_rig: Array
) -> SmootherLandmarks:
    """New landmarks at `local` (M, 3) in the newest camera, with covariances (M, 3, 3) in its axes.

    Errors of the rig move them there by `by_rig` (M, 3, m).
    """
    T = s.poses[-1]
    own = T[:3, :3] @ covariances @ T[:3, :3].T
    own = 0.5 * (own + np.swapaxes(own, 1, 2))
    by_rig = T[:3, :3] @ (by_rig - points_by_pose(local) @ s.by_rig[6:])
    return SmootherLandmarks.of(ids, s.serials, transform(T, local), own, inverses(own), False, by_rig)
