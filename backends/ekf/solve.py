"""The measurement update, gated and iterated: what it makes of a prior. The filter's state is not changed here.

In the papers' order: the innovation ν and its covariance ``S = H P Hᵀ + R = L Lᵀ``, the gate, the gain
``K = P Hᵀ S⁻¹``, the corrected state ``x + K ν`` and covariance ``P − K S Kᵀ`` (paper A, Eq. 11). What is kept is
``y = S⁻¹ ν``: the state changes by ``P Hᵀ y``, and ``s = Hᵀ y`` has entries for g = [r, φ, measured landmarks] alone.

A component that is not measured (or gated) keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dgemm, dtrmm
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri

from backends.ekf import kernels
from backends.ekf.covariance import POSE
from backends.ekf.measurement import Displacement, Jacobian, Measurement
from slam.chi_square import chi_square_limits
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array

#: A step is the last where the measurements it predicts linearly are right to this share of their noise. Iterating
#: further than needed does harm: a landmark's Gaussian in world coordinates comes from pixels by a linearisation at its
#: prediction and fits pixels linearised there; moving that point to where each noisy measurement wants it biases the
#: estimate and claims information that is not there (simulated drives at 0.1: twice the rotation error, four times
#: the NEES of 1.0). But a long step, or the first frames of a fast camera, cannot do without.
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its standard deviations: with a wide prior they all have the
#: same sign, and each within its noise they moved it by 0.7 of them.
_POSE_SHARE = 0.25
_HALVINGS = 6  # numerics: of a step that does not lower the cost
_SMALL = 48  # cost: rows of a triangular matrix that is inverted as a whole


#: Of a linear update: mask of its rows (M, 3), H, H P (3M, n), ν (3M,), S (3M, 3M), of which the lower triangle counts.
Parts = tuple[BoolArray, Jacobian, Array, Array, Array]


class UnsolvableError(ArithmeticError):
    """The update has no usable solution; the message says why. It never leaves the back end."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One update.

    Attributes:
        P: the covariance (n, n) of the state.
        pose: prior mean of [r, φ] (6,).
        c: that of the measured landmarks' coordinates (M, 3).
        first: where these begin in the state (M,).
        z: measurements (M, 3) [px], NaN where a component is not measured.
        sigma: pixel noise [px].
        model: what is predicted, and its derivatives.
        iterations: most linearisations.
        gate_probability: quantile of χ² beyond which a landmark's measurement is rejected.
        guess: a change of [r, φ] (6,) worth trying where the prior is far off, or None.
        gauge: gives the Jacobian (6 + 3M, 6) of g by a displacement of the world, if that is unobservable.
    """

    P: Array
    pose: Array
    c: Array
    first: IndexArray
    z: Array
    sigma: float
    model: Measurement
    iterations: int
    gate_probability: float
    guess: Array | None = None
    gauge: Callable[[], Array] | None = None

    @cached_property
    def g(self) -> IndexArray:
        """Where [r, φ] and the measured landmarks stand in the state (6 + 3M,)."""
        return np.concatenate([np.arange(POSE), (self.first[:, None] + np.arange(3)).reshape(-1)])

    @cached_property
    def displacement(self) -> Displacement | None:
        """The unobservable part of a change: a displacement of the whole world. None where landmarks are known exactly.

        Of all displacements it is the one that explains the landmarks' change best, given their covariance.
        """
        if self.gauge is None:
            return None
        U, marks = self.gauge(), self.g[POSE:]
        lower, info = dpotrf(self.P[marks][:, marks].T, lower=1, clean=0)
        if info != 0:
            return None
        weighted = np.asarray(dpotrs(lower, U[POSE:], lower=1)[0])
        L = np.zeros(U.T.shape)
        L[:, POSE:] = np.linalg.pinv(U[POSE:].T @ weighted, rcond=1e-12, hermitian=True) @ weighted.T
        return Displacement(U, L, self.g)

    def mean(self, change: Array, whole: bool = False) -> tuple[Array, Array]:
        """Pose (6,) and coordinates (M, 3) after a change of g, without the world's displacement unless `whole`."""
        if change.any() and not whole and self.displacement is not None:
            change = change - self.displacement.change @ (self.displacement.share @ change)
        # A linear step may ask for a point beyond infinity: it is at infinity.
        return self.pose + change[:POSE], self.model.coordinates.moved(self.c, change[POSE:].reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class Iterate:
    """A correction s of g, the change of the state that it makes, what is predicted there, and the cost.

    The cost is the squared distance from prior and measurements, ∞ where one cannot be seen.
    """

    s: Array
    change: Array
    z: Array
    cost: float = math.inf


@dataclass(frozen=True, eq=False)
class System:
    """The linear update at an iterate, in whitened innovations: ``w = L⁻¹ ν`` has covariance 1.

    To take out measurements is to project w on what is orthogonal to the columns of L⁻¹ that belong to them: that gives
    what a factorisation without them would.

    Attributes:
        rows: its rows, a mask (M, 3).
        H, HP: the Jacobian, and its product with the covariance (3M, n).
        nu: the innovation taken back to the prior through H (3M,).
        inverse: ``L⁻¹`` (3M, 3M), lower triangular.
        taken: orthonormal directions (3M, K) of what has been taken out.
    """

    rows: BoolArray
    H: Jacobian
    HP: Array
    nu: Array
    inverse: Array
    taken: Array

    @classmethod
    def of(cls, rows: BoolArray, H: Jacobian, HP: Array, nu: Array, S: Array, gone: BoolArray) -> System:
        """Without some rows (mask (M, 3)); of S only the lower triangle counts.

        Raises:
            UnsolvableError: S is not positive definite.
        """
        out = np.flatnonzero(gone)
        if len(out):
            nu, S = nu.copy(), S.copy()
            nu[out], S[out], S[:, out], S[out, out] = 0.0, 0.0, 0.0, 1.0
        upper, info = dpotrf(S.T)  # of the transpose, which is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        inverse = _inverse(upper).T
        inverse[out, out] = 0.0
        return cls(rows & ~gone, H, HP, nu, inverse, np.zeros((len(nu), 0)))

    def without(self, gone: BoolArray) -> System:
        """Without some more rows (mask (M, 3))."""
        columns = self.inverse[:, np.flatnonzero(gone & self.rows)]
        more, _ = np.linalg.qr(columns - self.taken @ (self.taken.T @ columns))
        return replace(self, rows=self.rows & ~gone, taken=np.concatenate([self.taken, more], axis=1))

    def whiten(self, X: Array) -> Array:
        """``L⁻¹ X``, as far as it is not taken out, for X (3M, ...)."""
        W = self.inverse @ X
        return np.asarray(W - self.taken @ (self.taken.T @ W))

    def whitened(self, HX: Array) -> Array:
        """`whiten` of H X, transposed (N, 3M), in Fortran's order: P shrinks by ``V Vᵀ``, where V is this of H P."""
        V = dtrmm(1.0, self.inverse.T, HX.T, side=1)
        if self.taken.size:
            V = dgemm(-1.0, V @ self.taken, self.taken, beta=1.0, c=V, trans_b=1, overwrite_c=1)
        return np.asarray(V)

    @cached_property
    def w(self) -> Array:
        """The whitened innovation (3M,); its square is the NIS ``νᵀ S⁻¹ ν``."""
        return self.whiten(self.nu)

    @cached_property
    def y(self) -> Array:
        """``S⁻¹ ν`` (3M,)."""
        return np.asarray(self.w @ self.inverse)

    @cached_property
    def by_pose(self) -> Array:
        """The whitened innovation's covariance (3M, 6) with [r, φ]."""
        return self.whiten(self.HP[:, :POSE])

    def variances(self, P: Array) -> Array:
        """Of [r, φ] (6,) after the update; rounding may leave one that is not positive."""
        return np.asarray(P.diagonal()[:POSE] - (self.by_pose**2).sum(axis=0))

    def distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others predict; 0 for one without any.

        For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off
        by ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so that the distance is ``y_jᵀ Q_j⁻¹ y_j``.
        """
        lost = self.taken.T @ self.inverse
        found, used = kernels.conditional_distances(self.inverse, lost, self.y), self.rows.any(axis=1)
        if not np.isfinite(found[used]).all():
            raise UnsolvableError("the innovation covariance is not positive definite")
        return np.where(used, found, 0.0)


@dataclass(frozen=True, eq=False)
class Solution:
    """The maximum of the posterior (or one step towards it).

    Attributes:
        used: which landmarks (M,) it is made of.
        change: of the state (n,).
        system: the last linear update, from which the covariance follows.
        distances: of each landmark (M,): squared distance of its measurement from what all others predict.
    """

    used: BoolArray
    change: Array
    system: System
    distances: Array


@dataclass(frozen=True, eq=False)
class Gated:
    """Which landmarks (M,) each lie within the gate of their own innovation covariance, linearised at `start`.

    The limits (M,) are the gate's, of the squared distances (M,) of the innovations; NaN where none is predicted.
    """

    used: BoolArray
    limits: Array
    distances: Array
    start: Iterate
    system: Callable[[], System]


def gate(problem: Problem, at_guess: bool = False) -> Gated:
    """Test each landmark by itself, with its innovation linearised at the prior or at the guess.

    Raises:
        UnsolvableError: the prior is not finite, or S is not positive definite.
    """
    if not (np.isfinite(problem.pose).all() and math.isfinite(problem.P.trace())):
        raise UnsolvableError("the predicted state is not finite")
    nothing = np.zeros(len(problem.g)), np.zeros(len(problem.P))
    s, change = _towards_guess(problem) if at_guess else nothing
    z, H = problem.model.linearise(*problem.mean(change[problem.g]), problem.first)
    start, measured = Iterate(s, change, z), np.isfinite(problem.z)
    visible = np.asarray(np.isfinite(z).all(axis=1))
    parts = rows, _, _, nu, S = _linear_update(problem, measured & visible[:, None], start, H)
    limits = chi_square_limits(measured.sum(axis=1), problem.gate_probability)
    own = kernels.own_distances(nu, S)
    if not np.isfinite(own).all():
        raise UnsolvableError("the predicted innovations are not finite or not positive definite")
    distances = np.where(visible, own, np.nan)
    used = np.asarray(distances <= limits)
    return Gated(used, limits, distances, start, lambda: System.of(*parts, rows & ~used[:, None]))


def solve(problem: Problem, gated: Gated) -> Solution | None:
    """Solve with what passed the gate, and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees.

    Returns:
        the solution, or None where no observation is left.

    Raises:
        UnsolvableError: S is not positive definite, the new state not finite, or a variance not positive.
    """
    used, first = gated.used, gated.system() if gated.used.any() else None
    while first is not None and used.any():
        change, system = _iterate(problem, gated.start, first)
        distances = system.distances()
        excess = distances / gated.limits
        worst = excess.max()
        if worst <= 1:
            if not (system.variances(problem.P) > 0).all():
                raise UnsolvableError("the pose's variances would not stay positive")
            return Solution(used, change, system, distances)
        used = used & (excess <= max(1.0, 0.5 * worst))
        first = first.without(~used[:, None] & np.ones(3, bool))
    return None


def _iterate(problem: Problem, start: Iterate, system: System) -> tuple[Array, System]:
    """The change of the state (n,) by an update whose first linearisation, at `start`, is `system`; and the last one.

    Gauss-Newton on the posterior (the iterated Kalman filter); a step that raises the cost, or takes a landmark
    behind the camera, is shortened. Where the first step is far from linear, the guess may be the better next place.
    With one iteration the step is taken as it is: the papers' filter.
    """
    rows, now = system.rows, replace(start, cost=_cost(problem, system.rows, start))
    for iteration in range(1, problem.iterations + 1):
        s, change = system.H.transposed_times(system.y), system.y @ system.HP
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if problem.iterations == 1:
            break
        following = _visit(problem, rows, s, change, whole=True)
        if following.cost <= now.cost and _linear(problem, system, now, following):
            break
        following, complete = _descend(problem, rows, now, Iterate(s, change, following.z))
        if complete and _linear(problem, system, now, following):
            break
        if iteration == 1 and problem.guess is not None:
            at_guess = _visit(problem, rows, *_towards_guess(problem))
            following = min(following, at_guess, key=lambda iterate: iterate.cost)
        if following is now and iteration == 1:
            raise UnsolvableError("no step towards the solution lowers the cost")
        change = np.asarray(following.change)
        if iteration == problem.iterations or following is now:
            break
        z, H = problem.model.linearise(*problem.mean(following.change[problem.g]), problem.first)
        now = replace(following, z=z)
        system = System.of(*_linear_update(problem, rows, now, H), np.zeros_like(rows))
    return change, system


def _inverse(U: Array) -> Array:
    """``U⁻¹`` of an upper triangular U (N, N), by halves: LAPACK's own takes twice as long for many rows."""
    half = len(U) // 2
    if half < _SMALL:
        return np.asarray(dtrtri(U)[0])
    first, last = _inverse(U[:half, :half]), _inverse(U[half:, half:])
    out = np.zeros(U.shape, order="F")
    out[:half, :half], out[half:, half:] = first, last
    out[:half, half:] = dtrmm(-1.0, first, dtrmm(1.0, last, U[:half, half:], side=1))
    return out


def _linear(problem: Problem, system: System, now: Iterate, following: Iterate) -> bool:
    """Whether the measurements changed between two iterates as the Jacobian said, as far as the pose depends on it."""
    expected = system.H.times((following.change - now.change)[:, None]).reshape(-1, 3)
    errors = np.where(system.rows, following.z - now.z - expected, 0.0)
    if np.abs(errors).max() >= _LINEAR * problem.sigma:
        return False
    moved = system.whiten(errors.reshape(-1)) @ system.by_pose
    return bool((moved**2 <= _POSE_SHARE**2 * system.variances(problem.P)).all())


def _cost(problem: Problem, rows: BoolArray, at: Iterate) -> float:
    residual = np.where(rows, problem.z - at.z, 0.0)
    prior = float(at.s @ at.change[problem.g])
    cost = prior + float(np.vdot(residual, residual)) / problem.sigma**2
    return cost if math.isfinite(cost) else math.inf


def _towards_guess(problem: Problem) -> tuple[Array, Array]:
    """The correction s of g, and the change of the state, by which the pose goes to the guess and the landmarks along
    as their covariances with it have it.
    """
    assert problem.guess is not None
    s = np.zeros(len(problem.g))
    with suppress(np.linalg.LinAlgError):  # a pose that is known exactly cannot be moved
        s[:POSE] = np.linalg.solve(problem.P[:POSE, :POSE], problem.guess)
    return s, s[:POSE] @ problem.P[:POSE]


def _visit(problem: Problem, rows: BoolArray, s: Array, change: Array, whole: bool = False) -> Iterate:
    """The iterate with a correction; `whole`: with the world's displacement in it, which is less work."""
    z = problem.model.predict(*problem.mean(change[problem.g], whole))
    at = Iterate(s, change, z)
    return replace(at, cost=_cost(problem, rows, at))


def _descend(problem: Problem, rows: BoolArray, now: Iterate, target: Iterate) -> tuple[Iterate, bool]:
    """The longest of the steps 1, 1/2, 1/4, ... towards `target` that does not raise the cost, else `now`.

    Also whether it is the whole step.
    """
    for halving in range(_HALVINGS):
        share = 0.5**halving
        s, change = now.s + share * (target.s - now.s), now.change + share * (target.change - now.change)
        trial = _visit(problem, rows, s, change)
        if trial.cost <= now.cost * (1 + 1e-9):
            return trial, halving == 0
    return now, False


def _linear_update(problem: Problem, rows: BoolArray, at: Iterate, H: Jacobian) -> Parts:
    """Rows, H, H P, ν and S of the update linearised at an iterate, where the plain Jacobian is H."""
    moved = at.change.any()
    H = H if rows.all() else H.only(rows)
    if moved and problem.displacement is not None:
        H = H.without(problem.displacement)
    nu = np.where(rows, problem.z - at.z, 0.0).reshape(-1)
    if moved:
        nu += H.times(at.change[:, None])[:, 0]
    HP = H.times(problem.P)
    return rows, H, HP, nu, H.covariance(HP, problem.sigma**2)
