"""The factor graph in gtsam's fixed-lag smoother."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from backends.smoother import joint
from backends.smoother.factors import FactorMaker, landmark_key, pose_key
from backends.smoother.landmarks import by_pose
from backends.smoother.state import SmootherState
from backends.smoother.tracks import GraphProblem, Tracks
from slam.data import IdArray
from slam.errors import SlamError
from slam.geometry.se3 import Array, adjoint, inverse, transform

_ENDLESS = 1e9  # numerics: a lag that no run reaches
_CAREFUL = 20  # numerics: poses after a failure whose factors are made so that they do not throw
_FIRM = np.repeat([1e-10, 1e-8], 3)  # numerics: variances [rad²], [m²] with which the first pose is held


class SolverError(SlamError):
    """The solver failed; the message is gtsam's, in one line."""


@contextmanager
def solving() -> Iterator[None]:
    """Around calls of gtsam: what it throws is a SolverError."""
    try:
        yield
    except (RuntimeError, ValueError, LookupError) as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        if "unknown exception" in why:  # so gtsam says, of a strict factor (`FactorMaker.smart`)
            why = "a near landmark lies behind a camera that measured it"
        raise SolverError(f"gtsam: {why}") from error


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
    spread: Array  # covariances (N, 6, 6) of those that are new

    def displaced(self, M: Array) -> Solved:
        """After a displacement M (4, 4) in the world."""
        points, linearised = transform(M, self.points), transform(M, self.linearised)
        return replace(self, poses=M @ self.poses, points=points, linearised=linearised)


class Graph:
    """gtsam's incremental fixed-lag smoother, and what is in it.

    It follows a `SmootherState`, and nothing is in it alone: where it cannot go on from one state to the next, or gtsam
    fails, it is built anew from what the state keeps.

    Its first pose is held firmly, as nothing is measured but relative to it: with a pose that is hardly known in the
    world Cholesky's method would run out of digits. What is known of it is added to all covariances. If landmarks are
    known in the world the first pose has its own covariance instead.

    Attributes:
        number: of the newest pose in it; −1 for none.
    """

    def __init__(self, make: FactorMaker, lag: int | None) -> None:
        self._careful = 0  # number of the first pose whose factors may be made quickly again, after a failure
        self._make, self._lag = make, lag
        self.restart()

    def restart(self) -> None:
        """Leave what is in it: the next state is put in whole."""
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(0.01)
        parameters.findUnusedFactorSlots = True
        self._solver = gtsam.IncrementalFixedLagSmoother(
            _ENDLESS if self._lag is None else float(self._lag), parameters
        )
        self._tracks = Tracks(self._make, self._lag)
        self.number, self._taken = -1, 0
        self._base: Array = np.zeros((6, 6))  # covariance of the first pose in the world, besides its prior
        self._poses: dict[int, Array] = {}
        self._start = np.eye(4)  # the first pose
        self._to_state = np.eye(4)  # takes gtsam's coordinates to the state's
        self._kind = False, 0

    def followed(self, s: SmootherState) -> tuple[Solved, str]:
        """The solution for a state with more poses than the last one; and why gtsam failed, if it did.

        After a failure there are no landmarks among its variables. Raises SolverError where gtsam fails with the new
        graph as well.
        """
        why = ""
        if self.number < s.number and self._is_of(s):
            number, self.number = self.number, -1  # until it is done: an interrupted call leaves a graph unknown
            try:
                problem = GraphProblem(to_graph=inverse(self._to_state))
                return self._update(s, range(number + 1, s.number + 1), problem), ""
            except SolverError as error:
                why, self._careful = str(error), s.number + (self._lag or _CAREFUL)
        if why:
            s = replace(s, landmarks=s.landmarks.without_variables(int(s.ages[-1])))
        return self.rebuilt(s), why

    def rebuilt(self, s: SmootherState, steps: int = 0) -> Solved:
        """The solution with all anew, after so many `steps` more than usual; SolverError where gtsam fails."""
        self.restart()
        oldest, self._careful = s.oldest(self._lag, s.number), max(self._careful, s.number + 1)
        self._kind, self._start = _kind(s), s.poses[s.of(oldest)]
        prior, self._base = first_prior(s, oldest)
        problem = GraphProblem()
        problem.factors.add(self._make.prior(oldest, s.start if oldest == s.begun else self._start, prior))
        return self._update(s, range(oldest, s.number + 1), problem, steps)

    def displaced(self, M: Array) -> None:
        """Follow a displacement M (4, 4) of all that the state has in the world: what is in it is relative."""
        self._to_state, self._start = M @ self._to_state, M @ self._start
        self._poses = {number: M @ T for number, T in self._poses.items()}

    def _update(self, s: SmootherState, numbers: range, problem: GraphProblem, steps: int = 0) -> Solved:
        """The solution with what is in a problem, and poses of some numbers with what was measured from them."""
        oldest = s.oldest(self._lag, s.number)
        # until this update is done; since the last one more than a lag of poses may have come
        begin = min(oldest, numbers.start - 1) if self._poses else oldest
        for number in numbers:
            if number > begin:
                self._tracks.add_rows(problem, s, number - 1, begin, self._taken)
            self._tracks.add_pose(problem, s, number, begin)
            self._tracks.add_rows(problem, s, number, begin)
            self._taken = len(s.sights[s.of(number)])
        kept = self._tracks.keep(problem, s)
        made = self._tracks.make_smart(problem, s.number < self._careful)
        # Two steps of Gauss and Newton. What leaves the lag fixes where its neighbours stay linearised, and that is to
        # be where they are once the newest pose is solved for. gtsam's clock is the latest time of a variable: in the
        # first step all that is new has the time of the last update, so that nothing leaves.
        now: dict[Any, Any] = dict.fromkeys(problem.values.keys(), float(s.ages[s.of(numbers.start)] - 1))
        with solving():
            self._solver.update(problem.factors, problem.values, now, problem.removed)
            slots = self._solver.getISAM2Result().getNewFactorsIndices()
            for _ in range(steps):
                self._solver.update()
            self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), problem.ages)
            values = self._solver.calculateEstimate()
        for track, place in made:
            track.slot = slots[place]
        self._tracks.forget(s, oldest)
        new = [i for i in numbers if i >= oldest] if self._poses else [s.number]
        return self._solution(s, oldest, new, kept, values)

    def _solution(self, s: SmootherState, oldest: int, new: list[int], kept: list[int], values: gtsam.Values) -> Solved:
        """What gtsam found, in the state's coordinates: `new` poses, and variables of landmarks that are `kept`."""
        poses = self._to_state @ [values.atPose3(pose_key(i)).matrix() for i in range(oldest, s.number + 1)]
        self._poses = dict(zip(range(oldest, s.number + 1), poses))
        points, linearised = (
            transform(self._to_state, np.array([v.atPoint3(landmark_key(n)) for n in kept]).reshape(-1, 3))
            for v in (values, self._solver.getLinearizationPoint() if kept else values)
        )
        at = [max(oldest, i) for i in (s.anchor, s.number - 1, s.number)]
        P = self._relative(at)
        if not (np.isfinite(poses).all() and np.isfinite(P).all() and (np.diag(P) > 0).all()):
            raise SolverError("gtsam: the solution is not finite, or a variance not positive")
        spread = np.array([*(self._covariance([i]) for i in new[:-1]), (P + self._rigid(at))[12:, 12:]])
        anchor, before, newest = poses[np.array(at) - oldest]
        shared = joint.anchored(P, np.zeros((6, 6)), np.array([before, newest]))
        shared[:6, :6] = spread[-1]
        A = adjoint(inverse(newest) @ anchor)
        drift = joint.root(P[12:, 12:] - A @ P[:6, :6] @ A.T)
        self.number = s.number
        return Solved(oldest, poses, np.array(kept, np.int64), points, linearised, shared, drift @ drift.T, spread)

    def joint_covariance(self, s: SmootherState, first: int) -> tuple[int, Array]:
        """Number of the first pose, and the joint covariance (6 K, 6 K) of the poses from there to the newest.

        It begins at `first`, or at the oldest pose in the graph; where the graph is not the state's, at the newest.
        Poses that are not in the graph yet follow from the motion model.
        """
        if not self._is_of(s):
            return s.number, s.spread[-1]
        oldest = s.oldest(self._lag, self.number)
        first = max(oldest, first)
        begin = max(oldest, min(first, self.number - 1))  # where the motion goes on, it needs two poses
        P = self._covariance(list(range(begin, self.number + 1)))
        for number in range(self.number + 1, s.number + 1):
            _, J, noise, _ = s.moved(self._make.models, number)
            J = J[:, -len(P) :]
            cross = J @ P[-J.shape[1] :]
            own = cross[:, -J.shape[1] :] @ J.T + noise
            P = np.block([[P, cross.T], [cross, 0.5 * (own + own.T)]])  # what is not symmetric would grow fourfold
            gain = np.linalg.solve(P[-6:, -6:], P[-6:])  # a pose that was solved for alone is known better
            P = P + gain.T @ (s.spread[s.of(number)] - P[-6:, -6:]) @ gain
        rows = slice(6 * (first - begin), None)
        return first, P[rows, rows]

    def landmark_covariance(self, s: SmootherState, serial: int, position: Array) -> Array | None:
        """Covariance (3, 3) in the world of a landmark at a position (3,), if it is a variable of the state's graph."""
        key = landmark_key(serial)
        if not self._is_of(s) or not self._solver.getLinearizationPoint().exists(key):
            return None
        J, R = by_pose(self._start, position[None])[0], self._to_state[:3, :3]
        return np.asarray(R @ self._solver.getISAM2().marginalCovariance(key) @ R.T + J @ self._base @ J.T)

    def _is_of(self, s: SmootherState) -> bool:
        """Whether it is the state's graph, up to poses since the last update; not if that was interrupted."""
        return self.number == s.solved >= max(s.begun, s.first) and self._kind == _kind(s)

    def _covariance(self, numbers: list[int]) -> Array:
        """Joint covariance (6 K, 6 K) in the world of poses."""
        return self._relative(numbers) + self._rigid(numbers)

    def _rigid(self, numbers: list[int]) -> Array:
        """What is known of the first pose in the world as a joint covariance (6 K, 6 K) of poses."""
        A = adjoint(inverse(np.array([self._poses[i] for i in numbers])) @ self._start).reshape(-1, 6)
        return np.asarray(A @ self._base @ A.T)

    def _relative(self, numbers: list[int]) -> Array:
        """Joint covariance (6 K, 6 K) of poses, besides what is known of the first one in the world."""
        each, at = np.unique(numbers, return_inverse=True)
        keys = [pose_key(i) for i in each.tolist()]
        with solving():
            isam = self._solver.getISAM2()
            P = isam.marginalCovariance(keys[0]) if len(keys) == 1 else isam.jointMarginalCovariance(keys).fullMatrix()
        rows = (6 * at[:, None] + np.arange(6)).ravel()
        P = P[rows[:, None], rows]
        return np.asarray(0.5 * (P + P.T))


def _kind(s: SmootherState) -> tuple[bool, int]:
    """What a graph is built for: whether landmarks are known in the world, and which revision of the measurements."""
    return s.fixed, s.revisions


def first_prior(s: SmootherState, number: int) -> tuple[Array, Array]:
    """Covariance of the prior of a pose that comes first (6, 6), and its covariance in the world besides.

    What was measured from the pose with which the problem begins is in the graph, and not in its prior. Of a later one
    it is in both; but what known landmarks told of it is not told again, see `Tracks`.
    """
    P = s.prior if number == s.begun else s.spread[s.of(number)]
    if s.fixed:
        return P, np.zeros((6, 6))
    prior = np.diag(np.minimum(np.diag(P), _FIRM))
    base = joint.root(P - prior)
    return prior, base @ base.T


def minimised(problem: GraphProblem, iterations: int) -> gtsam.Values:
    """The values that fit all factors best, by Levenberg-Marquardt; SolverError if gtsam finds nothing better."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-9)
    with solving():
        before = problem.factors.error(problem.values)
        optimizer = gtsam.LevenbergMarquardtOptimizer(problem.factors, problem.values, parameters)
        values = optimizer.optimize()
        after = problem.factors.error(values)
    if not np.isfinite(after) or after > before:
        raise SolverError(f"Levenberg-Marquardt found no solution (error {before:.6g} to {after:.6g})")
    if optimizer.iterations() >= iterations:
        logging.getLogger(__name__).warning("Levenberg-Marquardt was stopped after %d iterations", iterations)
    return values
