"""The factor graph in gtsam's fixed-lag smoother."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from backends.smoother import joint
from backends.smoother.factors import FactorMaker, GraphUpdate
from backends.smoother.landmarks import by_pose
from backends.smoother.state import SmootherState
from backends.smoother.tracks import Tracks
from slam.data import IdArray
from slam.errors import SlamError
from slam.geometry.se3 import Array, adjoint, inverse, transform

_CAREFUL = 20  # numerics: poses after a failure in which landmarks may lie behind a camera
_FIRM = np.repeat([1e-10, 1e-8], 3)  # numerics: variances [rad²], [m²] with which the first pose is held


class SolverError(SlamError):
    """The solver failed; the message is gtsam's, in one line."""


@contextmanager
def solving() -> Iterator[None]:
    """Around calls of gtsam: what it throws is a SolverError."""
    try:
        yield
    except (RuntimeError, ValueError, LookupError) as error:
        raise SolverError(f"gtsam: {' '.join(str(error).split())[:200] or type(error).__name__}") from error


@dataclass(frozen=True, eq=False)
class Solved:
    """The last poses as the graph has them."""

    oldest: int  # number of the first one
    poses: Array  # (L, 4, 4)
    serials: IdArray  # of landmarks that are variables (V,),
    points: Array  # where they are (V, 3),
    linearised: Array  # and where they are linearised (V, 3)
    joint: Array  # covariance (18, 18) of the last pose, which is the anchor, see `backends.smoother.joint`
    # By how much (6, 6) the last pose is less certain than the anchor before it: over many frames this adds up to the
    # path's drift. The covariance of the motion would not, as each frame has an error of its own that the next forgets.
    drift: Array
    covariances: Array  # covariances (N, 6, 6) of those that are new


class Graph:
    """gtsam's incremental fixed-lag smoother, and what is in it.

    It follows a `SmootherState`, and nothing is in it alone: where it cannot go on from one state to the next, or gtsam
    fails, it is built anew from what the state keeps.

    Its first pose is held firmly, as nothing is measured but relative to it: with a pose that is hardly known in the
    world Cholesky's method would run out of digits. What is known of it is added to all covariances. If landmarks are
    known in the world the first pose has its own covariance instead.

    Attributes:
        number: of the newest pose in it; −1 for none.
        to_state: takes gtsam's coordinates to the state's (4, 4).
    """

    def __init__(self, make: FactorMaker, lag: int | None) -> None:
        self._make, self._lag = make, lag
        self.number = -1
        self._taken = 0  # rows of that pose that are in it: landmarks are added after an update
        self.to_state = np.eye(4)
        self._careful = 0  # number of the first pose after a failure in which no near landmark may lie behind

    def update(self, s: SmootherState) -> tuple[Solved, str]:
        """The solution for a state with more poses than the last one; and why gtsam failed, if it did.

        After a failure there are no landmarks among its variables. Raises SolverError where gtsam fails again.
        """
        try:
            if self._is_of(s):
                return self._solve(s, GraphUpdate(self._make, inverse(self.to_state))), ""
            return self.rebuild(s), ""
        except SolverError as error:
            self._careful = s.number + _CAREFUL
            return self.rebuild(replace(s, landmarks=s.landmarks.without_variables())), str(error)

    def rebuild(self, s: SmootherState, steps: int = 0, hold: bool = False) -> Solved:
        """The solution with all anew, after so many `steps` more than usual; SolverError where gtsam fails.

        Where `hold` says so, all moves as a whole so that the newest pose stays.
        """
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(0.01)
        parameters.findUnusedFactorSlots = True
        lag = np.inf if self._lag is None else float(self._lag)
        self._solver = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._tracks = Tracks(self._make)
        self._careful = max(self._careful, s.number + 1)
        oldest, self.number, self._revisions = s.oldest(self._lag, s.number), -1, s.revisions
        self.to_state = np.eye(4)
        self._start = s.poses[s.of(oldest)]  # the first pose; its covariance in the world besides its prior is `_base`
        prior, self._base = first_prior(s, oldest)
        update = GraphUpdate(self._make)
        update.factors.add(self._make.prior(oldest, s.start if oldest == s.begun else self._start, prior))
        return self._solve(s, update, steps, hold)

    def _solve(self, s: SmootherState, update: GraphUpdate, steps: int = 0, hold: bool = False) -> Solved:
        """The solution with what is in an update, the poses that the graph lacks, and what was measured from them."""
        last, self.number = self.number, -1  # until it is done: an interrupted call leaves a graph unknown
        oldest = s.oldest(self._lag, s.number)
        begin = oldest if last < 0 else min(oldest, last)  # more than a lag of poses may have come since the last one
        for number in range(begin if last < 0 else last + 1, s.number + 1):
            if number > begin:
                self._tracks.add_rows(update, s, number - 1, begin, self._taken)
            update.add_pose(s, number, begin)
            self._tracks.add_rows(update, s, number, begin)
            self._taken = len(s.sights[s.of(number)])
        kept = self._tracks.keep(update, s)
        made = self._tracks.make_smart(update)
        # Two steps of Gauss and Newton. What leaves the lag fixes where its neighbours stay linearised, and that is to
        # be where they are once the newest pose is solved for: without timestamps, nothing leaves in the first step.
        with solving():
            self._solver.update(update.factors, update.values, {}, update.removed)
            slots = self._solver.getISAM2Result().getNewFactorsIndices()
            for _ in range(steps):
                self._solver.update()
            self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), update.timestamps)
            values = self._solver.calculateEstimate()
        if s.number >= self._careful and self._tracks.contradicted():
            raise SolverError("a near landmark lies behind a camera that measured it")
        for track, place in made:
            track.slot = slots[place]
        self._tracks.forget(s, oldest)
        if hold:
            self.to_state = s.poses[-1] @ inverse(values.atPose3(X(s.number)).matrix())
            self._start = self.to_state @ self._start
        solved = self._solution(s, oldest, kept, values)
        if hold:  # to the last digit
            solved.poses[-1] = s.poses[-1]
        return solved

    def _solution(self, s: SmootherState, oldest: int, kept: list[int], values: gtsam.Values) -> Solved:
        """What gtsam found, in the state's coordinates: poses, and variables of landmarks that are `kept`."""
        poses = self.to_state @ [values.atPose3(X(i)).matrix() for i in range(oldest, s.number + 1)]
        points, linearised = (
            transform(self.to_state, np.array([v.atPoint3(L(n)) for n in kept]).reshape(-1, 3))
            for v in (values, self._solver.getLinearizationPoint() if kept else values)
        )
        at = [max(oldest, i) for i in (s.anchor, s.number - 1, s.number)]
        P, (anchor, before, newest) = self._relative(at), poses[np.array(at) - oldest]
        if not (np.isfinite(poses).all() and np.isfinite(P).all() and (np.diag(P) > 0).all()):
            raise SolverError("gtsam: the solution is not finite, or a variance not positive")
        new = range(max(oldest, s.solved + 1), s.number)
        covariances = np.array(
            [*(self._covariance([i], poses[[i - oldest]]) for i in new), P[12:, 12:] + self._rigid(newest[None])]
        )
        shared = joint.anchored(P, np.zeros((6, 6)), np.array([before, newest]))
        shared[:6, :6] = covariances[-1]
        A = adjoint(inverse(newest) @ anchor)
        drift = joint.root(P[12:, 12:] - A @ P[:6, :6] @ A.T)
        self.number = s.number
        return Solved(oldest, poses, np.array(kept, np.int64), points, linearised, shared, drift @ drift.T, covariances)

    def joint_covariance(self, s: SmootherState, first: int) -> tuple[int, Array]:
        """Number of the first pose, and the joint covariance (6 K, 6 K) of the poses from there to the newest.

        It begins at `first`, or at the oldest pose in the graph; where the graph is not the state's, at the newest.
        Poses that are not in the graph yet follow from the motion model.
        """
        if not self._is_of(s):
            return s.number, s.covariances[-1]
        oldest = s.oldest(self._lag, self.number)
        first = max(oldest, first)
        begin = max(oldest, min(first, self.number - 1))  # where the motion goes on, it needs two poses
        P = self._covariance(list(range(begin, self.number + 1)), s.poses[s.of(begin) : s.of(self.number) + 1])
        for number in range(self.number + 1, s.number + 1):
            _, J, noise, _ = s.moved(self._make.models, number)
            J = J[:, -len(P) :]
            cross = J @ P[-J.shape[1] :]
            own = cross[:, -J.shape[1] :] @ J.T + noise
            P = np.block([[P, cross.T], [cross, 0.5 * (own + own.T)]])  # what is not symmetric would grow fourfold
            gain = np.linalg.solve(P[-6:, -6:], P[-6:])  # a pose that was solved for alone is known better
            P = P + gain.T @ (s.covariances[s.of(number)] - P[-6:, -6:]) @ gain
        rows = slice(6 * (first - begin), None)
        return first, P[rows, rows]

    def landmark_covariance(self, s: SmootherState, serial: int, position: Array) -> Array | None:
        """Covariance (3, 3) in the world of a landmark at a position (3,), if it is a variable of the state's graph."""
        key = L(serial)
        if not self._is_of(s) or not self._solver.getLinearizationPoint().exists(key):
            return None
        J, R = by_pose(self._start, position[None])[0], self.to_state[:3, :3]
        return np.asarray(R @ self._solver.getISAM2().marginalCovariance(key) @ R.T + J @ self._base @ J.T)

    def _is_of(self, s: SmootherState) -> bool:
        """Whether it is the state's graph, up to poses since the last update; not if that was interrupted."""
        return self.number == s.solved >= max(s.begun, s.first) and self._revisions == s.revisions

    def _covariance(self, numbers: list[int], poses: Array) -> Array:
        """Joint covariance (6 K, 6 K) in the world of poses (K, 4, 4)."""
        return self._relative(numbers) + self._rigid(poses)

    def _rigid(self, poses: Array) -> Array:
        """What is known of the first pose in the world as a joint covariance (6 K, 6 K) of poses (K, 4, 4)."""
        A = adjoint(inverse(poses) @ self._start).reshape(-1, 6)
        return np.asarray(A @ self._base @ A.T)

    def _relative(self, numbers: list[int]) -> Array:
        """Joint covariance (6 K, 6 K) of poses, besides what is known of the first one in the world."""
        each, at = np.unique(numbers, return_inverse=True)
        keys = list(map(X, each.tolist()))
        with solving():
            isam = self._solver.getISAM2()
            P = isam.marginalCovariance(keys[0]) if len(keys) == 1 else isam.jointMarginalCovariance(keys).fullMatrix()
        rows = (6 * at[:, None] + np.arange(6)).ravel()
        P = P[rows[:, None], rows]
        return np.asarray(0.5 * (P + P.T))


def first_prior(s: SmootherState, number: int) -> tuple[Array, Array]:
    """Covariance of the prior of a pose that comes first (6, 6), and its covariance in the world besides.

    What was measured from the pose with which the problem begins is in the graph, and not in its prior. Of a later one
    it is in both; but what known landmarks told of it is not told again, see `Tracks`.
    """
    P = s.prior if number == s.begun else s.covariances[s.of(number)]
    if s.fixed:
        return P, np.zeros((6, 6))
    prior = np.diag(np.minimum(np.diag(P), _FIRM))
    base = joint.root(P - prior)
    return prior, base @ base.T
