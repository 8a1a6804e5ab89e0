"""The measurement update, gated and iterated: what it makes of a prior. The filter's state is not changed here.

In the papers' order: the innovation ν and its covariance ``S = H P Hᵀ + R = L Lᵀ``, the gate, the gain
``K = P Hᵀ S⁻¹``, the corrected state ``x + K ν`` and covariance ``P − K S Kᵀ`` (paper A, Eq. 11). What is kept is
``y = S⁻¹ ν``: the state changes by ``P Hᵀ y``, and ``s = Hᵀ y`` has entries for g = [pose, measured landmarks] alone.

A component that is not measured (or gated) keeps its row with a zero Jacobian and a zero innovation: it adds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg.blas import dgemm, dtrmm
from scipy.linalg.lapack import dpotrf, dtrtri

from backends.ekf import kernels
from backends.ekf.covariance import POSE
from backends.ekf.measurement import Jacobian, Measurement
from slam.chi_square import chi_square_limits
from slam.data import BoolArray, IndexArray
from slam.geometry.se3 import Array

#: A step is the last where the measurements it predicts linearly are right to this share of their noise. Iterating
#: further than needed does harm: it moves points to where noisy pixels want them, and claims information that is not
#: there (drives at 0.1: four times the NEES of 1.0). A long step, or a fast camera's first, cannot do without.
_LINEAR = 1.0
#: Their errors together may move the pose by this share of its deviations: with a wide prior all have the same sign.
_POSE_SHARE = 0.25
_HALVINGS = 6  # numerics: of a step that does not lower the cost
_SMALL = 48  # cost: rows of a triangular matrix that is inverted as a whole


class UnsolvableError(ArithmeticError):
    """The update has no usable solution; the message says why. It never leaves the back end."""


@dataclass(frozen=True, eq=False)
class View:
    """The prior as seen from a pose: errors of the state are taken from there.

    Attributes:
        state: the prior itself (`backends.ekf.state.State`), with its covariance as seen from there.
        T: the pose T_world_left (4, 4).
        P: the covariance (n, n) of the state's error.
        mean: that of the state's error (n,): zero at the prior's own pose.
        lever: an error x (6,) of the pose moves a measured landmark as seen from the camera by ``−lever x`` (M, 3, 6).
        go: the pose, and the changes (M, 3) of the measured landmarks' coordinates, after an error (n,).
    """

    state: Any
    T: Array
    P: Array
    mean: Array
    lever: Array
    go: Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class Problem:
    """One update.

    Attributes:
        view: gives the prior as seen from a pose (4, 4), by default its own, with more noise (12, 12) of the camera.
        c: the prior's coordinates (M, 3) of the measured landmarks.
        first: where these begin in the state (M,).
        z: measurements (M, 3) [px], NaN where a component is not measured.
        sigma: pixel noise [px].
        model: what is predicted, and its derivatives.
        iterations: most linearisations.
        gate_probability: quantile of χ² beyond which a landmark's measurement is rejected.
        guess: a pose (4, 4) worth trying where the prior is far off, or None.
        noise: of the camera (12, 12), which joins the prior's, or None.
    """

    view: Callable[[Array | None, Array | None], View]
    c: Array
    first: IndexArray
    z: Array
    sigma: float
    model: Measurement
    iterations: int
    gate_probability: float
    guess: Array | None = None
    noise: Array | None = None

    @cached_property
    def prior(self) -> View:
        """Seen from its own pose."""
        return self.view(None, self.noise)

    @cached_property
    def g(self) -> IndexArray:
        """Where the pose and the measured landmarks stand in the state (6 + 3M,)."""
        return np.concatenate([np.arange(POSE), (self.first[:, None] + np.arange(3)).reshape(-1)])


@dataclass(frozen=True, eq=False)
class Iterate:
    """Where measurements are linearised: a view, and a change (M, 3) of the landmarks' coordinates.

    Also what is predicted (M, 3), its derivatives (M, 3, 3) by the coordinates, the squared distance from the prior.
    """

    view: View
    change: Array
    z: Array
    own: Array
    from_prior: float = 0.0

    @classmethod
    def at(cls, problem: Problem, view: View, change: Array, from_prior: float = 0.0) -> Iterate:
        """With its linearisation."""
        c = problem.model.coordinates.moved(problem.c, change)
        return cls(view, change, *problem.model.linearise(view.T, c), from_prior)

    def cost(self, problem: Problem, rows: BoolArray) -> float:
        """Squared distance from prior and measurements; ∞ where one cannot be seen."""
        residual = np.where(rows, problem.z - self.z, 0.0)
        cost = self.from_prior + float(np.vdot(residual, residual)) / problem.sigma**2
        return cost if math.isfinite(cost) else math.inf


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
    def of(cls, linear: Linear, gone: BoolArray) -> System:
        """Without some rows (mask (M, 3)).

        Raises:
            UnsolvableError: S is not positive definite.
        """
        nu, S, out = linear.nu, linear.S, np.flatnonzero(gone)
        if len(out):
            nu, S = nu.copy(), S.copy()
            nu[out], S[out], S[:, out], S[out, out] = 0.0, 0.0, 0.0, 1.0
        upper, info = dpotrf(S.T)  # of the transpose, which is in the order that LAPACK wants
        if info != 0:
            raise UnsolvableError("the innovation covariance is not positive definite")
        inverse = _inverse(upper).T
        inverse[out, out] = 0.0
        return cls(linear.rows & ~gone, linear.H, linear.HP, nu, inverse, np.zeros((len(nu), 0)))

    def without(self, gone: BoolArray) -> System:
        """Without some more rows (mask (M, 3))."""
        columns = self.inverse[:, np.flatnonzero(gone & self.rows)]
        more = np.linalg.qr(columns - self.taken @ (self.taken.T @ columns))[0]
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
        """The whitened innovation's covariance (3M, 6) with the pose."""
        return self.whiten(self.HP[:, :POSE])

    def variances(self, P: Array) -> Array:
        """Of the pose's error (6,) after the update; rounding may leave one that is not positive."""
        return np.asarray(P.diagonal()[:POSE] - (self.by_pose**2).sum(axis=0))

    def distances(self) -> Array:
        """Squared distance (M,) of each landmark's measurement from what all others predict; 0 for one without any.

        For the rows j of a landmark, ``y_j = (S⁻¹ν)_j`` and ``Q_j = (S⁻¹)_jj``: given the others, its innovation is off
        by ``Q_j⁻¹ y_j`` with covariance ``Q_j⁻¹``, so that the distance is ``y_jᵀ Q_j⁻¹ y_j``.
        """
        found = kernels.conditional_distances(self.inverse, self.taken.T @ self.inverse, self.y)
        used = self.rows.any(axis=1)
        if not np.isfinite(found[used]).all():
            raise UnsolvableError("the innovation covariance is not positive definite")
        return np.where(used, found, 0.0)


@dataclass(frozen=True, eq=False)
class Linear:
    """Of a linear update: mask of its rows (M, 3), H, H P (3M, n), ν (3M,), lower triangle of S (3M, 3M)."""

    rows: BoolArray
    H: Jacobian
    HP: Array
    nu: Array
    S: Array

    @classmethod
    def at(cls, problem: Problem, rows: BoolArray, at: Iterate) -> Linear:
        """Linearised at an iterate; ν and S are those of the prior's mean."""
        H = Jacobian.of(at.own, at.view.lever, problem.first, rows)
        nu = np.where(rows, problem.z - at.z, 0.0).reshape(-1)
        if at.change.any():
            nu += (H.own @ at.change[:, :, None]).reshape(-1)
        if at.view.mean.any():
            nu -= H.times(at.view.mean[:, None])[:, 0]
        HP = H.times(at.view.P)
        return cls(rows, H, HP, nu, H.covariance(HP, problem.sigma**2))


@dataclass(frozen=True, eq=False)
class Solution:
    """The maximum of the posterior (or one step towards it).

    Attributes:
        used: which landmarks (M,) it is made of.
        view: of the last linearisation.
        change: the error (n,) to correct, as seen from there.
        system: the last linear update, from which the covariance follows.
    """

    used: BoolArray
    view: View
    change: Array
    system: System


@dataclass(frozen=True, eq=False)
class Gated:
    """Which landmarks (M,) each lie within the gate of their own innovation covariance, linearised at `start`.

    The limits (M,) are the gate's, of the squared distances (M,) of the innovations; NaN where none is predicted.
    """

    used: BoolArray
    limits: Array
    distances: Array
    start: Iterate
    linear: Linear


def gate(problem: Problem, at_guess: bool = False) -> Gated:
    """Test each landmark by itself, with its innovation linearised at the prior or at the guess.

    Raises:
        UnsolvableError: the prior is not finite, or S is not positive definite.
    """
    view = problem.view(problem.guess, problem.noise) if at_guess else problem.prior
    if not (np.isfinite(view.T).all() and math.isfinite(view.P.trace())):
        raise UnsolvableError("the predicted state is not finite")
    start, measured = Iterate.at(problem, view, np.zeros_like(problem.c)), np.isfinite(problem.z)
    visible = np.asarray(np.isfinite(start.z).all(axis=1))
    linear = Linear.at(problem, measured & visible[:, None], start)
    limits = chi_square_limits(measured.sum(axis=1), problem.gate_probability)
    own = kernels.own_distances(linear.nu, linear.S)
    if not np.isfinite(own).all():
        raise UnsolvableError("the predicted innovations are not finite or not positive definite")
    distances = np.where(visible, own, np.nan)
    return Gated(np.asarray(distances <= limits), limits, distances, start, linear)


def solve(problem: Problem, gated: Gated) -> Solution | None:
    """Solve with what passed the gate, and take out what the other measurements contradict, the worst first.

    A wrong match spoils the tests of its neighbours, so a round takes out only landmarks at least half as far off as
    the worst one, until all that is left agrees; None where nothing is left.

    Raises:
        UnsolvableError: S is not positive definite, the new state not finite, or the pose's covariance not positive.
    """
    if not gated.used.any():
        return None
    used, first = gated.used, System.of(gated.linear, gated.linear.rows & ~gated.used[:, None])
    while used.any():
        view, change, system = _iterate(problem, gated.start, first)
        excess = system.distances() / gated.limits
        worst = excess.max()
        if worst <= 1:
            left = view.P[:POSE, :POSE] - system.by_pose.T @ system.by_pose
            if dpotrf(left, lower=1)[1] != 0:
                raise UnsolvableError("the pose's covariance would not stay positive definite")
            return Solution(used, view, change, system)
        used = used & (excess <= max(1.0, 0.5 * worst))
        first = first.without(~used[:, None] & np.ones(3, bool))
    return None


def _iterate(problem: Problem, now: Iterate, system: System) -> tuple[View, Array, System]:
    """The change of the state (n,), seen from a view, by an update whose first linearisation is `system`, and the last.

    Gauss-Newton on the posterior (an iterated Kalman filter); a step that raises the cost is shortened. Where the first
    is far from linear, the guess may be the better next place. One iteration is taken as it is: the papers' filter.
    """
    rows, reached = system.rows, None
    for iteration in range(1, problem.iterations + 1):
        s, change = system.H.transposed_times(system.y), system.y @ system.HP + now.view.mean
        if not np.isfinite(change).all():
            raise UnsolvableError("the corrected state is not finite")
        if problem.iterations == 1 or _linear(problem, system, now, change):
            return now.view, change, system
        following, step = _descend(problem, rows, now, s, change)
        if iteration == 1 and problem.guess is not None:
            following = min(following, _at_guess(problem), key=lambda iterate: iterate.cost(problem, rows))
        if following is now:
            break
        reached = now.view, step, system
        if iteration < problem.iterations:
            now = following
            system = System.of(Linear.at(problem, rows, now), np.zeros_like(rows))
    if reached is None:
        raise UnsolvableError("no step towards the solution lowers the cost")
    return reached


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


def _linear(problem: Problem, system: System, now: Iterate, change: Array) -> bool:
    """Whether the measurements change by a step as the Jacobian says, as far as the pose depends on it."""
    seen = change[problem.first[:, None] + np.arange(3)] - now.view.lever @ change[:POSE]
    T, moved = now.view.go(change)
    z = problem.model.predict(T, problem.model.coordinates.moved(problem.c, moved))
    expected = (now.own @ (seen - now.change)[:, :, None])[:, :, 0]
    errors = np.where(system.rows, z - now.z - expected, 0.0)
    if not np.abs(errors).max() < _LINEAR * problem.sigma:
        return False
    moved = system.whiten(errors.reshape(-1)) @ system.by_pose
    return bool((moved**2 <= _POSE_SHARE**2 * system.variances(now.view.P)).all())


def _at_guess(problem: Problem) -> Iterate:
    """The guess, with the landmarks where they are believed: its distance from the prior is that of the pose alone."""
    view, distance = problem.view(problem.guess, problem.noise), math.inf
    with suppress(np.linalg.LinAlgError):  # a pose that is known exactly cannot be moved
        mean = view.mean[:POSE]
        distance = float(mean @ np.linalg.solve(view.P[:POSE, :POSE], mean))
    return Iterate.at(problem, view, np.zeros_like(problem.c), distance)


def _descend(problem: Problem, rows: BoolArray, now: Iterate, s: Array, change: Array) -> tuple[Iterate, Array]:
    """The longest of the steps 1, 1/2, 1/4, ... towards ``change = mean + P s`` that does not raise the cost, else now.

    Where it ends, and the step (n,). The next linearisation is at the pose reached: the camera turns, and the landmarks
    stay. On the way the distance from the prior, with d at the start and d' at the end, is that of (1 − a) d + a d'.
    """
    there = (change - now.view.mean)[problem.g]
    start = np.concatenate([np.zeros(POSE), now.change.reshape(-1)])
    end, between = float(s @ there), float(s @ (start - now.view.mean[problem.g]))
    cost, step = now.cost(problem, rows), change.copy()
    for halving in range(_HALVINGS):
        a = 0.5**halving
        step[problem.g] = start + a * (change[problem.g] - start)
        distance = (1 - a) ** 2 * now.from_prior + 2 * a * (1 - a) * between + a * a * end
        T, moved = now.view.go(step)
        following = Iterate.at(problem, problem.view(T, problem.noise), moved, distance)
        if following.cost(problem, rows) <= cost * (1 + 1e-9):
            return following, step
    return now, step
